"""Run `stmc actions`: see `stmc.cli.actions`."""

import sys

from stmc.cli.actions import main

if __name__ == "__main__":
    sys.exit(main())
