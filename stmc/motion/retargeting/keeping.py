"""The contacts of a motion: feet that stay on the floor, hands that are at the head or at each other.

Limbs follow in closed form, in the planes in which they are bent.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import normalize

from stmc.motion.feet.contacts import runs, standing_steps
from stmc.motion.feet.leg_bending import sinking
from stmc.motion.feet.locking import blend_spans
from stmc.motion.geometry import axis_angle_to_matrix, matrix_to_axis_angle, shortest_arc
from stmc.motion.inverse_kinematics import bend_limb
from stmc.motion.retargeting.performer import Performer
from stmc.motion.retargeting.rig import LIMBS, SIDES, Rig

_LEG, _ARM = LIMBS
_LOW, _HIGH = 0.1, 0.3
"""Metres above the floor, on our body, up to which a foot is exactly as high as ours, and from which on it is free."""
_AROUND = 1e-3
"""The weight of a step just before or after a contact, against one of the contact."""
_STILL = 1e-4
"""Metres per step up to which heel and toes are equally still."""
_SINK = 0.25
"""Seconds over which the pelvis sinks where a leg would be too short."""
_NEAR, _FAR = 0.45, 0.65
"""Distances of a wrist from the head, in lengths of the arm, at which it is exactly where ours is, and free."""
_TOGETHER, _APART = 0.3, 0.5
"""The same of the wrists from each other."""


def keep_feet(
    source: Performer, target: Performer, rig: Rig, spread: Float[Tensor, "driven 3 3"], fps: float | int
) -> Performer:
    """Move the target's feet to the height of the source's, and over the floor as the source's while these stand.

    Both have legs of the same length.
    """
    led = source.soles()
    target = _tilt_feet(led, target, rig)
    own = target.soles()
    following = _following(led, source.at("pelvis")[:, 2], fps)
    ways = torch.stack([_displacement(led[:, side], own[:, side], following[:, side], fps) for side in range(2)], dim=1)
    hips, knees, ankles = (torch.stack([target.at(f"{side}_{each}") for side in SIDES], dim=1) for each in _LEG)
    wanted = ankles + ways
    pelvis = target.at("pelvis").clone()
    sunk = sinking(hips, knees, ankles, wanted, round(_SINK * fps))
    pelvis[:, 2] -= sunk
    turns = target.turns.clone()
    for number, side in enumerate(SIDES):
        reach = wanted[:, number] - hips[:, number]
        reach[:, 2] += sunk
        _bend(turns, target, rig, spread, [f"{side}_{each}" for each in _LEG], reach, (1.0, 0.0, 0.0))
    return Performer(turns, rig.posed(turns, pelvis), target.rest, target.joints)


def keep_hands(source: Performer, target: Performer, rig: Rig, spread: Float[Tensor, "driven 3 3"]) -> Performer:
    """Move the target's wrists to the source's relative positions, in arm lengths.

    Positions are relative to the head while a wrist is near it, and to the midpoint of both wrists while these are near
    each other. Other wrists stay.
    """
    unit = source.length(_ARM)
    larger = target.length(_ARM) / unit
    wrists = {side: source.at(f"{side}_wrist") for side in SIDES}
    apart = wrists["left"] - wrists["right"]
    together = _share(apart.norm(dim=-1) / unit, _TOGETHER, _APART)
    middle = (target.at("left_wrist") + target.at("right_wrist")) / 2
    turns = target.turns.clone()
    for side, sign in zip(SIDES, (1.0, -1.0), strict=True):
        away = wrists[side] - source.at("head")
        near = _share(away.norm(dim=-1) / unit, _NEAR, _FAR)
        wrist = target.at(f"{side}_wrist")
        clasped = torch.lerp(wrist, middle + sign * larger * apart / 2, together)
        wanted = torch.lerp(clasped, target.at("head") + larger * away, near)
        reach = wanted - target.at(f"{side}_shoulder")
        _bend(turns, target, rig, spread, [f"{side}_{each}" for each in _ARM], reach, (0.0, 0.0, -sign))
    return Performer(turns, rig.posed(turns, target.at("pelvis")), target.rest, target.joints)


def _tilt_feet(led: Float[Tensor, "frames 2 2 3"], target: Performer, rig: Rig) -> Performer:
    """Tilt low feet of the target so that the height of heels above toes is that of the source's soles, `led`.

    A longer foot tilts less, so that the leg above need not bend more. A shorter foot has the source's tilt.
    """
    turns = target.turns.clone()
    soles = target.soles()
    for number, side in enumerate(SIDES):
        along = soles[:, number, 1] - soles[:, number, 0]
        length = along.norm(dim=-1, keepdim=True)
        rise = (led[:, number, 1, 2:] - led[:, number, 0, 2:]).clamp(-along[:, 2:].abs(), along[:, 2:].abs())
        flat = normalize(along[:, :2] + 1e-9, dim=-1) * (length**2 - rise**2).sqrt()
        arc = matrix_to_axis_angle(shortest_arc(along / length, torch.cat([flat, rise], dim=-1) / length))
        turn = axis_angle_to_matrix(arc * _share(led[:, number, :, 2].amin(dim=1), _LOW, _HIGH))
        for joint in (f"{side}_ankle", f"{side}_foot"):
            if joint in target.joints:
                turns[:, rig.place(joint)] = turn @ turns[:, rig.place(joint)]
    return Performer(turns, rig.posed(turns, target.at("pelvis")), target.rest, target.joints)


def _bend(
    turns: Tensor,
    target: Performer,
    rig: Rig,
    spread: Tensor,
    limb: list[str],
    reach: Float[Tensor, "frames 3"],
    hinge: tuple[float, float, float],
) -> None:
    """Rotate the two bones of a limb, in place, so that the limb ends at `reach` relative to its first joint.

    `hinge` is the axis, in SMPL's T-pose, about which a straight limb bends.
    """
    upper, lower = (rig.place(joint) for joint in limb[:2])
    joints = torch.stack([target.at(joint) for joint in limb], dim=1)
    axis = target.turns[:, upper] @ spread[upper].mT @ spread.new_tensor(hinge)
    bent = bend_limb(target.turns[:, upper], target.turns[:, lower], joints, reach, axis)
    turns[:, upper], turns[:, lower] = bent


def _following(led: Float[Tensor, "frames 2 2 3"], pelvis: Float[Tensor, " frames"], fps: float | int) -> Tensor:
    """Return the weights with which each step [steps, feet, 2] of heels and toes follows the leading one's: up to 1 if
    it stands, and next to nothing just before and after.

    Where heel and toes stand, the stiller end has more weight, so that a foot of another length turns on the same end.
    """
    if len(led) < 2:
        return led.new_zeros(0, 2, 2)
    steps = led.diff(dim=0).norm(dim=-1) + _STILL
    stillness = steps.flip(dims=(2,)) ** 2 / (steps**2).sum(dim=-1, keepdim=True)
    held = standing_steps(led, pelvis, fps, 0.0)
    none = torch.zeros_like(held[:1])
    around = torch.cat([held[1:], none]) | torch.cat([none, held[:-1]])
    weights = torch.where(held.all(dim=-1, keepdim=True), stillness, held.to(led))
    return torch.maximum(weights, _AROUND * around.to(led))


def _displacement(
    led: Float[Tensor, "frames 2 3"],
    own: Float[Tensor, "frames 2 3"],
    following: Float[Tensor, "_ 2"],
    fps: float | int,
) -> Float[Tensor, "frames 3"]:
    """Compute the displacement of a foot that keeps its contacts.

    Horizontally, the foot makes the source's steps while the source's foot stands, without moving on average.
    Vertically, it moves to the height of the source's foot while that is low.

    Args:
        led: Heel and toes of the source's foot.
        own: Heel and toes of the target's foot.
        following: Weights of `_following`.
        fps: Frame rate.
    """
    total = following.sum(dim=1)
    steps = ((led - own).diff(dim=0) * following[..., None]).sum(dim=1) / total.clamp(min=_AROUND)[:, None]
    ways, spans = torch.zeros_like(led[:, 0]), runs(total > 0)
    for start, end in spans:
        summed = torch.cat([steps.new_zeros(1, 3), steps[start:end].cumsum(dim=0)])
        ways[start : end + 1] = summed - summed.mean(dim=0)
    ways = blend_spans(ways, spans, fps)
    height = led[..., 2].amin(dim=1)
    ways[:, 2] = ((height - own[..., 2].amin(dim=1))[:, None] * _share(height, _LOW, _HIGH))[:, 0]
    return ways


def _share(values: Float[Tensor, " frames"], near: float, far: float) -> Float[Tensor, "frames 1"]:
    """Return a weight that falls smoothly from 1, for values up to `near`, to 0, for values from `far` on."""
    share = ((far - values) / (far - near)).clamp(0, 1)
    return (share**2 * (3 - 2 * share))[:, None]
