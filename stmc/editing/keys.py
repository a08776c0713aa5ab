"""Keys of authored movement: times of arrival, durations, and minimum-jerk interpolation."""

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

    The profile has minimum jerk (Flash and Hogan 1985). A `skew` above 1 moves the fastest moment earlier (fast out,
    slow in), below 1 later. A movement that begins before the previous one has arrived takes over smoothly, and the
    previous goal is not reached. Raises `ValueError` unless `takes` is positive and `skew` is at least 0.7 and below 5;
    with less, a movement would stop with a jolt.
    """

    time: float | int
    takes: float | int
    skew: float | int = 1.0

    def __post_init__(self) -> None:
        if not self.takes > 0:
            raise ValueError(f"takes={self.takes}: must be a positive number of seconds")
        if not 0.7 <= self.skew < 5:
            raise ValueError(f"skew={self.skew}: must be from 0.7 to 5; 1 is symmetric")

    def progress(self, seconds: Float[Tensor, " frames"]) -> Float[Tensor, " frames"]:
        """Compute the progress at each time: exactly 0 until the movement begins, exactly 1 once it has arrived."""
        phase = ((seconds - (self.time - self.takes)) / self.takes).clamp(0, 1)
        return minimum_jerk(1 - (1 - phase) ** self.skew)


@runtime_checkable
class Timed(Protocol):
    """A key that arrives at a `time` in seconds."""

    @property
    def time(self) -> float | int: ...


def check_order(keys: Sequence[Timed]) -> None:
    """Raise `ValueError` unless keys are in the order of their times."""
    times = [key.time for key in keys]
    if times != sorted(times):
        raise ValueError(f"keys arrive at {times} seconds: sort them by time")


def minimum_jerk(phase: Float[Tensor, " *frames"]) -> Float[Tensor, " *frames"]:
    """Compute the minimum-jerk progress 10x³ - 15x⁴ + 6x⁵ after a fraction x of the time."""
    return phase**3 * (10 - 15 * phase + 6 * phase**2)


def frame_times(motion: Motion) -> Float[Tensor, " frames"]:
    """Return the time of each frame in seconds (float64, CPU)."""
    return torch.arange(motion.frames, dtype=torch.float64) / motion.fps


def blend_keys(
    seconds: Float[Tensor, " frames"], timings: Sequence[Timing], values: Sequence[Sequence[float | int]], width: int
) -> Float[Tensor, "frames width"]:
    """Interpolate from zero to the values of each key in turn.

    Args:
        seconds: Time of each frame.
        timings: Timing of each key.
        values: Values of each key.
        width: Number of values per key.
    """
    blend = torch.zeros(len(seconds), width, dtype=seconds.dtype)
    for timing, value in zip(timings, values, strict=True):
        fraction = timing.progress(seconds)[:, None]
        blend = blend * (1 - fraction) + blend.new_tensor(value) * fraction
    return blend


def replace_frames(
    motion: Motion, edited: Motion, joints: Sequence[int], changed: Bool[Tensor, " frames"], path: bool = False
) -> Motion:
    """Copy some joints of some frames from an edited motion; every other value stays exactly the same.

    Args:
        motion: Original motion.
        edited: Edited motion.
        joints: Indices into `body.JOINTS` of the joints to copy.
        changed: Whether to copy each frame.
        path: Whether to copy the translation of the pelvis too.
    """
    rotations, positions = motion.rotations.clone(), motion.joints.clone()
    translation = motion.translation.clone()
    mask = changed.to(positions.device)
    for joint in joints:
        positions[mask, joint] = edited.joints[changed, joint].to(positions)
        if joint < rotations.shape[1]:
            rotations[mask, joint] = edited.rotations[changed, joint].to(rotations)
    if path:
        translation[mask] = edited.translation[changed].to(translation)
    return Motion(rotations, translation, positions, motion.fps, motion.overlap)
