"""How large a motion may be: its frame rate, its seconds, its frames and the metres of its places.

Whoever reads a motion, resamples one or writes one asks here before an array exists. Knows no file and no tensor.
"""

from __future__ import annotations

from stmc.io.untrusted import shown

LEAST_FPS, MOST_FPS = 1, 1000
"""Frames per second; motion capture has 20 to 250."""

MOST_SECONDS = 14_400
"""Four hours."""

MOST_FRAMES = 432_000
"""Of a motion: four hours at 30 frames per second, or one at 120. They take half a gigabyte in float32."""

MOST_COLUMNS = 200
"""Numbers of a frame's pose in a file; SMPL-X has 165."""

MOST_METRES = 10_000.0
"""From the world's origin, along each axis."""


class BoundsError(ValueError):
    """A motion that is larger than any real one; the message says in which respect."""


def check_fps(fps: float | int) -> None:
    """Raise `BoundsError` unless a frame rate is from `LEAST_FPS` to `MOST_FPS`."""
    if not LEAST_FPS <= fps <= MOST_FPS:  # NaN is not
        raise BoundsError(f"fps must be from {LEAST_FPS} to {MOST_FPS}, not {shown(fps)}")


def check_frames(frames: float | int, fps: float | int) -> None:
    """Raise `BoundsError` for a frame rate that `check_fps` refuses, more than `MOST_FRAMES`, or more than
    `MOST_SECONDS`.

    `frames` may be a fraction, where it follows from seconds and a frame rate.
    """
    check_fps(fps)
    if frames > MOST_FRAMES:
        raise BoundsError(f"{shown(frames)} frames are more than {MOST_FRAMES:,}, the limit of a motion")
    if frames / fps > MOST_SECONDS:
        raise BoundsError(f"{shown(frames)} frames at {fps:g} fps last more than {MOST_SECONDS:,} s, the limit")


def check_metres(name: str, largest: float) -> None:
    """Raise `BoundsError`, which names the places, where the largest coordinate is above `MOST_METRES`."""
    if not largest <= MOST_METRES:
        raise BoundsError(f"{name} is {largest:g} m from the origin; it must be at most {MOST_METRES:g} m")
