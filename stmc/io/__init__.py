"""Files: written whole or not at all, and untrusted ones read within bounds.

Knows no motion.
"""

from lazy_loader import attach

__getattr__, __dir__, __all__ = attach(
    __name__,
    submodules=["arrays", "bounds", "filenames", "files", "untrusted"],
)
