"""How legs carry a body: its pace, the curve of its path, jumps with both feet, turns on one foot, kicks.

Measures of one `Motion`, in metres, seconds and radians; left is positive. Knows no text, no data set and no model.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from stmc.evaluation.metrics.action_measures import OFF_THE_FLOOR, flights, joint_speed, toe_heights
from stmc.motion.geometry import wrap
from stmc.motion.kinematics import joint
from stmc.motion.motion import Motion

TOGETHER = 0.2
"""Seconds before a flight and after it in which both feet are on the floor, where a body jumps and does not run."""

TURNING = math.radians(12)
"""A turn begins and ends this far from where it leads."""


class Jump(NamedTuple):
    """Frames `[first, last)` in the air, and metres to the front and to the left by which the body is carried, from
    `TOGETHER` before the flight to as long after it."""

    first: int
    last: int
    forward: float
    left: float


def turned(motion: Motion) -> Float[Tensor, " frames"]:
    """The heading since the first frame, full turns counted, to the left positive."""
    steps = wrap(motion.heading.diff())
    return torch.cat([steps.new_zeros(1), steps.cumsum(dim=0)])


def to_the_left(motion: Motion, vectors: Float[Tensor, "frames 3"]) -> Float[Tensor, " frames"]:
    """How far vectors lead to the left of where the body faces."""
    ahead = motion.facing.to(vectors)
    return vectors[:, 1] * ahead[:, 0] - vectors[:, 0] * ahead[:, 1]


def path_length(motion: Motion, name: str = "pelvis") -> float:
    """Metres that a joint covers over the floor, tremors of less than a tenth of a second left out."""
    place = joint(motion, name)[:, :2]
    stride = max(1, round(motion.fps / 10))
    marks = torch.cat([place[::stride], place[-1:]])
    return float(marks.diff(dim=0).norm(dim=-1).sum())


def airborne(motion: Motion) -> float:
    """The share of the frames in which neither foot is on the floor: of a run a quarter or more, of a walk none."""
    return float((toe_heights(motion).amin(dim=1) > 0.05).float().mean())


def jumps_with_both_feet(motion: Motion) -> list[Jump]:
    """The flights before and after which both feet are on the floor."""
    down, slack = toe_heights(motion) < OFF_THE_FLOOR, round(TOGETHER * motion.fps)
    jumps = []
    for first, last in flights(motion):
        before, after = down[max(0, first - slack) : first], down[last : last + slack + 1]
        if bool(before.any(dim=0).all()) and bool(after.any(dim=0).all()):
            start, end = max(0, first - slack), min(last + slack, len(motion) - 1)
            way, ahead = motion.translation[end] - motion.translation[start], motion.facing[start]
            across = torch.stack([-ahead[1], ahead[0]])
            jumps.append(Jump(first, last, float(way[:2] @ ahead[:2]), float(way[:2] @ across)))
    return jumps


def rests_after(motion: Motion, frame: int, seconds: float | int = 0.8, speed: float | int = 0.6) -> bool:
    """Whether the pelvis moves over the floor more slowly than `speed` on average, from 0.3 seconds after a frame on;
    true where the motion ends before."""
    first = frame + round(0.3 * motion.fps)
    after = joint_speed(motion, "pelvis")[first : first + round(seconds * motion.fps)]
    return len(after) < 3 or float(after.mean()) < speed


def pivots(motion: Motion, side: str, still: float | int = 0.05, other_path: float | int = 0.35) -> bool:
    """Whether, while the body turns, the ball of one foot stays within `still` metres and the other foot covers
    `other_path` metres at least, from 0.3 seconds before the turn to as long after it. Half a circle about the ball of
    a foot is 0.4 metres for the other one, where the feet are as far apart as the hips."""
    angle, slack = turned(motion), round(0.3 * motion.fps)
    inside = ((angle.abs() > TURNING) & ((angle[-1] - angle).abs() > TURNING)).nonzero()[:, 0]
    if not len(inside):
        return False
    first, last = int(inside[0]), int(inside[-1]) + 1
    ball, other = joint(motion, f"{side}_foot")[first:last, :2], "right" if side == "left" else "left"
    drift = (ball - ball.median(dim=0).values).norm(dim=-1).max()
    around = motion.trimmed(max(0, first - slack), min(last + slack, len(motion)))
    return bool(drift < still) and path_length(around, f"{other}_foot") > other_path


def kick_height(motion: Motion, side: str, speed: float | int = 3.0) -> float:
    """Metres above the lowest point of both feet that an ankle reaches in front of the body or beside it, stretched
    out, about the time when it is faster than `speed` beside the pelvis; 0 where it never is.

    The other foot is on the floor, and the foot is up for less than 1.5 seconds.
    """
    ankle, pelvis = joint(motion, f"{side}_ankle"), joint(motion, "pelvis")
    other = toe_heights(motion)[:, 1 if side == "left" else 0]
    away = ankle - pelvis
    out = (away[:, :2].norm(dim=-1) > 0.3) & ((away * motion.facing).sum(dim=-1) > -0.1) & (other < 0.15)
    slack = max(1, round(0.15 * motion.fps))
    fast = joint_speed(motion, f"{side}_ankle", beside="pelvis") > speed
    fast = torch.nn.functional.pad(fast.float(), (0, 1))[None]
    near = torch.nn.functional.max_pool1d(fast, 2 * slack + 1, stride=1, padding=slack)[0] > 0
    heights = ankle[:, 2] - min(float(joint(motion, f"{each}_foot")[:, 2].min()) for each in ("left", "right"))
    return float(torch.where(out & near, heights, torch.zeros_like(heights)).max())
