"""Run `stmc benchmark_scale`: see `stmc.cli.benchmark_scale`."""

import sys

from stmc.cli.benchmark_scale import main

if __name__ == "__main__":
    sys.exit(main())
