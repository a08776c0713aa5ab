"""Legs that reach given feet: how they bend, and how far the pelvis sinks so that they can.

Knows hips, knees and ankles; knows no contacts.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import max_pool1d, pad

from stmc.motion.body import JOINTS
from stmc.motion.geometry import average_frames
from stmc.motion.inverse_kinematics import bend_limb

LEG = ("hip", "knee", "ankle")
"""The joints of a leg, without its side."""

_STRETCH = 0.99
"""The share of its length to which a leg that was more bent is stretched at most."""
_DEEPEST = 0.1
"""Metres that a pelvis sinks at most."""
_LYING = 0.3
"""The cosine between a leg and the vertical below which it does not stand; above twice as far it does."""


def bend_leg(
    side: str,
    world: Float[Tensor, "frames _ 3 3"],
    joints: Float[Tensor, "frames _ 3"],
    reach: Float[Tensor, "frames 3"],
    foot: Float[Tensor, "frames 3 3"],
    root: Float[Tensor, "frames 3 3"] | None = None,
) -> Float[Tensor, "frames 3 3 3"]:
    """Return the local rotations of hip, knee and ankle of a leg that leads along `reach`, in closed form.

    Args:
        side: "left" or "right".
        world: Rotations of the joints to the world, before.
        joints: Positions of the joints in metres, before.
        reach: From the hip to the ankle in metres, in the world's axes. The knee bends in the plane of the pose.
        foot: Rotations of the foot to the world, after.
        root: Rotations of the pelvis to the world, after; None: as before.
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
    """Metres by which the pelvis must sink so that all ankles reach where they are `wanted`; smooth over `span` frames.

    No leg is asked to be straighter than it was, unless it stays a little bent. For legs that lie rather than stand,
    and for more than `_DEEPEST`, it does not sink.
    """
    length = (knees - hips).norm(dim=-1) + (ankles - knees).norm(dim=-1)
    reach = torch.maximum(_STRETCH * length, (ankles - hips).norm(dim=-1))
    way = hips - wanted
    distance = way.norm(dim=-1)
    flat = (reach**2 - way[..., :2].square().sum(dim=-1)).clamp(min=0).sqrt()
    short = (way[..., 2] - flat).clamp(min=0, max=_DEEPEST) * (distance > reach)
    steep = ((way[..., 2] / distance - _LYING) / (0.4)).clamp(0, 1)
    return _envelope((short * steep).amax(dim=1), span)


def _envelope(values: Float[Tensor, " frames"], span: int) -> Float[Tensor, " frames"]:
    """Smooth, nowhere below `values`, and zero farther than 2 `span` from all that are positive."""
    widest = max_pool1d(pad(values[None], (2 * span, 2 * span)), 2 * span + 1, stride=1)[0]
    return average_frames(widest[:, None], span)[:, 0]
