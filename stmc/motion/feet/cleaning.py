"""Foot cleanup of a whole motion, from contacts to rotations."""

from __future__ import annotations

import torch
from jaxtyping import Bool
from torch import Tensor

from stmc.motion.body import JOINTS, PARENTS
from stmc.motion.body_model import Skeleton
from stmc.motion.feet.contacts import standing_steps
from stmc.motion.feet.leg_bending import LEG, bend_leg, sinking
from stmc.motion.feet.locking import Foot, distance_weight, lock_foot
from stmc.motion.geometry import global_rotations
from stmc.motion.motion import Motion

_SIDES = ("left", "right")
_HEEL = (0.0, 0.87, 0.0)
"""Position of the heel as a fraction of the vector from ankle to toes, per axis of the foot: below the ankle, slightly
higher than the toes."""
_MIN_CORRECTION = 1e-6
"""Minimum correction, in metres or radians; smaller ones are discarded."""
_SINK = 0.25
"""Seconds over which the pelvis moves before and after it has to."""


def clean_feet(motion: Motion, floor: float | int = 0.0, free: Bool[Tensor, " frames"] | None = None) -> Motion:
    """Remove foot sliding and floor penetration from a motion.

    Heels and toes that are low and slow for a while are held at their average position; so are gliding feet while
    nothing else supports the body. Corrections blend in and out within a quarter of a second. Legs follow in closed
    form, with knees in their own planes; the pelvis sinks only if a leg would be too short. Hips and all joints above
    keep their rotations, and frames without a correction are unchanged. The method (after Kovar et al., *Footskate
    cleanup for motion capture editing*, 2002) assumes a level floor and is not suited to stairs.

    Args:
        motion: The motion.
        floor: Height of the floor in metres.
        free: True at the frames that may change, [frames]; None allows all. All other frames are preserved exactly, and
            a foot that stands in one of them keeps standing in the same place.

    Raises:
        ValueError: If `free` has another number of frames than the motion.

    Examples:
        >>> [motion] = stmc.load().generate("walk # 0 # 1", steps=1)
        >>> stmc.clean_feet(motion)
        Motion(20 frames at 20 fps, 1.00 s)
    """
    free = torch.ones(motion.frames, dtype=torch.bool) if free is None else free.cpu()
    if len(free) != motion.frames:
        raise ValueError(f"free has {len(free)} frames, but the motion has {motion.frames}; pass one value per frame")
    if motion.frames < 2 or not free.any():
        return motion
    exact = motion.to("cpu", torch.float64)
    skeleton = Skeleton.measured(exact.rotations, exact.joints)
    world = global_rotations(exact.rotations, PARENTS)
    joints = skeleton.pose(exact.rotations, exact.translation)
    feet = [_foot(skeleton, world, joints, side) for side in _SIDES]
    points = torch.stack([foot.points for foot in feet], dim=1)
    held = standing_steps(points, joints[:, 0, 2], motion.fps, floor)
    locked_feet = [
        lock_foot(foot, steps, ~free, motion.fps, floor) for foot, steps in zip(feet, held.unbind(dim=1), strict=True)
    ]
    hips, knees, ankles = (torch.stack([joints[:, _index(side, name)] for side in _SIDES], dim=1) for name in LEG)
    targets, span = torch.stack([foot.ankle for foot in locked_feet], dim=1), round(_SINK * motion.fps)
    shift = torch.zeros_like(exact.translation)
    shift[:, 2] = -sinking(hips, knees, ankles, targets, span) * distance_weight(~free, span)
    rotations = exact.rotations.clone()
    for side, foot in zip(_SIDES, locked_feet, strict=True):
        reach = foot.ankle - joints[:, _index(side, "hip")] - shift
        rotations[:, [_index(side, name) for name in LEG]] = bend_leg(side, world, joints, reach, foot.turned)
    changed = _changed_frames(feet, locked_feet, shift) & free
    return _where(changed, Motion.posed(rotations, exact.translation + shift, motion.fps, skeleton), motion)


def _index(side: str, name: str) -> int:
    return JOINTS.index(f"{side}_{name}")


def _foot(skeleton: Skeleton, world: Tensor, joints: Tensor, side: str) -> Foot:
    ankle, toes = _index(side, "ankle"), skeleton.offsets[_index(side, "foot")]
    return Foot(joints[:, ankle], world[:, ankle], toes * toes.new_tensor(_HEEL), toes)


def _changed_frames(before: list[Foot], after: list[Foot], shift: Tensor) -> Bool[Tensor, " frames"]:
    feet = [(new.points - old.points).norm(dim=-1).amax(dim=1) for old, new in zip(before, after, strict=True)]
    return torch.stack([*feet, shift.norm(dim=-1)]).amax(dim=0) > _MIN_CORRECTION


def _where(changed: Bool[Tensor, " frames"], new: Motion, old: Motion) -> Motion:
    """Select `new` in the frames that are changed, and `old` elsewhere."""
    changed = changed.to(old.joints.device)
    pairs = [(getattr(new, name).to(getattr(old, name)), getattr(old, name)) for name in _VALUES]
    rotations, translation, joints = (
        torch.where(changed.reshape(-1, *[1] * (first.ndim - 1)), first, second) for first, second in pairs
    )
    return Motion(rotations, translation, joints, old.fps, old.overlap)


_VALUES = ("rotations", "translation", "joints")
