"""Run `stmc attention`: see `stmc.cli.attention`."""

import sys

from stmc.cli.attention import main

if __name__ == "__main__":
    sys.exit(main())
