"""Run `stmc sample`: see `stmc.cli.sample`."""

import sys

from stmc.cli.sample import main

if __name__ == "__main__":
    sys.exit(main())
