"""Poses of a body over time, and helpers shared by constraints. Independent of particular constraints."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from stmc.io.bounds import MOST_METRES, MOST_SECONDS
from stmc.io.untrusted import quote
from stmc.motion.body import JOINTS
from stmc.motion.geometry import heading
from stmc.motion.motion import Motion
from stmc.settings.records import SettingError

RAMP = 0.3
"""Seconds over which a correction fades in, and out."""
Place = tuple[float, float, float, float]
"""The start of a motion: x, y and z of the pelvis in metres, and the heading in radians."""


@dataclass(frozen=True, eq=False)
class Pose:
    """A body over time, as tensors that may carry gradients: a `Motion` without checks."""

    rotations: Float[Tensor, "frames 22 3 3"]
    translation: Float[Tensor, "frames 3"]
    joints: Float[Tensor, "frames 24 3"]
    fps: float | int

    @classmethod
    def of(cls, motion: Motion) -> Pose:
        """Return the pose of a motion."""
        return cls(motion.rotations, motion.translation, motion.joints, motion.fps)

    @cached_property
    def heading(self) -> Float[Tensor, " frames"]:
        """The heading, as in `Motion`."""
        return heading(self.rotations[:, 0])

    def joint(self, name: str) -> Float[Tensor, "frames 3"]:
        """Return the path of one joint."""
        return self.joints[:, JOINTS.index(name)]

    def frames_of(self, start: float | int, end: float | int | None) -> slice:
        """Return the frames from `start` to `end` seconds (None: to the end), at least one if the motion has it."""
        first = int(start * self.fps)
        last = len(self.translation) if end is None else max(first + 1, int(end * self.fps))
        return slice(min(first, len(self.translation)), min(last, len(self.translation)))


def check_span(name: str, start: float | int, end: float | int | None) -> None:
    """Raise `SettingError` unless the times are numbers from 0 to `MOST_SECONDS`, in order.

    Args:
        name: Name of the constraint, for the message.
        start: Start in seconds.
        end: End in seconds, or None.
    """
    times = (start,) if end is None else (start, end)
    if not all(isinstance(time, (int, float)) and 0 <= time <= MOST_SECONDS for time in times) or times[-1] < start:
        span = "..".join(map(quote, times))
        raise SettingError(f"{name} at {span} s: must be from 0 to {MOST_SECONDS:,} s, in order")


def check_numbers(name: str, values: Any, width: int) -> tuple:
    """Convert values to a tuple of floats.

    Args:
        name: Name of the values, for the message.
        values: Numbers of at most `MOST_METRES` in absolute value.
        width: Number of values.

    Raises:
        SettingError: For anything else.
    """
    try:
        numbers = tuple(float(value) for value in values)
    except (TypeError, ValueError, OverflowError):
        numbers = ()
    if len(numbers) != width or not all(abs(number) <= MOST_METRES for number in numbers):
        raise SettingError(f"{name}={quote(values)}: must be {width} finite numbers, at most {MOST_METRES:g} from 0")
    return numbers


def bump(frames: int, span: slice, ramp: int, like: Tensor) -> Float[Tensor, " frames"]:
    """Make weights of 1 within a span that fall smoothly to 0 over a ramp on both sides.

    Args:
        frames: Number of frames.
        span: Frames with weight 1.
        ramp: Frames of the ramp.
        like: Tensor with the dtype and the device of the result.
    """
    frame = torch.arange(frames, device=like.device)
    outside = torch.maximum(span.start - frame, frame - (span.stop - 1)).clamp(min=0)
    fraction = (outside / (ramp + 1)).clamp(max=1).to(like)
    return 0.5 + 0.5 * torch.cos(math.pi * fraction)
