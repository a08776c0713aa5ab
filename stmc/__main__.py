"""The command `stmc`, also available as `python -m stmc`."""

import sys


def main() -> int:
    """Run the command; Ctrl-C ends in one line, even while the library is being imported."""
    try:
        from stmc.cli.dispatch import program

        return program()
    except KeyboardInterrupt:
        sys.stderr.write("Interrupted. Run the same command again to resume.\n")
        return 130


if __name__ == "__main__":
    sys.exit(main())
