"""Keys of authored movement: when a limb arrives, how long it takes to get there, and minimum jerk on the way.

Knows times and values; knows no body.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from stmc.motion.motion import Motion


@dataclass(frozen=True)
class Timing:
    """A movement that arrives at `time` and takes `takes` seconds to get there.

    Its pace has minimum jerk (Flash and Hogan 1985); with a `skew` above 1 the fastest moment comes earlier (fast out,
    slow in), below 1 later. A movement that begins before the one before it has arrived takes over smoothly: the
    earlier goal is passed by rather than met. Raises `ValueError` unless `takes` and `skew` are positive and `skew` is
    at least 0.7, below which a movement would stop with a jolt.
    """

    time: float | int
    takes: float | int
    skew: float | int = 1.0

    def __post_init__(self) -> None:
        if not self.takes > 0:
            raise ValueError(f"takes={self.takes}: a movement takes a positive number of seconds")
        if not 0.7 <= self.skew < 5:
            raise ValueError(f"skew={self.skew}: must be from 0.7 to 5; 1 is symmetric")

    def progress(self, seconds: Float[Tensor, " frames"]) -> Float[Tensor, " frames"]:
        """The fraction of the way at each time: exactly 0 until it begins, and exactly 1 once it has arrived."""
        phase = ((seconds - (self.time - self.takes)) / self.takes).clamp(0, 1)
        return minimum_jerk(1 - (1 - phase) ** self.skew)


@runtime_checkable
class Timed(Protocol):
    """Anything that arrives at a `time` in seconds."""

    @property
    def time(self) -> float | int: ...


def check_order(keys: Sequence[Timed]) -> None:
    """Raise `ValueError` for keys that are not in the order of their times."""
    times = [key.time for key in keys]
    if times != sorted(times):
        raise ValueError(f"keys arrive at {times} seconds: put them in the order of their times")


def minimum_jerk(phase: Float[Tensor, " *frames"]) -> Float[Tensor, " *frames"]:
    """The fraction of the way after a fraction of the time, of the movement with the least jerk: 10x³ - 15x⁴ + 6x⁵."""
    return phase**3 * (10 - 15 * phase + 6 * phase**2)


def frame_times(motion: Motion) -> Float[Tensor, " frames"]:
    """The second of each frame (float64, CPU)."""
    return torch.arange(motion.frames, dtype=torch.float64) / motion.fps


def blended(
    seconds: Float[Tensor, " frames"], timings: Sequence[Timing], values: Sequence[Sequence[float | int]], width: int
) -> Float[Tensor, "frames width"]:
    """Values over time that begin at zero and move to those of each key in turn."""
    blend = torch.zeros(len(seconds), width, dtype=seconds.dtype)
    for timing, value in zip(timings, values, strict=True):
        fraction = timing.progress(seconds)[:, None]
        blend = blend * (1 - fraction) + blend.new_tensor(value) * fraction
    return blend


def replace_frames(
    motion: Motion, edited: Motion, joints: Sequence[int], changed: Bool[Tensor, " frames"], path: bool = False
) -> Motion:
    """`motion` with the rotations and positions of `joints` as `edited` has them in the frames that are `changed`, and
    all else to the last digit; with `path`, the pelvis' too. `joints` are indexes of `body.JOINTS`."""
    rotations, positions = motion.rotations.clone(), motion.joints.clone()
    translation = motion.translation.clone()
    where = changed.to(positions.device)
    for joint in joints:
        positions[where, joint] = edited.joints[changed, joint].to(positions)
        if joint < rotations.shape[1]:
            rotations[where, joint] = edited.rotations[changed, joint].to(rotations)
    if path:
        translation[where] = edited.translation[changed].to(translation)
    return Motion(rotations, translation, positions, motion.fps, motion.overlap)
