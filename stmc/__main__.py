"""The command `stmc`, which is also `python -m stmc`."""

import sys


def main() -> int:
    """Runs the command; Ctrl-C ends in one line also while the library is imported."""
    try:
        from stmc.cli.dispatch import program

        return program()
    except KeyboardInterrupt:
        sys.stderr.write("stopped; ask again to go on\n")
        return 130


if __name__ == "__main__":
    sys.exit(main())
