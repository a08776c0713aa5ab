"""Settings as records, shards of work, and former names of settings.

Independent of commands.
"""

from lazy_loader import attach

__getattr__, __dir__, __all__ = attach(__name__, submodules=["records", "renamed", "shards"])
