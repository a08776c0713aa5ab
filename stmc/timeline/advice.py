"""Warnings about timelines, shown at the line of whoever uses the library and not at one of the library's own."""

from __future__ import annotations

import sys
import warnings
from types import FrameType

_INSIDE = {"stmc", "jaxtyping", "beartype", "torch"}
"""Packages whose lines are nobody's to mend: ours, those that check our signatures under test, and PyTorch's, whose
decorators stand between."""


class TimelineWarning(UserWarning):
    """Something a timeline can mean but hardly wants, such as one body part claimed by two prompts at once."""


class PromptWarning(UserWarning):
    """A prompt that a model may not show."""


class UnknownPromptWarning(PromptWarning):
    """A prompt that is far from all that a model was trained with: it will do something else."""


class RarelyShownWarning(PromptWarning):
    """A prompt whose action the model was trained with, and which few of its samples show."""


def advise(message: str, category: type[UserWarning] = TimelineWarning) -> None:
    """A warning at the innermost line outside of this library."""
    depth, frame = 1, sys._getframe()
    while frame.f_back is not None and _inside(frame):
        depth, frame = depth + 1, frame.f_back
    warnings.warn(message, category, stacklevel=depth)


def _inside(frame: FrameType) -> bool:
    package = frame.f_globals.get("__name__", "").partition(".")[0]  # also of methods that `dataclass` writes
    return package in _INSIDE or frame.f_code.co_filename.startswith("<@beartype")
