"""Limits of a motion: frame rate, seconds, frames, and distance from the origin.

Functions that read, resample or write motions check these limits before they allocate arrays. Independent of files and
tensors.
"""

from __future__ import annotations

from stmc.io.untrusted import quote

LEAST_FPS, MOST_FPS = 1, 1000
"""Frames per second; motion capture has 20 to 250."""
MOST_SECONDS = 14_400
"""Seconds of a motion: four hours."""
MOST_FRAMES = 432_000
"""Frames of a motion: four hours at 30 frames per second, or one at 120. They take half a gigabyte in float32."""
MOST_COLUMNS = 200
"""Values per frame of a pose in a file; SMPL-X has 165."""
MOST_METRES = 10_000.0
"""Metres from the world's origin, along each axis."""

MOST_PICTURES = 1200
"""Pictures of an animated film: a minute at 20 frames per second. Pillow keeps them in memory, 0.8 MB each."""


class BoundsError(ValueError):
    """A motion that exceeds a limit; the message names the limit."""


def check_fps(fps: float | int) -> None:
    """Raise `BoundsError` unless the frame rate is from `LEAST_FPS` to `MOST_FPS`."""
    if not LEAST_FPS <= fps <= MOST_FPS:  # NaN is not
        raise BoundsError(f"fps must be from {LEAST_FPS} to {MOST_FPS}, not {quote(fps)}")


def check_frames(frames: float | int, fps: float | int) -> None:
    """Raise `BoundsError` for a frame rate outside the limits, or for more than `MOST_FRAMES` or `MOST_SECONDS`.

    `frames` may be fractional, as the product of seconds and a frame rate.
    """
    check_fps(fps)
    if frames > MOST_FRAMES:
        raise BoundsError(f"{quote(frames)} frames are more than {MOST_FRAMES:,}, the limit of a motion")
    if frames / fps > MOST_SECONDS:
        raise BoundsError(f"{quote(frames)} frames at {fps:g} fps last more than {MOST_SECONDS:,} s, the limit")


def check_pictures(kind: str, pictures: int) -> None:
    """Raise `BoundsError` if an animated film of the format `kind` has more than `MOST_PICTURES`."""
    if pictures > MOST_PICTURES:
        raise BoundsError(
            f"a .{kind} film has at most {MOST_PICTURES:,} pictures, not {pictures:,}; "
            "film as .mp4, at a lower frame rate, or in parts"
        )


def check_metres(name: str, largest: float) -> None:
    """Raise `BoundsError`, with `name` as the subject, if the largest coordinate is above `MOST_METRES`."""
    if not largest <= MOST_METRES:
        raise BoundsError(f"{name} is {largest:g} m from the origin; it must be at most {MOST_METRES:g} m")
