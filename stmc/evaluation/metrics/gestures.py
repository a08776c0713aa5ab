"""Positions and movements of hands and head relative to the trunk: reaches, swings, holds and looks.

Measures of one `Motion`, in metres, seconds and radians. The axes of a body part are SMPL's: x to the left, y up, z
forwards. Independent of texts, data sets and models.
"""

from __future__ import annotations

import math
from typing import Literal

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from stmc.evaluation.metrics.action_measures import stretches
from stmc.motion.body import JOINTS, NUM_ROTATIONS, PARENTS
from stmc.motion.geometry import global_rotations, wrap
from stmc.motion.kinematics import joint
from stmc.motion.motion import Motion

Frame = Literal["chest", "head"]

_AXES = {"chest": "spine3", "head": "head"}

MOUTH = ((-0.02, -0.16, 0.10), (0.12, 0.08, 0.31))
BITE = ((-0.03, -0.14, 0.08), (0.12, 0.06, 0.26))
EAR = ((0.09, -0.09, -0.02), (0.26, 0.12, 0.14))
NAPE = ((-0.08, -0.06, -0.25), (0.22, 0.20, 0.00))
"""Corners of boxes, in the axes of the head, that contain the left wrist if the hand holds a cup or a bite at the
mouth, holds a phone at the ear, or touches the back of the head. The wrist of a hand with a bottle is up to 30 cm from
the head joint, which is at the base of the skull."""

Box = tuple[tuple[float, float, float], tuple[float, float, float]]


def relative_path(motion: Motion, name: str, frame: Frame) -> Float[Tensor, "frames 3"]:
    """Return the path of a joint in the axes of the chest or the head.

    The origin is the midpoint of the shoulders for "chest", and the head joint for "head".

    Args:
        motion: The motion.
        name: Name of the joint.
        frame: "chest" or "head".
    """
    axes = global_rotations(motion.rotations, PARENTS[:NUM_ROTATIONS])[:, JOINTS.index(_AXES[frame])]
    origin = joint(motion, "head")
    if frame == "chest":
        origin = (joint(motion, "left_shoulder") + joint(motion, "right_shoulder")) / 2
    return ((joint(motion, name) - origin)[:, None] @ axes)[:, 0]


def is_in_box(motion: Motion, box: Box) -> Bool[Tensor, " frames"]:
    """Return whether the left wrist is in a box relative to the head."""
    wrist = relative_path(motion, "left_wrist", "head")
    low, high = (wrist.new_tensor(corner) for corner in box)
    return ((wrist > low) & (wrist < high)).all(dim=1)


def visits(
    near: Bool[Tensor, " frames"], fps: float | int, least: float | int, apart: float | int
) -> list[tuple[int, int]]:
    """Return the first frame and the exclusive last frame of each stay.

    Args:
        near: True during a stay, [frames].
        fps: Frames per second.
        least: Minimum duration of a stay in seconds.
        apart: Stays closer than this, in seconds, are merged.
    """
    stays: list[tuple[int, int]] = []
    for first, last in stretches(near):
        if stays and first - stays[-1][1] < apart * fps:
            stays[-1] = (stays[-1][0], last)
        else:
            stays.append((first, last))
    return [(first, last) for first, last in stays if last - first >= least * fps]


def longest(mask: Bool[Tensor, " frames"], fps: float | int) -> float:
    """Return the duration in seconds of the longest run of True."""
    return max((last - first for first, last in stretches(mask)), default=0) / fps


def reversals(values: Float[Tensor, " frames"], extent: float | int) -> int:
    """Count the movements of `values` by at least `extent` in either direction; to and fro are two."""
    count, direction, low, high = 0, 0, math.inf, -math.inf
    for value in values.tolist():
        low, high = min(low, value), max(high, value)
        if direction <= 0 and value - low >= extent:
            count, direction, high = count + 1, 1, value
        elif direction >= 0 and high - value >= extent:
            count, direction, low = count + 1, -1, value
    return count


def extension(motion: Motion, side: str) -> Float[Tensor, " frames"]:
    """Return the distance of a wrist from its shoulder divided by the length of the arm: 1 for a straight arm."""
    shoulder, elbow, wrist = (joint(motion, f"{side}_{name}") for name in ("shoulder", "elbow", "wrist"))
    bones = (elbow - shoulder).norm(dim=-1) + (wrist - elbow).norm(dim=-1)
    return (wrist - shoulder).norm(dim=-1) / bones


def elevation(motion: Motion, start: str, end: str) -> Float[Tensor, " frames"]:
    """Return the angle in radians by which the line between two joints rises above the horizontal.

    Args:
        motion: The motion.
        start: Name of the first joint.
        end: Name of the second joint.
    """
    line = joint(motion, end) - joint(motion, start)
    return torch.atan2(line[:, 2], line[:, :2].norm(dim=-1))


def hand_gap(motion: Motion) -> Float[Tensor, " frames"]:
    """Return the distance between the wrists in metres."""
    return (joint(motion, "left_wrist") - joint(motion, "right_wrist")).norm(dim=-1)


def hand_speed(motion: Motion, side: str) -> Float[Tensor, " _"]:
    """Return the speed of a wrist relative to the chest in m/s; one frame shorter."""
    return relative_path(motion, f"{side}_wrist", "chest").diff(dim=0).norm(dim=-1) * motion.fps


def gaze(motion: Motion) -> Float[Tensor, "frames 2"]:
    """Return the angles in radians by which the head faces to the left of the chest, and above its direction."""
    world = global_rotations(motion.rotations, PARENTS[:NUM_ROTATIONS])
    ahead = (world[:, JOINTS.index("spine3")].mT @ world[:, JOINTS.index("head")])[..., 2]
    return torch.stack([torch.atan2(ahead[:, 0], ahead[:, 2]), torch.asin(ahead[:, 1].clamp(-1, 1))], dim=1)


def head_turn_left(motion: Motion) -> Float[Tensor, " frames"]:
    """Return the angle in radians that the head has turned left in the world since its rightmost direction so far."""
    ahead = global_rotations(motion.rotations, PARENTS[:NUM_ROTATIONS])[:, JOINTS.index("head"), :, 2]
    angle = torch.atan2(ahead[:, 1], ahead[:, 0])
    steps = wrap(angle.diff())
    turn = torch.cat([steps.new_zeros(1), steps.cumsum(dim=0)])
    return turn - turn.cummin(dim=0).values
