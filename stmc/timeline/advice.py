"""Warnings about timelines, reported at the line of the caller and not at a line of the library."""

from __future__ import annotations

import sys
import warnings
from types import FrameType

_INSIDE = {"stmc", "jaxtyping", "beartype", "torch"}
"""Packages whose lines a user cannot fix: this library, the type checkers that wrap it under test, and PyTorch, whose
decorators add frames."""


class TimelineWarning(UserWarning):
    """A legal but probably unintended timeline, such as one body part claimed by two prompts at once."""


class PromptWarning(UserWarning):
    """A prompt that a model may not show."""


class UnknownPromptWarning(PromptWarning):
    """A prompt that is far from all training texts: the model will probably generate another action."""


class RarelyShownWarning(PromptWarning):
    """A prompt whose action the model was trained with, and which few of its samples show."""


def advise(message: str, category: type[UserWarning] = TimelineWarning) -> None:
    """Issue a warning at the innermost line outside of this library."""
    depth, frame = 1, sys._getframe()
    while frame.f_back is not None and _inside(frame):
        depth, frame = depth + 1, frame.f_back
    warnings.warn(message, category, stacklevel=depth)


def advise_prompt(message: str, known: bool) -> None:
    """Warn of a prompt that a model may not show: an unknown one, or a `known` one whose action rarely works."""
    advise(message, RarelyShownWarning if known else UnknownPromptWarning)


def _inside(frame: FrameType) -> bool:
    package = frame.f_globals.get("__name__", "").partition(".")[0]  # also correct for methods that `dataclass` writes
    return package in _INSIDE or frame.f_code.co_filename.startswith("<@beartype")
