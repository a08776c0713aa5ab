"""The files that hold a film or a page, and the packages that write them; quick to import, unlike these."""

FILMS = (".webp", ".gif", ".mp4")

REQUIRED = {"html": ("viser",), "webp": ("matplotlib", "PIL"), "gif": ("matplotlib", "PIL")}
REQUIRED["mp4"] = (*REQUIRED["webp"], "imageio_ffmpeg")
"""Modules that a format needs beside the library's own dependencies."""
