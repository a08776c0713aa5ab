"""Inverse kinematics of the legs and turns of joints, shared by all edits of whole motions."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from stmc.motion.body import JOINTS, PARENTS
from stmc.motion.body_model import Skeleton
from stmc.motion.feet.leg_bending import LEG, bend_leg, sinking
from stmc.motion.geometry import global_rotations, rotation_z
from stmc.motion.motion import Motion

SIDES = ("left", "right")

_SINK = 0.25
"""Seconds over which the pelvis sinks if a leg is too short."""


def joint(side: str, name: str) -> int:
    """Return the index of a joint of one side."""
    return JOINTS.index(f"{side}_{name}")


def select_legs(values: Float[Tensor, "frames joints *width"], name: str) -> Float[Tensor, "frames 2 *width"]:
    """Select the values of a joint of the legs, left and right."""
    return torch.stack([values[:, joint(side, name)] for side in SIDES], dim=1)


def reach_with_legs(
    motion: Motion, ankles: Float[Tensor, "frames 2 3"], feet: Float[Tensor, "frames 2 3 3"], skeleton: Skeleton
) -> Motion:
    """Move the ankles of a motion and turn its feet, by closed-form two-bone inverse kinematics.

    Knees bend in the planes of the pose. If a leg is too short, the pelvis sinks by up to 10 cm; a foot that is still
    out of reach gets as near as possible.

    Args:
        motion: Motion to edit.
        ankles: Positions of the left and the right ankle, in metres.
        feet: World rotations of the left and the right foot.
        skeleton: Body of the motion.
    """
    world, joints = global_rotations(motion.rotations, PARENTS), motion.joints
    hips, knees, before = (select_legs(joints, name) for name in LEG)
    down = torch.zeros_like(motion.translation)
    down[:, 2] = -sinking(hips, knees, before, ankles, round(_SINK * motion.fps))
    rotations = motion.rotations.clone()
    for number, side in enumerate(SIDES):
        offset = ankles[:, number] - joints[:, joint(side, "hip")] - down
        rotations[:, [joint(side, name) for name in LEG]] = bend_leg(side, world, joints, offset, feet[:, number])
    return Motion.posed(rotations, motion.translation + down, motion.fps, skeleton)


def turn_joint(
    rotations: Float[Tensor, "frames 22 3 3"], name: str, angle: Float[Tensor, " frames"]
) -> Float[Tensor, "frames 22 3 3"]:
    """Turn a joint and its descendants about the world's up axis.

    Args:
        rotations: Local rotations.
        name: Name of the joint.
        angle: Angle of each frame, in radians.
    """
    index = JOINTS.index(name)
    above = global_rotations(rotations, PARENTS)[:, PARENTS[index]]
    rotations = rotations.clone()
    rotations[:, index] = above.mT @ rotation_z(angle) @ above @ rotations[:, index]
    return rotations


def smooth(values: Float[Tensor, " frames *width"], sigma: float) -> Float[Tensor, " frames *width"]:
    """Smooth values over time with a Gaussian; `sigma` in frames."""
    from scipy.ndimage import gaussian_filter1d  # imported late: it is slow to import

    return torch.from_numpy(gaussian_filter1d(values.numpy(), sigma, axis=0, mode="nearest"))


def exact(motion: Motion) -> tuple[Motion, Skeleton]:
    """Return a motion in double precision on the CPU, and its body."""
    motion = motion.to("cpu", torch.float64)
    return motion, Skeleton.measured(motion.rotations, motion.joints)


def match_dtype(motion: Motion, old: Motion) -> Motion:
    """Return a motion with the dtype and on the device of `old`."""
    return motion.to(old.joints.device, old.joints.dtype)
