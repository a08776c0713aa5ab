"""Run `stmc benchmark`: see `stmc.cli.benchmark`."""

import sys

from stmc.cli.benchmark import main

if __name__ == "__main__":
    sys.exit(main())
