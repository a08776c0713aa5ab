"""Run `stmc train_tmr`: see `stmc.cli.train_tmr`."""

import sys

from stmc.cli.train_tmr import main

if __name__ == "__main__":
    sys.exit(main())
