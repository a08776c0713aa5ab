"""Files: complete or absent when written, and read within limits when untrusted.

Independent of motions.
"""

from lazy_loader import attach

__getattr__, __dir__, __all__ = attach(__name__, submodules=["arrays", "bounds", "filenames", "files", "untrusted"])
