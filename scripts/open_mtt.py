"""Run `stmc open_mtt`: see `stmc.cli.open_mtt`."""

import sys

from stmc.cli.open_mtt import main

if __name__ == "__main__":
    sys.exit(main())
