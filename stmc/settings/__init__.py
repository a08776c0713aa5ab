"""Settings as records, shards of work, and names that settings had before.

Knows no command.
"""

from lazy_loader import attach

__getattr__, __dir__, __all__ = attach(
    __name__,
    submodules=["records", "renamed", "shards"],
)
