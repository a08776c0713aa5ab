"""The files that hold a film, and the package that writes videos; quick to import, unlike what draws."""

from importlib import import_module
from types import ModuleType

FILMS = (".webp", ".gif", ".mp4")


def ffmpeg() -> ModuleType:
    """What writes videos. Raises `ModuleNotFoundError` that says how to come by it."""
    try:
        return import_module("imageio_ffmpeg")
    except ModuleNotFoundError as error:
        message = "videos need imageio-ffmpeg: pip install 'stmc[film]'; .webp does without"
        raise ModuleNotFoundError(message, name="imageio_ffmpeg") from error
