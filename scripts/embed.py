"""Run `stmc embed`: see `stmc.cli.embed`."""

import sys

from stmc.cli.embed import main

if __name__ == "__main__":
    sys.exit(main())
