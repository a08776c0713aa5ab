"""What a body does, read off its joints: where it goes, how it turns, what its hands are at, whether its feet slide.

Measures of one `Motion` at a time, in metres, seconds and radians; knows no text, no model and no other motion.
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
"""Metres above the floor from which on a toe is not in contact with it (MANN's H)."""


def joint(motion: Motion, name: str) -> Float[Tensor, "frames 3"]:
    """The path of one joint. Raises `ValueError` with the names there are for an unknown one."""
    if name not in JOINTS:
        raise ValueError(f"unknown joint {name!r}; choose from {', '.join(JOINTS)}")
    return motion.joints[:, JOINTS.index(name)]


def forward_speed(motion: Motion) -> Float[Tensor, " frames"]:
    """Metres per second of the pelvis along the heading, negative where it moves backwards; one frame shorter."""
    velocity = motion.translation.diff(dim=0) * motion.fps
    return (velocity * motion.facing[:-1]).sum(dim=-1)


def turn(motion: Motion) -> float:
    """Net change of the heading in radians, counter-clockwise (to the left) positive, full turns counted."""
    return float(wrap(motion.heading.diff()).sum())


def wrist_height(motion: Motion, side: str, above: str) -> Float[Tensor, " frames"]:
    """Height of the wrist of `side` ("left" or "right") above that side's joint `above` ("shoulder", "elbow")."""
    return joint(motion, f"{side}_wrist")[:, 2] - joint(motion, f"{side}_{above}")[:, 2]


def swings(motion: Motion, side: str, extent: float | int = 0.05) -> int:
    """How often the forearm of `side` swings sideways, one way or the other, while the wrist is above the elbow.

    A swing counts when the wrist has moved at least `extent` metres, relative to the elbow and along the shoulders'
    line, since the last turning point; so one wave to and fro makes two.
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
    """The furthest that a wrist moves, relative to the pelvis, from one frame to the next; metres *per frame*, so those
    of different frame rates do not compare. 0 for a single frame."""
    wrists = torch.stack([joint(motion, f"{side}_wrist") for side in ("left", "right")], dim=1)
    steps = (wrists - joint(motion, "pelvis")[:, None]).diff(dim=0).norm(dim=-1)
    return float(steps.max()) if len(steps) else 0.0


def foot_sliding(motion: Motion, floor: float | int = 0.0) -> float:
    """Mean horizontal way of a toe per frame of contact with the `floor` (its height, metres), in metres; NaN where
    no toe ever touches it.

    How much of a contact a frame is falls from 1 on the floor to 0 at H = `CONTACT_HEIGHT` above it, as 2 - 2^(h / H)
    (the foot skating of MANN, Zhang et al. 2018); h is the toe's height in this frame or in the next, whichever is
    higher. So feet that swing just above the floor, two metres a second, hardly count.
    """
    feet = torch.stack([joint(motion, "left_foot"), joint(motion, "right_foot")], dim=1)
    height = (torch.maximum(feet[1:, :, 2], feet[:-1, :, 2]) - floor).clamp(min=0)
    contact = (2 - 2 ** (height / CONTACT_HEIGHT)).clamp(min=0)
    way = feet[..., :2].diff(dim=0).norm(dim=-1)
    return float((way * contact).sum() / contact.sum())


def floor_penetration(motion: Motion, floor: float | int = 0.0) -> float:
    """Mean depth of the lowest joint below `floor` over all frames, in metres; 0 where nothing goes below."""
    return float((floor - motion.joints[..., 2].amin(dim=-1)).clamp(min=0).mean())


def diversity(motions: list[Motion]) -> float:
    """Mean distance of a joint between two of the motions, in metres, over all pairs, frames and joints.

    Joints are relative to the pelvis of the same frame and turned to heading zero; motions are compared up to the end
    of the shorter. How different samples of one timeline are.
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
    """Positions relative to the pelvis, turned to heading zero in every frame: the pose alone, z up."""
    forward, up = motion.facing, torch.tensor([0.0, 0.0, 1.0], dtype=motion.joints.dtype)
    frame = torch.stack([forward, torch.linalg.cross(up.expand_as(forward), forward), up.expand_as(forward)], dim=-1)
    return (motion.joints - motion.joints[:, :1]) @ frame
