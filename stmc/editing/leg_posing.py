"""Legs that reach given feet, and turns of the head: the pose changes that all editing of whole motions shares.

Knows rotations and the lengths of bones; knows no paths and no time but smoothness.
"""

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
"""Seconds over which the pelvis sinks where a leg would be too short."""


def joint(side: str, name: str) -> int:
    """Index of a joint of one side."""
    return JOINTS.index(f"{side}_{name}")


def of_legs(values: Float[Tensor, "frames joints *width"], name: str) -> Float[Tensor, "frames 2 *width"]:
    """The values of a joint of the legs, left and right."""
    return torch.stack([values[:, joint(side, name)] for side in SIDES], dim=1)


def reach_with_legs(
    motion: Motion, ankles: Float[Tensor, "frames 2 3"], feet: Float[Tensor, "frames 2 3 3"], skeleton: Skeleton
) -> Motion:
    """The motion with its left and right ankle at the given places (metres) and its feet turned as given (rotations to
    the world). Two-bone inverse kinematics in closed form; knees bend in the planes of the pose.

    Where a leg is too short, the pelvis sinks by up to 10 cm; what is still out of reach is approached.
    """
    world, joints = global_rotations(motion.rotations, PARENTS), motion.joints
    hips, knees, before = (of_legs(joints, name) for name in LEG)
    down = torch.zeros_like(motion.translation)
    down[:, 2] = -sinking(hips, knees, before, ankles, round(_SINK * motion.fps))
    rotations = motion.rotations.clone()
    for number, side in enumerate(SIDES):
        reach = ankles[:, number] - joints[:, joint(side, "hip")] - down
        rotations[:, [joint(side, name) for name in LEG]] = bend_leg(side, world, joints, reach, feet[:, number])
    return Motion.posed(rotations, motion.translation + down, motion.fps, skeleton)


def turn_joint(
    rotations: Float[Tensor, "frames 22 3 3"], name: str, angle: Float[Tensor, " frames"]
) -> Float[Tensor, "frames 22 3 3"]:
    """Local rotations with a joint, and all that it carries, turned by `angle` (radians) about the world's up axis."""
    index = JOINTS.index(name)
    above = global_rotations(rotations, PARENTS)[:, PARENTS[index]]
    rotations = rotations.clone()
    rotations[:, index] = above.mT @ rotation_z(angle) @ above @ rotations[:, index]
    return rotations


def smooth(values: Float[Tensor, " frames *width"], sigma: float) -> Float[Tensor, " frames *width"]:
    """A Gaussian mean over time; `sigma` in frames."""
    from scipy.ndimage import gaussian_filter1d  # not above: it is slow to import

    return torch.from_numpy(gaussian_filter1d(values.numpy(), sigma, axis=0, mode="nearest"))


def exact(motion: Motion) -> tuple[Motion, Skeleton]:
    """The motion in double precision on the CPU, and its body."""
    motion = motion.to("cpu", torch.float64)
    return motion, Skeleton.measured(motion.rotations, motion.joints)


def like(motion: Motion, old: Motion) -> Motion:
    """The motion with the dtype and on the device of `old`."""
    return motion.to(old.joints.device, old.joints.dtype)
