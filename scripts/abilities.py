"""Run `stmc abilities`: see `stmc.cli.abilities`."""

import sys

from stmc.cli.abilities import main

if __name__ == "__main__":
    sys.exit(main())
