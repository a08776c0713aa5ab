"""Motions of our body on a rig: bones point where ours do, the trunk bends as ours, hips go as high.

Knows our joints and rest pose; knows no contacts, which `keeping` restores afterwards.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import normalize

from stmc.motion.body import JOINTS, PARENTS
from stmc.motion.body_model import Skeleton
from stmc.motion.geometry import axis_angle_to_matrix, global_rotations, matrix_to_axis_angle
from stmc.motion.motion import Motion
from stmc.motion.retargeting.hinges import HingeCurves, apply_hinges, follow
from stmc.motion.retargeting.keeping import keep_feet, keep_hands
from stmc.motion.retargeting.performer import Performer
from stmc.motion.retargeting.rig import LIMBS, SIDES, Rig
from stmc.motion.retargeting.spreading import spread_limbs

_UP = torch.from_numpy(np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]]))
"""From SMPL's rest axes (y up, facing z) to the world's (z up, facing -y)."""
_SPINE = ("pelvis", "spine1", "spine2", "spine3")
_NECK = ("spine3", "neck")
_SITTING = (0.1, 0.4)
"""Metres above the floor from which on feet begin to carry our hips, and from which on they do."""


@dataclass(frozen=True, eq=False)
class RigMotion:
    """A rig moving (float64, CPU): in the world of our motions, z up, but in the rig's own unit."""

    rig: Rig
    turns: Float[Tensor, "frames driven 3 3"]
    """Each driven node's turn from its rest pose, in the world's axes."""
    places: Float[Tensor, "frames driven 3"]
    """Each driven node's position."""
    spread: Float[Tensor, "driven 3 3"]
    """The turns that bring the rest pose to our T-pose."""
    fps: float | int
    scale: float
    """The length of the rig's legs, in its unit, per metre of ours."""
    curves: HingeCurves | None = None
    """The angles of a robot's hinges, which turns and places follow; None if the rig has no hinges."""

    def direction(self, above: str, below: str) -> Float[Tensor, "frames 3"]:
        """Return unit vectors from one joint of ours to another, in each frame."""
        first, second = (self.places[:, self.rig.place(joint)] for joint in (above, below))
        return normalize(second - first, dim=-1)


def transfer(motion: Motion, rig: Rig) -> RigMotion:
    """Move a `rig` as our body moves in `motion`.

    Bones of arms and legs point where ours do, whatever the rest pose; the spine's turns spread over the rig's own
    joints; feet and hands are turned as ours from where they are flat. Everything is scaled by the length of the legs.
    Then feet move over the floor as ours do (`keep_feet`), and hands that are near the head or one another are where
    ours are, in units of the arm (`keep_hands`). On a rig with our own bones the motion is the same. The hinges of a
    robot then follow the result (`follow`).
    """
    source = _performer(motion)
    scale = rig.length(LIMBS[0]) / source.length(LIMBS[0])
    sized = rig.scaled(1 / scale)
    target, spread = _turn_rig(sized, source)
    target = keep_feet(source, target, sized, spread, motion.fps)
    target = keep_hands(source, target, sized, spread)
    moved = RigMotion(rig, target.turns, target.places * scale, spread, motion.fps, scale)
    return moved if rig.linkage is None else _fit_hinges(moved)


def _fit_hinges(motion: RigMotion) -> RigMotion:
    """Return the motion that comes nearest to one with the hinges of its rig."""
    curves = follow(motion.rig, motion.turns.numpy(), motion.places.numpy(), motion.fps)
    turns, places = (torch.from_numpy(values) for values in apply_hinges(motion.rig, curves))
    return replace(motion, turns=turns, places=places, curves=curves)


def _performer(motion: Motion) -> Performer:
    """Our body in a motion, its bones as long as they are on average."""
    exact = motion.to("cpu", torch.float64)
    skeleton = Skeleton.measured(exact.rotations, exact.joints)
    rest = skeleton.rest @ _UP.T
    rest = rest - rest.new_tensor([0.0, 0.0, 1.0]) * rest[[JOINTS.index(f"{side}_foot") for side in SIDES], 2].mean()
    places = skeleton.pose(exact.rotations, exact.translation)
    turns = global_rotations(exact.rotations, PARENTS) @ _UP.T
    return Performer(turns, places, rest, {joint: place for place, joint in enumerate(JOINTS)})


def _turn_rig(rig: Rig, source: Performer) -> tuple[Performer, Float[Tensor, "driven 3 3"]]:
    """Return the rig turned as the source, with the same middle of the hips, and the rotations from its rest pose."""
    joints = {joint: rig.place(joint) for joint in rig.joints}
    turns = torch.eye(3, dtype=torch.float64).repeat(len(source.turns), len(rig.driven), 1, 1)
    rest = rig.rest[list(rig.driven)]
    spread = spread_limbs(rig, Performer(turns, turns[..., 0], rest, joints), source)
    for chain, knots in ((rig.spine, _SPINE), (rig.necks, _NECK)):
        turned = torch.stack([source.turn(joint) for joint in knots])
        for number, node in enumerate(chain, start=1):
            turns[:, rig.driven.index(node)] = _along(turned, number / len(chain))
    for joint, place in joints.items():
        turns[:, place] = source.turn(joint) @ spread[place]
    hips = [f"{side}_hip" for side in SIDES]
    middle = torch.stack([source.at(joint) for joint in hips]).mean(dim=0)
    bone = rig.at("pelvis") - torch.stack([rig.at(joint) for joint in hips]).mean(dim=0)
    pelvis = middle + turns[:, joints["pelvis"]] @ bone
    pelvis[:, 2] += _lift(middle[:, 2], rig.ankles - source.ankles)
    return Performer(turns, rig.posed(turns, pelvis), rest, joints), spread


def _lift(hips: Float[Tensor, " frames"], higher: float) -> Float[Tensor, " frames"]:
    """Return the lift of hips of this height for ankles that are `higher`: less where the body sits on the floor."""
    return higher * ((hips - _SITTING[0]) / (_SITTING[1] - _SITTING[0])).clamp(0, 1)


def _along(knots: Float[Tensor, "knots frames 3 3"], share: float) -> Float[Tensor, "frames 3 3"]:
    """Rotations a share of the way from the first to the last of these, each as far from the next."""
    position = share * (len(knots) - 1)
    before = min(int(position + 1e-9), len(knots) - 2)
    arc = matrix_to_axis_angle(knots[before].mT @ knots[before + 1])
    return knots[before] @ axis_angle_to_matrix(arc * (position - before))
