"""What a body does, read off its joints: whether it jumps, sits down, leans, reaches or waves.

Knows joints, metres and seconds; knows no data set, no text and no model.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from stmc.motion.kinematics import forward_speed, joint, swings, wrist_height
from stmc.motion.motion import Motion

SEATED, UPRIGHT = 0.62, 0.75
"""Metres: a pelvis below the one sits or squats, above the other it stands."""

_STOOPED = math.radians(20)
"""A trunk that leans by more than this is bent, as in a bow."""

OFF_THE_FLOOR, FLIGHT = 0.06, 0.12
"""A foot this far (metres) above the lowest point of both has left the floor; a body with both there for so many
seconds has jumped."""

NEAR = 0.15
"""Metres below the shoulder at which a wrist still counts as raised, where other parts may do something else."""


def pelvis_height(motion: Motion) -> Float[Tensor, " frames"]:
    """Metres above the floor."""
    return motion.translation[:, 2]


def toe_heights(motion: Motion) -> Float[Tensor, "frames 2"]:
    """Heights of the left and the right toes above the lowest point of both."""
    heights = torch.stack([joint(motion, "left_foot")[:, 2], joint(motion, "right_foot")[:, 2]], dim=1)
    return heights - heights.min()


def joint_speed(motion: Motion, name: str, beside: str | None = None) -> Float[Tensor, " frames"]:
    """Metres per second of a joint, or of its place beside another joint; one frame shorter."""
    place = joint(motion, name) - (joint(motion, beside) if beside else 0.0)
    return place.diff(dim=0).norm(dim=-1) * motion.fps


def stretches(mask: Bool[Tensor, " frames"]) -> list[tuple[int, int]]:
    """First and last frame (exclusive) of each run of True."""
    edges = torch.nn.functional.pad(mask.int(), (1, 1)).diff()
    return list(zip((edges > 0).nonzero()[:, 0].tolist(), (edges < 0).nonzero()[:, 0].tolist(), strict=True))


def flights(motion: Motion) -> list[tuple[int, int]]:
    """Frames in which neither foot is on the floor, long enough for a jump."""
    runs = stretches(toe_heights(motion).amin(dim=1) > OFF_THE_FLOOR)
    return [(first, last) for first, last in runs if last - first >= FLIGHT * motion.fps]


def jumps(motion: Motion) -> bool:
    """Whether both feet leave the floor together and the motion ends on it."""
    return bool(flights(motion)) and lands(motion)


def lands(motion: Motion) -> bool:
    """Whether some foot stands on the floor in one of the last three frames."""
    return bool((toe_heights(motion)[-3:] < OFF_THE_FLOOR).any())


def way(motion: Motion) -> float:
    """Metres between where the pelvis begins and where it ends, on the floor."""
    return float((motion.translation[-1] - motion.translation[0])[:2].norm())


def cycles(values: Float[Tensor, " frames"], extent: float) -> int:
    """How often `values` rise by at least `extent` after they fell by as much, or at first."""
    count, rising, low, high = 0, True, math.inf, -math.inf
    for value in values.tolist():
        low, high = min(low, value), max(high, value)
        if rising and value - low >= extent:
            count, rising, high = count + 1, False, value
        elif not rising and high - value >= extent:
            rising, low = True, value
    return count


def stays(motion: Motion) -> bool:
    """Whether an upright body stays where it is: the pelvis within 10 cm, feet down, the trunk leaning by less than 20
    degrees in half of the frames, hands all but still."""
    drift = (motion.translation[:, :2] - motion.translation[:1, :2]).norm(dim=-1).max()
    hands = max(float(joint_speed(motion, f"{side}_wrist").mean()) for side in ("left", "right"))
    upright = bool((pelvis_height(motion) > UPRIGHT).all()) and float(lean(motion).norm(dim=-1).median()) < _STOOPED
    return bool(drift < 0.1) and hands < 0.3 and upright


def goes_low(motion: Motion, first: bool, last: bool) -> bool:
    """Whether the body sits or squats at some time, and stands upright at the `first` and the `last` quarter second as
    told."""
    height, few = pelvis_height(motion), max(1, round(motion.fps / 4))
    ends = (bool((height[:few] > UPRIGHT).any()), bool((height[-few:] > UPRIGHT).any()))
    return bool((height < SEATED).any()) and ends == (first, last)


def lean(motion: Motion) -> Float[Tensor, "frames 2"]:
    """Radians by which the trunk leans forward, and to the side, from upright."""
    trunk = joint(motion, "neck") - motion.translation
    across = torch.linalg.cross(trunk.new_tensor([0.0, 0.0, 1.0]).expand_as(trunk), motion.facing.to(trunk))
    parts = [(trunk * axis).sum(dim=-1) for axis in (motion.facing.to(trunk), across)]
    return torch.stack([torch.atan2(part, trunk[:, 2]) for part in parts], dim=1)


def torsion(motion: Motion) -> Float[Tensor, " frames"]:
    """Radians by which the shoulders' line is turned against the hips', seen from above."""
    angles = []
    for name in ("shoulder", "hip"):
        line = joint(motion, f"left_{name}") - joint(motion, f"right_{name}")
        angles.append(torch.atan2(line[:, 1], line[:, 0]))
    difference = angles[0] - angles[1]
    return torch.atan2(torch.sin(difference), torch.cos(difference))


def forward_reach(motion: Motion, side: str) -> Float[Tensor, " frames"]:
    """Metres by which a wrist is in front of its shoulder."""
    arm = joint(motion, f"{side}_wrist") - joint(motion, f"{side}_shoulder")
    return (arm * motion.facing.to(arm)).sum(dim=-1)


def thrusts(motion: Motion, side: str) -> int:
    """How often a fist at the chest's height or above shoots forward to an almost straight arm."""
    reach, few = forward_reach(motion, side), max(1, round(0.25 * motion.fps))
    high = joint(motion, f"{side}_wrist")[few:, 2] > joint(motion, "spine3")[few:, 2] - 0.05
    return len(stretches((reach[few:] - reach[:-few] > 0.22) & (reach[few:] > 0.36) & high))


def mean_speed(motion: Motion) -> float:
    """Metres per second along the heading, over the whole motion."""
    return float(forward_speed(motion).mean())


def lifts(motion: Motion, sides: Sequence[str]) -> bool:
    """Whether the wrist of each of the `sides` comes near its shoulder's height or above it at some time."""
    return all(bool((wrist_height(motion, side, "shoulder") > -NEAR).any()) for side in sides)


def waves(motion: Motion, sides: Sequence[str]) -> bool:
    """Whether the forearm of each of the `sides` swings at least three times while the wrist is above the elbow."""
    return all(swings(motion, side) >= 3 for side in sides)
