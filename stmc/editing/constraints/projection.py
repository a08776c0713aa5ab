"""Constraints met to the millimetre: what guidance left over is taken away, smoothly, from a finished motion.

A keyframe's pose is turned in, the pelvis' path is moved over, arms and legs bend to their targets (two-bone inverse
kinematics). Corrections come and go within `RAMP`. Knows motions and constraints; knows no features.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from stmc.editing.constraints.limbs import Target
from stmc.editing.constraints.pose import RAMP, Constraint, Pose, bump
from stmc.editing.constraints.root import Path
from stmc.editing.constraints.whole_body import Keyframe
from stmc.motion.body import JOINTS, PARENTS, BodyPart
from stmc.motion.body_model import Skeleton
from stmc.motion.geometry import axis_angle_to_matrix, global_rotations, matrix_to_axis_angle, rotation_z
from stmc.motion.inverse_kinematics import bend_limb
from stmc.motion.motion import Motion

_LEAST = 0.001
"""Metres off with which a limb has reached its target."""

_ROUNDS = 4
"""In which a path is corrected."""

_CHAINS = {
    "wrist": ("shoulder", "elbow", "wrist"),
    "hand": ("shoulder", "elbow", "wrist"),
    "ankle": ("hip", "knee", "ankle"),
    "foot": ("hip", "knee", "ankle"),
}
"""The limb that ends in each joint that a target can be of."""

_HINGES = {
    "left_elbow": (0.0, -1.0, 0.0), "right_elbow": (0.0, 1.0, 0.0), "left_knee": (1.0, 0.0, 0.0),
    "right_knee": (1.0, 0.0, 0.0),
}  # fmt: skip
"""The axis, of the upper bone's own, about which the lower one bends: forearms forwards, shins backwards."""


def project(
    motion: Motion, constraints: Sequence[Constraint], skeleton: Skeleton, free: Float[Tensor, "frames 5"]
) -> Motion:
    """The motion on `skeleton` with paths, keyframes, hands and feet where constraints want them.

    `free`: how much each frame of each `BodyPart` may change, 0 to 1; where it is 0 they keep their rotations.
    """
    for kind, meet in ((Keyframe, _turned_in), (Path, _moved_over), (Target, _reaching)):
        for each in constraints:
            each = each.settled(Pose.of(motion))
            if isinstance(each, kind):
                motion = meet(motion, each, skeleton, free.to(motion.translation))
    return motion


def _turned_in(motion: Motion, key: Keyframe, skeleton: Skeleton, free: Tensor) -> Motion:
    span = Pose.of(motion).frames_of(key.at, key.at)
    if span.start >= span.stop:
        return motion
    wanted = key.pose.to(dtype=motion.rotations.dtype)
    goal = wanted.rotations[0].clone()
    goal[0] = rotation_z(motion.heading[span.start] - wanted.heading[0]) @ goal[0]
    left = matrix_to_axis_angle(motion.rotations[span.start].mT @ goal)
    share = bump(motion.frames, span, round(RAMP * motion.fps), left)[:, None] * _of_joints(free)
    rotations = motion.rotations @ axis_angle_to_matrix(share[..., None] * left)
    translation = motion.translation.clone()
    translation[:, 2] += share[:, 0] * (wanted.translation[0, 2] - translation[span.start, 2])
    return Motion.posed(rotations, translation, motion.fps, skeleton)


def _of_joints(free: Float[Tensor, "frames 5"]) -> Float[Tensor, "frames 22"]:
    owners = [next(i for i, part in enumerate(BodyPart) if joint in part.joints) for joint in JOINTS[:22]]
    return free[:, owners]


def _moved_over(motion: Motion, path: Path, skeleton: Skeleton, free: Tensor) -> Motion:
    """Moved by what the pelvis is off beyond its sway, smoothed and so in a few rounds; behind the span the motion goes
    on from where it is."""
    legs = free[:, list(BodyPart).index(BodyPart.LEGS), None]
    first = (free.min() >= 1).to(legs).reshape(1, 1)  # a kept motion begins where it does
    free_steps = torch.cat([first, legs[:-1]])
    for _ in range(_ROUNDS):
        over = path.left(Pose.of(motion))
        way = (over.diff(dim=0, prepend=torch.zeros_like(over[:1])) * free_steps).cumsum(dim=0)
        moved = motion.translation + torch.nn.functional.pad(way, (0, 1))
        motion = Motion.posed(motion.rotations, moved, motion.fps, skeleton)
    return motion


def _reaching(motion: Motion, target: Target, skeleton: Skeleton, free: Tensor) -> Motion:
    """The limb bent; where it is too short, with the pelvis moved over by what is left."""
    bent, span = _bent(motion, target, skeleton, free), target.frames(Pose.of(motion))
    if span.start >= span.stop or float(target.errors(Pose.of(bent)).max()) < _LEAST:
        return bent
    off = bent.joints.new_tensor(target.point) - bent.joints[:, JOINTS.index(target.joint)]
    share = bump(motion.frames, span, round(RAMP * motion.fps), off) * free[:, list(BodyPart).index(BodyPart.LEGS)]
    nearest = torch.arange(motion.frames, device=off.device).clamp(span.start, span.stop - 1)
    translation = motion.translation + share[:, None] * off[nearest]
    return _bent(Motion.posed(motion.rotations, translation, motion.fps, skeleton), target, skeleton, free)


def _bent(motion: Motion, target: Target, skeleton: Skeleton, free: Tensor) -> Motion:
    """The limb bent so that the joint is at the target; before and after, nearly so; its end keeps its direction."""
    side, _, end = target.joint.partition("_")
    span = target.frames(Pose.of(motion))
    if end not in _CHAINS or span.start >= span.stop:
        return motion
    chain = [JOINTS.index(f"{side}_{name}") for name in _CHAINS[end]]
    part = list(BodyPart).index(next(part for part in BodyPart if target.joint in part.joints))
    path = motion.joints[:, JOINTS.index(target.joint)]
    off = path.new_tensor(target.point) - path
    nearest = torch.arange(motion.frames, device=path.device).clamp(span.start, span.stop - 1)
    share = bump(motion.frames, span, round(RAMP * motion.fps), path) * free[:, part]
    reach = motion.joints[:, chain[-1]] + share[:, None] * off[nearest] - motion.joints[:, chain[0]]
    world = global_rotations(motion.rotations, PARENTS)
    hinge = world[:, chain[0]] @ world.new_tensor(_HINGES[JOINTS[chain[1]]])
    upper, lower = bend_limb(world[:, chain[0]], world[:, chain[1]], motion.joints[:, chain], reach, hinge)
    rotations, above = motion.rotations.clone(), world[:, PARENTS[chain[0]]]
    bent = torch.stack([above.mT @ upper, upper.mT @ lower, lower.mT @ world[:, chain[2]]], dim=1)
    touched = share > 0
    rotations[touched] = rotations[touched].index_copy(1, torch.tensor(chain, device=path.device), bent[touched])
    return Motion.posed(rotations, motion.translation, motion.fps, skeleton)
