"""Run `stmc benchmark_length`: see `stmc.cli.benchmark_length`."""

import sys

from stmc.cli.benchmark_length import main

if __name__ == "__main__":
    sys.exit(main())
