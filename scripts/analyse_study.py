"""Run `stmc analyse_study`: see `stmc.cli.analyse_study`."""

import sys

from stmc.cli.analyse_study import main

if __name__ == "__main__":
    sys.exit(main())
