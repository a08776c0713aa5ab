"""Run `stmc train`: see `stmc.cli.train`."""

import sys

from stmc.cli.train import main

if __name__ == "__main__":
    sys.exit(main())
