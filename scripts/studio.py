"""Run `stmc studio`: see `stmc.cli.studio`."""

import sys

from stmc.cli.studio import main

if __name__ == "__main__":
    sys.exit(main())
