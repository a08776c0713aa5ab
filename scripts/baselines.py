"""Run `stmc baselines`: see `stmc.cli.baselines`."""

import sys

from stmc.cli.baselines import main

if __name__ == "__main__":
    sys.exit(main())
