"""Run `stmc evaluate`: see `stmc.cli.evaluate`."""

import sys

from stmc.cli.evaluate import main

if __name__ == "__main__":
    sys.exit(main())
