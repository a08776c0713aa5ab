"""Run `stmc prepare`: see `stmc.cli.prepare`."""

import sys

from stmc.cli.prepare import main

if __name__ == "__main__":
    sys.exit(main())
