"""Frames of a stream as JSON objects: what `stmc stream` writes line by line, and the studio sends.

Depends on streams; independent of where frames go.
"""

from __future__ import annotations

from typing import Any

from stmc.editing.streaming import Frame, MotionStream
from stmc.motion.body import JOINTS, NUM_ROTATIONS, PARENTS
from stmc.motion.geometry import matrix_to_quaternion

_DECIMALS = 5
"""Of metres and of quaternions."""


def describe_stream(stream: MotionStream) -> dict[str, Any]:
    """Return the frame rate and the skeleton: 22 joints, their parents, and their places beside these at rest (m).

    Examples:
        >>> stmc.editing.stream_frames.describe_stream(stmc.load().stream())["parents"][:4]
        [-1, 0, 0, 0]
    """
    offsets = [_rounded(row) for row in stream.skeleton.offsets[:NUM_ROTATIONS].tolist()]
    skeleton = {"joints": list(JOINTS[:NUM_ROTATIONS]), "parents": list(PARENTS[:NUM_ROTATIONS]), "offsets": offsets}
    return {"fps": stream.fps, **skeleton}


def describe_frame(frame: Frame) -> dict[str, Any]:
    """Return a frame: the place of the pelvis (m, z up), and local quaternions [w, x, y, z] of 22 joints.

    Examples:
        >>> sorted(stmc.editing.stream_frames.describe_frame(next(stmc.load().stream(steps=1))))
        ['frame', 'root', 'rotations', 'seconds']
    """
    rotations = [_rounded(row) for row in matrix_to_quaternion(frame.rotations).tolist()]
    root = _rounded(frame.translation.tolist())
    return {"frame": frame.number, "seconds": round(frame.seconds, 4), "root": root, "rotations": rotations}


def _rounded(values: list[float]) -> list[float]:
    return [round(value, _DECIMALS) for value in values]
