"""`python -m stmc`: the same as the command `stmc`."""

import sys

from stmc.commands import program

if __name__ == "__main__":
    sys.exit(program())
