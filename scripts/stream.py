"""Run `stmc stream`: see `stmc.cli.stream`."""

import sys

from stmc.cli.stream import main

if __name__ == "__main__":
    sys.exit(main())
