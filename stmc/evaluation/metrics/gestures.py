"""Where hands and the head are beside the trunk, and how they move there: reaches, swings, holds, looks.

Measures of one `Motion`, in metres, seconds and radians. Axes of a body's part are SMPL's: x to the left, y up, z
forward. Knows no text, no data set and no model.
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
"""Corners of the boxes, in the axes of the head, in which a left wrist is whose hand holds a cup or a bite at the
mouth, a phone at the ear, or touches the back of the head. The wrist of a hand that holds a bottle is up to 30 cm from
the head joint, which is at the base of the skull."""

Box = tuple[tuple[float, float, float], tuple[float, float, float]]


def seen_from(motion: Motion, name: str, frame: Frame) -> Float[Tensor, "frames 3"]:
    """A joint's path in the axes of the "chest", from the middle between the shoulders, or of the "head", from its
    joint."""
    axes = global_rotations(motion.rotations, PARENTS[:NUM_ROTATIONS])[:, JOINTS.index(_AXES[frame])]
    origin = joint(motion, "head")
    if frame == "chest":
        origin = (joint(motion, "left_shoulder") + joint(motion, "right_shoulder")) / 2
    return ((joint(motion, name) - origin)[:, None] @ axes)[:, 0]


def within(motion: Motion, box: Box) -> Bool[Tensor, " frames"]:
    """Whether the left wrist is in a box beside the head."""
    wrist = seen_from(motion, "left_wrist", "head")
    low, high = (wrist.new_tensor(corner) for corner in box)
    return ((wrist > low) & (wrist < high)).all(dim=1)


def visits(
    near: Bool[Tensor, " frames"], fps: float | int, least: float | int, apart: float | int
) -> list[tuple[int, int]]:
    """First and last frame (exclusive) of each stay of at least `least` seconds; stays that are less than `apart`
    seconds from each other are one."""
    joined: list[tuple[int, int]] = []
    for first, last in stretches(near):
        if joined and first - joined[-1][1] < apart * fps:
            joined[-1] = (joined[-1][0], last)
        else:
            joined.append((first, last))
    return [(first, last) for first, last in joined if last - first >= least * fps]


def longest(mask: Bool[Tensor, " frames"], fps: float | int) -> float:
    """Seconds of the longest run of True."""
    return max((last - first for first, last in stretches(mask)), default=0) / fps


def reversals(values: Float[Tensor, " frames"], extent: float | int) -> int:
    """How often `values` move by at least `extent` one way or the other since they turned: to and fro are two."""
    count, direction, low, high = 0, 0, math.inf, -math.inf
    for value in values.tolist():
        low, high = min(low, value), max(high, value)
        if direction <= 0 and value - low >= extent:
            count, direction, high = count + 1, 1, value
        elif direction >= 0 and high - value >= extent:
            count, direction, low = count + 1, -1, value
    return count


def extension(motion: Motion, side: str) -> Float[Tensor, " frames"]:
    """How straight an arm is: the distance of its wrist from its shoulder over the length of its bones, at most 1."""
    shoulder, elbow, wrist = (joint(motion, f"{side}_{name}") for name in ("shoulder", "elbow", "wrist"))
    bones = (elbow - shoulder).norm(dim=-1) + (wrist - elbow).norm(dim=-1)
    return (wrist - shoulder).norm(dim=-1) / bones


def elevation(motion: Motion, start: str, end: str) -> Float[Tensor, " frames"]:
    """Radians by which the line from one joint to another rises above the horizontal."""
    line = joint(motion, end) - joint(motion, start)
    return torch.atan2(line[:, 2], line[:, :2].norm(dim=-1))


def hand_gap(motion: Motion) -> Float[Tensor, " frames"]:
    """Metres between the wrists."""
    return (joint(motion, "left_wrist") - joint(motion, "right_wrist")).norm(dim=-1)


def hand_speed(motion: Motion, side: str) -> Float[Tensor, " _"]:
    """Metres per second of a wrist as the chest sees it; one frame shorter."""
    return seen_from(motion, f"{side}_wrist", "chest").diff(dim=0).norm(dim=-1) * motion.fps


def gaze(motion: Motion) -> Float[Tensor, "frames 2"]:
    """Radians by which the head is turned to the left of the chest, and raised above where the chest faces."""
    world = global_rotations(motion.rotations, PARENTS[:NUM_ROTATIONS])
    ahead = (world[:, JOINTS.index("spine3")].mT @ world[:, JOINTS.index("head")])[..., 2]
    return torch.stack([torch.atan2(ahead[:, 0], ahead[:, 2]), torch.asin(ahead[:, 1].clamp(-1, 1))], dim=1)


def looked_left(motion: Motion) -> Float[Tensor, " frames"]:
    """Radians by which the head has turned to the left in the world since it looked furthest to the right before."""
    ahead = global_rotations(motion.rotations, PARENTS[:NUM_ROTATIONS])[:, JOINTS.index("head"), :, 2]
    angle = torch.atan2(ahead[:, 1], ahead[:, 0])
    steps = wrap(angle.diff())
    turned = torch.cat([steps.new_zeros(1), steps.cumsum(dim=0)])
    return turned - turned.cummin(dim=0).values
