"""How a body moves, as constraints see it, and the helpers that they share. Knows no constraint."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from stmc.io.bounds import MOST_METRES, MOST_SECONDS
from stmc.io.untrusted import shown
from stmc.motion.body import JOINTS
from stmc.motion.geometry import heading
from stmc.motion.motion import Motion
from stmc.settings.records import SettingError

RAMP = 0.3
"""Seconds in which a correction comes, and goes."""

Place = tuple[float, float, float, float]
"""Where a motion begins: x, y and z of the pelvis in metres, and the heading in radians."""


@dataclass(frozen=True, eq=False)
class Pose:
    """How a body moves, as tensors that may carry gradients: a `Motion` that is not checked."""

    rotations: Float[Tensor, "frames 22 3 3"]
    translation: Float[Tensor, "frames 3"]
    joints: Float[Tensor, "frames 24 3"]
    fps: float | int

    @classmethod
    def of(cls, motion: Motion) -> Pose:
        """A motion's own."""
        return cls(motion.rotations, motion.translation, motion.joints, motion.fps)

    @cached_property
    def heading(self) -> Float[Tensor, " frames"]:
        """As of `Motion`."""
        return heading(self.rotations[:, 0])

    def joint(self, name: str) -> Float[Tensor, "frames 3"]:
        """The path of one joint."""
        return self.joints[:, JOINTS.index(name)]

    def frames_of(self, start: float | int, end: float | int | None) -> slice:
        """The frames from `start` to `end` seconds (None: to the end), one at least if the motion has it."""
        first = int(start * self.fps)
        last = len(self.translation) if end is None else max(first + 1, int(end * self.fps))
        return slice(min(first, len(self.translation)), min(last, len(self.translation)))


def check_span(name: str, start: float | int, end: float | int | None) -> None:
    """Raises `SettingError` unless the seconds are numbers from 0 to `MOST_SECONDS`, in order."""
    times = (start,) if end is None else (start, end)
    if not all(isinstance(time, (int, float)) and 0 <= time <= MOST_SECONDS for time in times) or times[-1] < start:
        place = "..".join(map(shown, times))
        raise SettingError(f"{name} at {place} s: seconds from 0 to {MOST_SECONDS:,} needed, in order")


def check_numbers(name: str, values: Any, width: int) -> tuple:
    """`values` as a tuple of so many floats, at most `MOST_METRES` from 0. Raises `SettingError` for anything else."""
    try:
        numbers = tuple(float(value) for value in values)
    except (TypeError, ValueError, OverflowError):
        numbers = ()
    if len(numbers) != width or not all(abs(number) <= MOST_METRES for number in numbers):
        raise SettingError(f"{name}={shown(values)}: {width} finite numbers needed, at most {MOST_METRES:g} from 0")
    return numbers


def bump(frames: int, span: slice, ramp: int, like: Tensor) -> Float[Tensor, " frames"]:
    """1 within the span, falling smoothly to 0 within `ramp` frames on both sides."""
    frame = torch.arange(frames, device=like.device)
    outside = torch.maximum(span.start - frame, frame - (span.stop - 1)).clamp(min=0)
    share = (outside / (ramp + 1)).clamp(max=1).to(like)
    return 0.5 + 0.5 * torch.cos(math.pi * share)
