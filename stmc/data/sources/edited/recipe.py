"""The interface of recipes: making one clip of an action from recorded motions, and checking the result."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from stmc.motion.motion import Motion

Origin = Literal["recorded", "edited", "authored"]
"""Origin of a clip's movement: an unedited recording (cut or mirrored); a recording with another path, pace or
direction; or limbs that a recipe moves on a recorded body."""


class Unusable(ValueError):
    """A draw without a usable clip, for example with a base that is too short; the recipe draws again."""


@dataclass(frozen=True)
class Base:
    """A recorded clip to edit: its name, its `recording` (shared by mirrored clips), its style and its motion."""

    name: str
    recording: str
    style: str
    motion: Motion


@dataclass(frozen=True)
class Draft:
    """A made clip: its motion, and the recording of its base."""

    motion: Motion
    recording: str


Bases = Mapping[str, Sequence[Base]]
"""Recorded clips by the name of their action, unmirrored, on the default skeleton, at the data set's frame rate."""


@dataclass(frozen=True)
class Recipe:
    """A recipe for clips of one action.

    Args:
        action: Name in `assets/contents.json`; for actions with a side the left one, whose mirror images are the right
            one's clips.
        origin: Origin of the movement.
        make: Draws one clip; raises `Unusable` if the draw cannot be used.
        accept: Gate that a finished clip must pass.
        clips: Number of clips to make.
        once: Whether the action is one-shot, with rest before and after it, so that training must not trim the clip.
        mirrors: Whether the mirror images are clips, too. Those of instruments, which have no side in their texts, are
            not: a network that sees both forms shows either.
    """

    action: str
    origin: Origin
    make: Callable[[Bases, np.random.Generator], Draft]
    accept: Callable[[Motion], bool]
    clips: int = 60
    once: bool = True
    mirrors: bool = True
