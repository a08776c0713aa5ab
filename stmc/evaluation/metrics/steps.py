"""Locomotion: pace, curve of the path, jumps with both feet, turns on one foot, and kicks.

Measures of one `Motion`, in metres, seconds and radians; left is positive. Independent of texts, data sets and models.
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

TAKE_OFF_SECONDS = 0.2
"""Seconds before and after a flight within which both feet are on the floor if a person jumps and does not run."""
TURN_MARGIN = math.radians(12)
"""Angle from the initial and final heading at which a turn begins and ends."""


class Jump(NamedTuple):
    """Frames `[first, last)` in the air, and distances in metres that the body moves forwards and to the left.

    The distances are measured from `TAKE_OFF_SECONDS` before the flight to as long after it.
    """

    first: int
    last: int
    forward: float
    left: float


def heading_change(motion: Motion) -> Float[Tensor, " frames"]:
    """Return the heading relative to the first frame, including full turns, positive to the left."""
    steps = wrap(motion.heading.diff())
    return torch.cat([steps.new_zeros(1), steps.cumsum(dim=0)])


def to_the_left(motion: Motion, vectors: Float[Tensor, "frames 3"]) -> Float[Tensor, " frames"]:
    """Return the component of vectors to the left of the heading."""
    ahead = motion.facing.to(vectors)
    return vectors[:, 1] * ahead[:, 0] - vectors[:, 0] * ahead[:, 1]


def path_length(motion: Motion, name: str = "pelvis") -> float:
    """Return the distance in metres that a joint covers over the floor, without tremors below a tenth of a second."""
    position = joint(motion, name)[:, :2]
    stride = max(1, round(motion.fps / 10))
    marks = torch.cat([position[::stride], position[-1:]])
    return float(marks.diff(dim=0).norm(dim=-1).sum())


def airborne_fraction(motion: Motion) -> float:
    """Return the fraction of frames with neither foot on the floor: a quarter or more of a run, none of a walk."""
    return float((toe_heights(motion).amin(dim=1) > 0.05).float().mean())


def jumps_with_both_feet(motion: Motion) -> list[Jump]:
    """Return the flights before and after which both feet are on the floor."""
    down, slack = toe_heights(motion) < OFF_THE_FLOOR, round(TAKE_OFF_SECONDS * motion.fps)
    jumps = []
    for first, last in flights(motion):
        before, after = down[max(0, first - slack) : first], down[last : last + slack + 1]
        if bool(before.any(dim=0).all()) and bool(after.any(dim=0).all()):
            start, end = max(0, first - slack), min(last + slack, len(motion) - 1)
            offset, ahead = motion.translation[end] - motion.translation[start], motion.facing[start]
            across = torch.stack([-ahead[1], ahead[0]])
            jumps.append(Jump(first, last, float(offset[:2] @ ahead[:2]), float(offset[:2] @ across)))
    return jumps


def rests_after(motion: Motion, frame: int, seconds: float | int = 0.8, speed: float | int = 0.6) -> bool:
    """Return whether the pelvis moves more slowly than `speed` on average, from 0.3 seconds after a frame on.

    The result is True if the motion ends before that.

    Args:
        motion: The motion.
        frame: The frame.
        seconds: Duration of the average in seconds.
        speed: Maximum speed in m/s.
    """
    first = frame + round(0.3 * motion.fps)
    after = joint_speed(motion, "pelvis")[first : first + round(seconds * motion.fps)]
    return len(after) < 3 or float(after.mean()) < speed


def pivots(motion: Motion, side: str, still: float | int = 0.05, other_path: float | int = 0.35) -> bool:
    """Return whether a turn is a pivot: the ball of one foot stays still while the other foot moves around it.

    The other foot is measured from 0.3 seconds before the turn to as long after it. Half a circle about the ball of a
    foot is 0.4 metres for the other foot, if the feet are as far apart as the hips.

    Args:
        motion: The motion.
        side: Side of the still foot.
        still: Maximum drift of its ball in metres.
        other_path: Minimum path of the other foot in metres.
    """
    angle, slack = heading_change(motion), round(0.3 * motion.fps)
    inside = ((angle.abs() > TURN_MARGIN) & ((angle[-1] - angle).abs() > TURN_MARGIN)).nonzero()[:, 0]
    if not len(inside):
        return False
    first, last = int(inside[0]), int(inside[-1]) + 1
    ball, other = joint(motion, f"{side}_foot")[first:last, :2], "right" if side == "left" else "left"
    drift = (ball - ball.median(dim=0).values).norm(dim=-1).max()
    around = motion.trimmed(max(0, first - slack), min(last + slack, len(motion)))
    return bool(drift < still) and path_length(around, f"{other}_foot") > other_path


def kick_height(motion: Motion, side: str, speed: float | int = 3.0) -> float:
    """Return the height in metres that an ankle reaches in a kick, above the lowest point of both feet.

    The height is 0 without a kick. In a kick the leg is stretched out in front of the body or beside it, about the time
    when the ankle is faster than `speed` relative to the pelvis. The other foot is on the floor.

    Args:
        motion: The motion.
        side: Side of the kicking leg.
        speed: Minimum speed of the ankle in m/s.
    """
    ankle, pelvis = joint(motion, f"{side}_ankle"), joint(motion, "pelvis")
    other = toe_heights(motion)[:, 1 if side == "left" else 0]
    offset = ankle - pelvis
    stretched = (offset[:, :2].norm(dim=-1) > 0.3) & ((offset * motion.facing).sum(dim=-1) > -0.1) & (other < 0.15)
    slack = max(1, round(0.15 * motion.fps))
    fast = joint_speed(motion, f"{side}_ankle", beside="pelvis") > speed
    fast = torch.nn.functional.pad(fast.float(), (0, 1))[None]
    near = torch.nn.functional.max_pool1d(fast, 2 * slack + 1, stride=1, padding=slack)[0] > 0
    heights = ankle[:, 2] - min(float(joint(motion, f"{foot}_foot")[:, 2].min()) for foot in ("left", "right"))
    return float(torch.where(stretched & near, heights, torch.zeros_like(heights)).max())
