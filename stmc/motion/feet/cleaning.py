"""A motion whose feet stand still while they stand: the whole of it, from contacts to rotations."""

from __future__ import annotations

import torch
from jaxtyping import Bool
from torch import Tensor

from stmc.motion.body import JOINTS, PARENTS
from stmc.motion.body_model import Skeleton
from stmc.motion.feet.contacts import standing_steps
from stmc.motion.feet.leg_bending import LEG, bend_leg, sinking
from stmc.motion.feet.locking import Foot, away, locked
from stmc.motion.geometry import global_rotations
from stmc.motion.motion import Motion

_SIDES = ("left", "right")
_HEEL = (0.0, 0.87, 0.0)
"""The heel, as a share of the way from ankle to toes in each axis of the foot: below the ankle, not quite as low."""
_LEAST = 1e-6
"""Metres, or radians: what is corrected by less is left as it is."""
_SINK = 0.25
"""Seconds over which the pelvis is moved, before and after it has to be."""


def clean_feet(motion: Motion, floor: float | int = 0.0, free: Bool[Tensor, " frames"] | None = None) -> Motion:
    """The motion with feet that do not slide while they stand, and do not go below the `floor` (metres).

    Heels and toes that are low and slow for a while are held where they are on average; so are feet that glide while
    nothing else carries the body. Before and after, corrections come and go within a quarter of a second. Legs follow
    in closed form, knees in their own planes; the pelvis sinks only where a leg would be too short. Hips and all above
    keep their rotations, and frames without a correction are the motion's own. It takes a body that stands on a level
    floor: on stairs, say another one.

    `free`: the frames that may change (None: all). The others stay to the last digit, and a foot that stands in one of
    them goes on standing where it does there. Raises `ValueError` for another number of frames.

    After Kovar et al., *Footskate cleanup for motion capture editing* (2002).

    Examples:
        >>> [motion] = stmc.load().generate("walk # 0 # 1", steps=1)
        >>> stmc.clean_feet(motion)
        Motion(20 frames at 20 fps, 1.00 s)
    """
    free = torch.ones(motion.frames, dtype=torch.bool) if free is None else free.cpu()
    if len(free) != motion.frames:
        raise ValueError(f"free: {len(free)} frames for a motion of {motion.frames}; one value for each is needed")
    if motion.frames < 2 or not free.any():
        return motion
    exact = motion.to("cpu", torch.float64)
    skeleton = Skeleton.measured(exact.rotations, exact.joints)
    world = global_rotations(exact.rotations, PARENTS)
    joints = skeleton.pose(exact.rotations, exact.translation)
    feet = [_foot(skeleton, world, joints, side) for side in _SIDES]
    points = torch.stack([foot.points for foot in feet], dim=1)
    held = standing_steps(points, joints[:, 0, 2], motion.fps, floor)
    stood = [
        locked(foot, steps, ~free, motion.fps, floor) for foot, steps in zip(feet, held.unbind(dim=1), strict=True)
    ]
    hips, knees, ankles = (torch.stack([joints[:, _at(side, each)] for side in _SIDES], dim=1) for each in LEG)
    wanted, span = torch.stack([foot.ankle for foot in stood], dim=1), round(_SINK * motion.fps)
    moved = torch.zeros_like(exact.translation)
    moved[:, 2] = -sinking(hips, knees, ankles, wanted, span) * away(~free, span)
    rotations = exact.rotations.clone()
    for side, foot in zip(_SIDES, stood, strict=True):
        reach = foot.ankle - joints[:, _at(side, "hip")] - moved
        rotations[:, [_at(side, each) for each in LEG]] = bend_leg(side, world, joints, reach, foot.turned)
    changed = _changed(feet, stood, moved) & free
    return _where(changed, Motion.posed(rotations, exact.translation + moved, motion.fps, skeleton), motion)


def _at(side: str, name: str) -> int:
    return JOINTS.index(f"{side}_{name}")


def _foot(skeleton: Skeleton, world: Tensor, joints: Tensor, side: str) -> Foot:
    ankle, toes = _at(side, "ankle"), skeleton.offsets[_at(side, "foot")]
    return Foot(joints[:, ankle], world[:, ankle], toes * toes.new_tensor(_HEEL), toes)


def _changed(before: list[Foot], after: list[Foot], moved: Tensor) -> Bool[Tensor, " frames"]:
    feet = [(new.points - old.points).norm(dim=-1).amax(dim=1) for old, new in zip(before, after, strict=True)]
    return torch.stack([*feet, moved.norm(dim=-1)]).amax(dim=0) > _LEAST


def _where(changed: Bool[Tensor, " frames"], new: Motion, old: Motion) -> Motion:
    """`new` in the frames that are changed."""
    changed = changed.to(old.joints.device)
    pairs = [(getattr(new, name).to(getattr(old, name)), getattr(old, name)) for name in _VALUES]
    values = [torch.where(changed.reshape(-1, *[1] * (first.ndim - 1)), first, second) for first, second in pairs]
    return Motion(*values, old.fps, old.overlap)


_VALUES = ("rotations", "translation", "joints")
