"""Where the scripts and their configurations lie: inside the package once it is installed, beside it in a checkout."""

from pathlib import Path

PACKAGE = Path(__file__).resolve().parents[1]


def place(name: str) -> Path:
    """The folder of "scripts" or "configs"."""
    inside = PACKAGE / name
    return inside if inside.is_dir() else PACKAGE.parent / name
