"""Legs that reach their feet: two-bone inverse kinematics in closed form, and a pelvis that sinks where they are short.

Knows hips, knees and ankles; knows no contacts.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import max_pool1d, normalize

from stmc.geometry import axis_angle_to_matrix, shortest_arc

_STRETCH = 0.995
"""The share of its length to which a leg that was more bent is stretched at most."""
_DEEPEST = 0.1
"""Metres that a pelvis sinks at most."""
_LYING = 0.3
"""The cosine between a leg and the vertical below which it does not stand; above twice as far it does."""
_LATERAL = 0.05
"""The sine of the bend of a knee whose own plane counts as much as the thigh's lateral axis."""


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
    widest = max_pool1d(torch.nn.functional.pad(values[None, None], (2 * span, 2 * span)), 2 * span + 1, stride=1)
    window = torch.hann_window(2 * span + 3, periodic=False, dtype=values.dtype, device=values.device)[1:-1]
    return torch.nn.functional.conv1d(widest, (window / window.sum())[None, None])[0, 0]


def reaching(
    thigh: Float[Tensor, "frames 3 3"],
    shin: Float[Tensor, "frames 3 3"],
    joints: tuple[Float[Tensor, "frames 3"], Float[Tensor, "frames 3"], Float[Tensor, "frames 3"]],
    hip: Float[Tensor, "frames 3"],
    ankle: Float[Tensor, "frames 3"],
) -> tuple[Float[Tensor, "frames 3 3"], Float[Tensor, "frames 3 3"]]:
    """World rotations of thigh and shin whose leg, from `hip`, ends in `ankle`, or as near as it reaches.

    `joints`: hip, knee and ankle as `thigh` and `shin` have them. The knee bends or stretches in the plane it is bent
    in (the thigh's own sagittal plane where it is straight); then the leg turns the shortest way.
    """
    upper, lower = joints[1] - joints[0], joints[2] - joints[1]
    first, second = upper.norm(dim=-1), lower.norm(dim=-1)
    along, below = normalize(upper, dim=-1), normalize(lower, dim=-1)
    axis = _hinge(along, below, thigh[..., 0])
    target = ankle - hip
    bent = torch.linalg.cross(along, below)
    now = torch.atan2((bent * axis).sum(dim=-1), (along * below).sum(dim=-1))
    flat = (1 - (below * axis).sum(dim=-1) ** 2).clamp(min=1e-12).sqrt()
    cosine = (target.square().sum(dim=-1) - first**2 - second**2) / (2 * first * second * flat)
    bend = axis_angle_to_matrix(axis * (torch.acos(cosine.clamp(-1, 1)) - now)[:, None])
    end = upper + (bend @ lower[..., None])[..., 0]
    swing = shortest_arc(normalize(end, dim=-1), normalize(target, dim=-1))
    return swing @ thigh, swing @ bend @ shin


def _hinge(along: Tensor, below: Tensor, lateral: Tensor) -> Float[Tensor, "frames 3"]:
    """The axis about which a knee bends, perpendicular to the thigh: shins go backwards."""
    lateral = normalize(lateral - (lateral * along).sum(dim=-1, keepdim=True) * along, dim=-1)
    bent = torch.linalg.cross(along, below)
    return normalize(bent + _LATERAL * lateral, dim=-1)
