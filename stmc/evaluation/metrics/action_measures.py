"""Measures of actions from joints: jumping, sitting down, leaning, reaching and waving."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from stmc.motion.kinematics import forward_speed, joint, swings, wrist_height
from stmc.motion.motion import Motion

SEATED, UPRIGHT = 0.62, 0.75
"""Heights in metres: a person whose pelvis is below the first sits or squats, above the second stands."""
_STOOPED = math.radians(20)
"""Lean of the trunk above which a person is bent, as in a bow."""
OFF_THE_FLOOR, FLIGHT = 0.06, 0.12
"""Height in metres above the lowest point of both feet from which a foot is off the floor, and seconds with both feet
off the floor that make a jump."""

NEAR = 0.15
"""Distance in metres below the shoulder at which a wrist still counts as raised, if other parts may do something else.
"""


def pelvis_height(motion: Motion) -> Float[Tensor, " frames"]:
    """Return the height of the pelvis above the floor in metres."""
    return motion.translation[:, 2]


def toe_heights(motion: Motion) -> Float[Tensor, "frames 2"]:
    """Return the heights of the left and right toes above the lowest point of both."""
    heights = torch.stack([joint(motion, "left_foot")[:, 2], joint(motion, "right_foot")[:, 2]], dim=1)
    return heights - heights.min()


def joint_speed(motion: Motion, name: str, beside: str | None = None) -> Float[Tensor, " frames"]:
    """Return the speed of a joint in m/s, in the world or relative to another joint; one frame shorter.

    Args:
        motion: The motion.
        name: Name of the joint.
        beside: Name of the reference joint; None measures in the world.
    """
    position = joint(motion, name) - (joint(motion, beside) if beside else 0.0)
    return position.diff(dim=0).norm(dim=-1) * motion.fps


def stretches(mask: Bool[Tensor, " frames"]) -> list[tuple[int, int]]:
    """Return the first frame and the exclusive last frame of each run of True."""
    edges = torch.nn.functional.pad(mask.int(), (1, 1)).diff()
    return list(zip((edges > 0).nonzero()[:, 0].tolist(), (edges < 0).nonzero()[:, 0].tolist(), strict=True))


def flights(motion: Motion) -> list[tuple[int, int]]:
    """Return the spans in which neither foot is on the floor, long enough for a jump."""
    runs = stretches(toe_heights(motion).amin(dim=1) > OFF_THE_FLOOR)
    return [(first, last) for first, last in runs if last - first >= FLIGHT * motion.fps]


def jumps(motion: Motion) -> bool:
    """Return whether both feet leave the floor together and the motion ends on the floor."""
    return bool(flights(motion)) and lands(motion)


def lands(motion: Motion) -> bool:
    """Return whether a foot stands on the floor in one of the last three frames."""
    return bool((toe_heights(motion)[-3:] < OFF_THE_FLOOR).any())


def displacement(motion: Motion) -> float:
    """Return the horizontal distance between the first and last position of the pelvis, in metres."""
    return float((motion.translation[-1] - motion.translation[0])[:2].norm())


def cycles(values: Float[Tensor, " frames"], extent: float) -> int:
    """Count the rises of `values` by at least `extent`, at first or after a fall by as much."""
    count, rising, low, high = 0, True, math.inf, -math.inf
    for value in values.tolist():
        low, high = min(low, value), max(high, value)
        if rising and value - low >= extent:
            count, rising, high = count + 1, False, value
        elif not rising and high - value >= extent:
            rising, low = True, value
    return count


def stays(motion: Motion) -> bool:
    """Return whether a person stays upright in place, with nearly still hands.

    The pelvis stays upright and within 10 cm, and the trunk leans by less than 20 degrees in half of the frames.
    """
    drift = (motion.translation[:, :2] - motion.translation[:1, :2]).norm(dim=-1).max()
    hands = max(float(joint_speed(motion, f"{side}_wrist").mean()) for side in ("left", "right"))
    upright = bool((pelvis_height(motion) > UPRIGHT).all()) and float(lean(motion).norm(dim=-1).median()) < _STOOPED
    return bool(drift < 0.1) and hands < 0.3 and upright


def goes_low(motion: Motion, first: bool, last: bool) -> bool:
    """Return whether a person sits or squats at some time, and is upright at the ends as specified.

    Args:
        motion: The motion.
        first: Whether the person stands upright in the first quarter second.
        last: Whether the person stands upright in the last quarter second.
    """
    height, frames = pelvis_height(motion), max(1, round(motion.fps / 4))
    ends = (bool((height[:frames] > UPRIGHT).any()), bool((height[-frames:] > UPRIGHT).any()))
    return bool((height < SEATED).any()) and ends == (first, last)


def lean(motion: Motion) -> Float[Tensor, "frames 2"]:
    """Return the lean of the trunk from the vertical in radians, forwards and sideways."""
    trunk = joint(motion, "neck") - motion.translation
    across = torch.linalg.cross(trunk.new_tensor([0.0, 0.0, 1.0]).expand_as(trunk), motion.facing.to(trunk))
    parts = [(trunk * axis).sum(dim=-1) for axis in (motion.facing.to(trunk), across)]
    return torch.stack([torch.atan2(part, trunk[:, 2]) for part in parts], dim=1)


def torsion(motion: Motion) -> Float[Tensor, " frames"]:
    """Return the angle in radians between the lines of the shoulders and of the hips, seen from above."""
    angles = []
    for name in ("shoulder", "hip"):
        line = joint(motion, f"left_{name}") - joint(motion, f"right_{name}")
        angles.append(torch.atan2(line[:, 1], line[:, 0]))
    difference = angles[0] - angles[1]
    return torch.atan2(torch.sin(difference), torch.cos(difference))


def forward_reach(motion: Motion, side: str) -> Float[Tensor, " frames"]:
    """Return the distance in metres of a wrist in front of its shoulder."""
    arm = joint(motion, f"{side}_wrist") - joint(motion, f"{side}_shoulder")
    return (arm * motion.facing.to(arm)).sum(dim=-1)


def thrusts(motion: Motion, side: str) -> int:
    """Count the times that a fist at chest height or above shoots forwards to a nearly straight arm."""
    reach, frames = forward_reach(motion, side), max(1, round(0.25 * motion.fps))
    high = joint(motion, f"{side}_wrist")[frames:, 2] > joint(motion, "spine3")[frames:, 2] - 0.05
    return len(stretches((reach[frames:] - reach[:-frames] > 0.22) & (reach[frames:] > 0.36) & high))


def mean_speed(motion: Motion) -> float:
    """Return the mean speed along the heading in m/s."""
    return float(forward_speed(motion).mean())


def lifts(motion: Motion, sides: Sequence[str]) -> bool:
    """Return whether each wrist of `sides` comes near or above the height of its shoulder at some time."""
    return all(bool((wrist_height(motion, side, "shoulder") > -NEAR).any()) for side in sides)


def waves(motion: Motion, sides: Sequence[str]) -> bool:
    """Return whether each forearm of `sides` swings at least three times while its wrist is above the elbow."""
    return all(swings(motion, side) >= 3 for side in sides)
