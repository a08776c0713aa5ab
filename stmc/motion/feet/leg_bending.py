"""Leg inverse kinematics for given feet: bending of the legs, and sinking of the pelvis."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import max_pool1d, pad

from stmc.motion.body import JOINTS
from stmc.motion.geometry import average_frames
from stmc.motion.inverse_kinematics import bend_limb

LEG = ("hip", "knee", "ankle")
"""Joints of a leg, without its side."""
_STRETCH = 0.99
"""Fraction of its length to which a bent leg may be stretched."""
_DEEPEST = 0.1
"""Maximum depth in metres that the pelvis sinks."""
_LYING = 0.3
"""Cosine between a leg and the vertical below which the leg does not stand; well above it the leg does."""


def bend_leg(
    side: str,
    world: Float[Tensor, "frames _ 3 3"],
    joints: Float[Tensor, "frames _ 3"],
    reach: Float[Tensor, "frames 3"],
    foot: Float[Tensor, "frames 3 3"],
    root: Float[Tensor, "frames 3 3"] | None = None,
) -> Float[Tensor, "frames 3 3 3"]:
    """Compute the local rotations of hip, knee and ankle of a leg that reaches for a target, in closed form.

    Args:
        side: "left" or "right".
        world: World rotations of the joints, before.
        joints: Positions of the joints in metres, before.
        reach: Vector from the hip to the ankle in metres, in the world's axes. The knee bends in the plane of the pose.
        foot: World rotations of the foot, after.
        root: World rotations of the pelvis, after; None keeps those before.
    """
    hip, knee, ankle = (JOINTS.index(f"{side}_{name}") for name in LEG)
    bones, root = joints[:, [hip, knee, ankle]], world[:, 0] if root is None else root
    thigh, shin = bend_limb(world[:, hip], world[:, knee], bones, reach, world[:, hip, :, 0])
    return torch.stack([root.mT @ thigh, thigh.mT @ shin, shin.mT @ foot], dim=1)


def sinking(
    hips: Float[Tensor, "frames legs 3"],
    knees: Float[Tensor, "frames legs 3"],
    ankles: Float[Tensor, "frames legs 3"],
    wanted: Float[Tensor, "frames legs 3"],
    span: int,
) -> Float[Tensor, " frames"]:
    """Return the depth in metres that the pelvis must sink so that all ankles reach their targets.

    The result is smooth over `span` frames. No leg becomes straighter than it was, unless it stays slightly bent. The
    pelvis does not sink for legs that lie rather than stand, and never more than `_DEEPEST`.

    Args:
        hips: Positions of the hips in metres, [frames, legs, 3].
        knees: Positions of the knees.
        ankles: Positions of the ankles.
        wanted: Target positions of the ankles.
        span: Number of frames on either side over which the result is smoothed.
    """
    length = (knees - hips).norm(dim=-1) + (ankles - knees).norm(dim=-1)
    reach = torch.maximum(_STRETCH * length, (ankles - hips).norm(dim=-1))
    offset = hips - wanted
    distance = offset.norm(dim=-1)
    flat = (reach**2 - offset[..., :2].square().sum(dim=-1)).clamp(min=0).sqrt()
    short = (offset[..., 2] - flat).clamp(min=0, max=_DEEPEST) * (distance > reach)
    steep = ((offset[..., 2] / distance - _LYING) / (0.4)).clamp(0, 1)
    return _envelope((short * steep).amax(dim=1), span)


def _envelope(values: Float[Tensor, " frames"], span: int) -> Float[Tensor, " frames"]:
    """Smooth `values` from above, with zero farther than 2 `span` from all positive values."""
    widest = max_pool1d(pad(values[None], (2 * span, 2 * span)), 2 * span + 1, stride=1)[0]
    return average_frames(widest[:, None], span)[:, 0]
