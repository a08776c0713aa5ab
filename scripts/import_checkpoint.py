"""Run `stmc import`: see `stmc.cli.import_checkpoint`."""

import sys

from stmc.cli.import_checkpoint import main

if __name__ == "__main__":
    sys.exit(main())
