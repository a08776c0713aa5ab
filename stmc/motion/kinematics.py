"""Kinematic measures of a body: its path, its turns, its hands and the sliding of its feet.

Measures of one `Motion` at a time, in metres, seconds and radians; independent of texts and models.
"""

from __future__ import annotations

import math

import torch
from jaxtyping import Float
from torch import Tensor

from stmc.motion.body import JOINTS
from stmc.motion.geometry import wrap
from stmc.motion.motion import Motion

CONTACT_HEIGHT = 0.025
"""Height in metres above the floor from which a toe is not in contact with it (H of MANN)."""


def joint(motion: Motion, name: str) -> Float[Tensor, "frames 3"]:
    """Return the path of one joint. Raises `ValueError` with the legal names if the name is unknown."""
    if name not in JOINTS:
        raise ValueError(f"unknown joint {name!r}; choose from {', '.join(JOINTS)}")
    return motion.joints[:, JOINTS.index(name)]


def forward_speed(motion: Motion) -> Float[Tensor, " frames"]:
    """Return the speed of the pelvis along the heading in m/s, negative for backward motion; one frame shorter."""
    velocity = motion.translation.diff(dim=0) * motion.fps
    return (velocity * motion.facing[:-1]).sum(dim=-1)


def turn(motion: Motion) -> float:
    """Return the net change of the heading in radians, positive to the left, including full turns."""
    return float(wrap(motion.heading.diff()).sum())


def wrist_height(motion: Motion, side: str, above: str) -> Float[Tensor, " frames"]:
    """Return the height of a wrist above a joint of the same side.

    Args:
        motion: The motion.
        side: "left" or "right".
        above: "shoulder" or "elbow".
    """
    return joint(motion, f"{side}_wrist")[:, 2] - joint(motion, f"{side}_{above}")[:, 2]


def swings(motion: Motion, side: str, extent: float | int = 0.05) -> int:
    """Count the sideways swings, in either direction, of a forearm while its wrist is above the elbow.

    A swing counts when the wrist has moved at least `extent` metres, relative to the elbow and along the line of the
    shoulders, since the last turning point; one wave to and fro makes two.

    Args:
        motion: The motion.
        side: "left" or "right".
        extent: Minimum extent of a swing in metres.
    """
    raised = wrist_height(motion, side, "elbow") > 0
    across = joint(motion, "left_shoulder") - joint(motion, "right_shoulder")
    across = across / across.norm(dim=-1, keepdim=True)
    forearm = joint(motion, f"{side}_wrist") - joint(motion, f"{side}_elbow")
    position = (forearm * across).sum(dim=-1)
    count, direction, extreme = 0, 0, math.nan
    for value, up in zip(position.tolist(), raised.tolist(), strict=True):
        if not up:
            direction, extreme = 0, math.nan
            continue
        if math.isnan(extreme):
            extreme = value
        if direction * (value - extreme) >= 0 and direction:
            extreme = value
        elif abs(value - extreme) >= extent:
            count, direction, extreme = count + 1, 1 if value > extreme else -1, value
    return count


def hand_step(motion: Motion) -> float:
    """Return the largest movement of a wrist, relative to the pelvis, between consecutive frames.

    The unit is metres *per frame*, so that values of different frame rates are not comparable. 0 for a single frame.
    """
    wrists = torch.stack([joint(motion, f"{side}_wrist") for side in ("left", "right")], dim=1)
    steps = (wrists - joint(motion, "pelvis")[:, None]).diff(dim=0).norm(dim=-1)
    return float(steps.max()) if len(steps) else 0.0


def foot_sliding(motion: Motion, floor: float | int = 0.0) -> float:
    """Return the mean horizontal distance, in metres, that a toe moves per frame of contact with the floor.

    Frames count by their `contact_weights` above the `floor` (its height in metres). Feet that swing just above the
    floor, at two metres a second, therefore hardly count. NaN if no toe ever touches the floor.
    """
    feet = torch.stack([joint(motion, "left_foot"), joint(motion, "right_foot")], dim=1)
    contact = contact_weights(feet[..., 2] - floor)
    distance = feet[..., :2].diff(dim=0).norm(dim=-1)
    return float((distance * contact).sum() / contact.sum())


def contact_weights(height: Float[Tensor, "frames ..."]) -> Float[Tensor, "steps ..."]:
    """Return the weight of the contact with the floor in each step between consecutive frames.

    It falls from 1 on the floor to 0 at H = `CONTACT_HEIGHT` above it, as 2 - 2^(h / H) (the foot skating of MANN,
    Zhang et al. 2018); h is the height in this frame or in the next, whichever is higher.

    Args:
        height: Heights above the floor in metres.
    """
    height = torch.maximum(height[1:], height[:-1]).clamp(min=0)
    return (2 - 2 ** (height / CONTACT_HEIGHT)).clamp(min=0)


def floor_penetration(motion: Motion, floor: float | int = 0.0) -> float:
    """Return the mean depth of the lowest joint below `floor` over all frames, in metres; 0 if nothing is below."""
    return float((floor - motion.joints[..., 2].amin(dim=-1)).clamp(min=0).mean())


def diversity(motions: list[Motion]) -> float:
    """Return the mean distance of a joint between two motions, in metres, over all pairs, frames and joints.

    It measures how different samples of one timeline are. Joints are relative to the pelvis of the same frame and
    rotated to heading zero; motions are compared up to the end of the shorter one. Raises `ValueError` for fewer than
    two motions.
    """
    local = [local_joints(motion) for motion in motions]
    distances = [
        (first[: len(second)] - second[: len(first)]).norm(dim=-1).mean()
        for position, first in enumerate(local)
        for second in local[:position]
    ]
    if not distances:
        raise ValueError("diversity needs at least two motions")
    return float(torch.stack(distances).mean())


def local_joints(motion: Motion) -> Float[Tensor, "frames joints 3"]:
    """Return positions relative to the pelvis, rotated to heading zero in every frame: the pose alone, z up."""
    forward, up = motion.facing, torch.tensor([0.0, 0.0, 1.0], dtype=motion.joints.dtype)
    frame = torch.stack([forward, torch.linalg.cross(up.expand_as(forward), forward), up.expand_as(forward)], dim=-1)
    return (motion.joints - motion.joints[:, :1]) @ frame
