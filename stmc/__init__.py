"""Text-driven 3D human motion from a multi-track timeline (STMC, Petrovich et al., CVPRW 2024).

    model = stmc.load()
    [motion] = model.generate(stmc.Timeline.parse("walk forwards # 0 # 6 # legs"), seed=0)

Public names are listed once, in `__init__.pyi`. They and the packages are imported on first use, so `import stmc` is
quick.
"""

from lazy_loader import attach_stub

__version__ = "0.1.0"

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
