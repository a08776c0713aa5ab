"""Run `stmc study`: see `stmc.cli.study`."""

import sys

from stmc.cli.study import main

if __name__ == "__main__":
    sys.exit(main())
