"""Retarget motions of SMPL's body to a rig: directions of bones, bending of the trunk, height of the hips.

Knows SMPL's joints and rest pose, but no contacts, which `keeping` restores afterwards.
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
"""Heights of the hips in metres: below the first the body sits on the floor, above the second the feet carry it."""


@dataclass(frozen=True, eq=False)
class RigMotion:
    """The motion of a rig (float64, CPU), in the world of `Motion` (z up) but in the rig's own unit of length."""

    rig: Rig
    turns: Float[Tensor, "frames driven 3 3"]
    """World rotation of each driven node from its rest pose."""
    places: Float[Tensor, "frames driven 3"]
    """Position of each driven node."""
    spread: Float[Tensor, "driven 3 3"]
    """World rotations from the rest pose to SMPL's T-pose."""
    fps: float | int
    scale: float
    """Length of the rig's legs, in its unit, divided by that of the body's legs in metres."""
    curves: HingeCurves | None = None
    """Hinge angles of a robot, from which `turns` and `places` follow; None if the rig has no hinges."""

    def direction(self, above: str, below: str) -> Float[Tensor, "frames 3"]:
        """Return the unit vectors from joint `above` to joint `below`."""
        first, second = (self.places[:, self.rig.place(joint)] for joint in (above, below))
        return normalize(second - first, dim=-1)


def transfer(motion: Motion, rig: Rig) -> RigMotion:
    """Retarget a motion to a rig.

    1. Bones of arms and legs get the body's directions, whatever the rig's rest pose. The spine's rotation is spread
       over the rig's joints. Feet and hands get the body's rotations, relative to flat feet and hands.
    2. Positions are scaled by the length of the legs.
    3. Feet make the body's steps (`keep_feet`). Hands near the head or each other keep their relative positions, in
       arm lengths (`keep_hands`).
    4. If the rig is a robot, its hinges follow the result (`follow`).

    On a rig with SMPL's own bones the motion is unchanged.
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
    """Return the closest motion that the hinges of the rig can make."""
    curves = follow(motion.rig, motion.turns.numpy(), motion.places.numpy(), motion.fps)
    turns, places = (torch.from_numpy(values) for values in apply_hinges(motion.rig, curves))
    return replace(motion, turns=turns, places=places, curves=curves)


def _performer(motion: Motion) -> Performer:
    """Return the body of a motion as a `Performer`, with bones of constant, mean length."""
    exact = motion.to("cpu", torch.float64)
    skeleton = Skeleton.measured(exact.rotations, exact.joints)
    rest = skeleton.rest @ _UP.T
    rest = rest - rest.new_tensor([0.0, 0.0, 1.0]) * rest[[JOINTS.index(f"{side}_foot") for side in SIDES], 2].mean()
    places = skeleton.pose(exact.rotations, exact.translation)
    turns = global_rotations(exact.rotations, PARENTS) @ _UP.T
    return Performer(turns, places, rest, {joint: place for place, joint in enumerate(JOINTS)})


def _turn_rig(rig: Rig, source: Performer) -> tuple[Performer, Float[Tensor, "driven 3 3"]]:
    """Return the rig with the source's rotations and midpoint of the hips, and the rotations to the T-pose."""
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
    """Return how far to raise the hips for ankles that are `higher`: less while the body sits on the floor."""
    return higher * ((hips - _SITTING[0]) / (_SITTING[1] - _SITTING[0])).clamp(0, 1)


def _along(knots: Float[Tensor, "knots frames 3 3"], share: float) -> Float[Tensor, "frames 3 3"]:
    """Interpolate between evenly spaced knots on shortest arcs; `share` is 0 at the first knot and 1 at the last."""
    position = share * (len(knots) - 1)
    before = min(int(position + 1e-9), len(knots) - 2)
    arc = matrix_to_axis_angle(knots[before].mT @ knots[before + 1])
    return knots[before] @ axis_angle_to_matrix(arc * (position - before))
