"""Optional packages, and the extra of `stmc` that installs each. Imports none of them."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from importlib.util import find_spec

EXTRAS = {
    "PIL": ("pillow", "figures"),
    "accelerate": ("accelerate", "train"),
    "imageio_ffmpeg": ("imageio-ffmpeg", "film"),
    "matplotlib": ("matplotlib", "figures"),
    "pythonosc": ("python-osc", "osc"),
    "smplx": ("smplx", "smpl"),
    "starlette": ("starlette", "studio"),
    "tensorboard": ("tensorboard", "train"),
    "trimesh": ("trimesh", "smpl"),
    "uvicorn": ("uvicorn", "studio"),
}
"""The distribution and the extra of each optional module."""


def require(*modules: str) -> None:
    """Raise `ModuleNotFoundError` if one of these modules is not installed; the message names the extra."""
    for module in modules:
        if find_spec(module) is None:
            raise ModuleNotFoundError(_advice(module), name=module)


def missing_extra(error: BaseException) -> str | None:
    """Return a sentence that names the missing extra behind an error, or None for any other error."""
    module = (error.name or "").partition(".")[0] if isinstance(error, ModuleNotFoundError) else ""
    return _advice(module) if module in EXTRAS else None


@contextmanager
def named_extra() -> Iterator[None]:
    """Add the extra that installs the module to the message of a `ModuleNotFoundError` raised inside."""
    try:
        yield
    except ModuleNotFoundError as error:
        if (message := missing_extra(error)) is None:
            raise
        raise ModuleNotFoundError(message, name=error.name) from error


def _advice(module: str) -> str:
    distribution, extra = EXTRAS[module]
    return f"this needs {distribution}: pip install 'stmc[{extra}]'"
