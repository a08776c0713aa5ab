"""What a recipe is: how to make one clip of an action from recorded motions, and how to tell that it came out right.

Knows motions; knows no caches, no features and no texts.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from stmc.motion.motion import Motion

Origin = Literal["recorded", "edited", "authored"]
"""Where a clip's movement comes from: a recording as it is (cut, mirrored); a recording with another path, pace or
direction; or limbs moved by a recipe on a recorded body."""


class Unusable(ValueError):
    """A draw that gives no usable clip, such as a base that is too short; the recipe is drawn again."""


@dataclass(frozen=True)
class Base:
    """A recorded clip to edit: its name, its `recording` (mirrored clips share it), its style and its motion."""

    name: str
    recording: str
    style: str
    motion: Motion


@dataclass(frozen=True)
class Draft:
    """One made clip: its motion and the recording of the base that it was made from."""

    motion: Motion
    recording: str


Bases = Mapping[str, Sequence[Base]]
"""Recorded clips by the name of their action, unmirrored ones only, on the default skeleton at the data set's rate."""


@dataclass(frozen=True)
class Recipe:
    """How clips of one action are made. `action` is the name in `assets/contents.json`, for actions with a side the
    left one: the right one's clips are the mirror images.

    `make` draws one clip; it raises `Unusable` for a draw that cannot be used. `accept` is the gate that a finished
    clip must pass. `clips` is the number of clips to make, `once` means that the action happens once, with rest before
    and after it, so that training must not trim the clip.
    """

    action: str
    origin: Origin
    make: Callable[[Bases, np.random.Generator], Draft]
    accept: Callable[[Motion], bool]
    clips: int = 60
    once: bool = True
