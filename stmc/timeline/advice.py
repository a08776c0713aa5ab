"""Warnings about timelines, shown at the line of whoever uses the library and not at one of the library's own."""

from __future__ import annotations

import sys
import warnings
from types import FrameType

_INSIDE = {"stmc", "jaxtyping", "beartype"}
"""Packages whose lines are nobody's to mend: ours, and those that check our signatures under test."""


class TimelineWarning(UserWarning):
    """Something a timeline can mean but hardly wants, such as one body part claimed by two prompts at once."""


def advise(message: str) -> None:
    """A `TimelineWarning` at the innermost line outside of this library."""
    depth, frame = 1, sys._getframe()
    while frame.f_back is not None and _inside(frame):
        depth, frame = depth + 1, frame.f_back
    warnings.warn(message, TimelineWarning, stacklevel=depth)


def _inside(frame: FrameType) -> bool:
    package = frame.f_globals.get("__name__", "").partition(".")[0]  # also of methods that `dataclass` writes
    return package in _INSIDE or frame.f_code.co_filename.startswith("<@beartype")
