"""From a rig's rest pose to our T-pose, whether it rests in a T-pose, an A-pose or another one.

Trunk, head and collars keep their own posture; feet are flat in both, so that they only turn about the vertical.
"""

from __future__ import annotations

import itertools

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import normalize

from stmc.motion.geometry import rotation_z, shortest_arc
from stmc.motion.retargeting.performer import Performer
from stmc.motion.retargeting.rig import LIMBS, SIDES, Rig


def spread_limbs(rig: Rig, target: Performer, source: Performer) -> Float[Tensor, "driven 3 3"]:
    """Return the rotations, in world axes, from the rig's rest pose to the source's for each driven node."""
    turns = torch.eye(3, dtype=torch.float64).repeat(len(rig.driven), 1, 1)
    for side in SIDES:
        for limb in LIMBS:
            aligned = _align(turns, target, source, [f"{side}_{joint}" for joint in limb])
        wrist = f"{side}_wrist"  # of the arm, the last of the limbs
        palm = _palm(rig, rig.joints[wrist])
        if palm is not None:
            hand = source.resting(f"{side}_hand") - source.resting(wrist)
            aligned = shortest_arc(aligned @ palm, normalize(hand, dim=0)) @ aligned
        turns[rig.place(wrist)] = aligned
        turned = rotation_z(_yaw(source, side) - _yaw(target, side))
        for joint in (f"{side}_ankle", f"{side}_foot"):
            if joint in rig.joints:
                turns[rig.place(joint)] = turned
    return turns


def _align(turns: Tensor, target: Performer, source: Performer, limb: list[str]) -> Float[Tensor, "3 3"]:
    """Set the turns of a limb's two bones, each the smallest one after the other's; return that of the lower."""
    aligned = torch.eye(3, dtype=torch.float64)
    for above, below in itertools.pairwise(limb):
        own, ours = (normalize(each.resting(below) - each.resting(above), dim=0) for each in (target, source))
        aligned = shortest_arc(aligned @ own, ours) @ aligned
        turns[target.joints[above]] = aligned
    return aligned


def _palm(rig: Rig, wrist: int) -> Float[Tensor, " 3"] | None:
    """Return the direction of a hand at rest: to the middle of what hangs from its wrist, None where nothing does."""
    below = [node for node, parent in enumerate(rig.parents) if parent == wrist]
    if not below:
        return None
    bone = rig.rest[below].mean(dim=0) - rig.rest[wrist]
    return normalize(bone, dim=0) if bone.norm() > 1e-6 else None


def _yaw(performer: Performer, side: str) -> Float[Tensor, ""]:
    """Return the angle about the vertical of a foot at rest."""
    heel, toes = performer.resting_sole(side)
    return torch.atan2(toes[1] - heel[1], toes[0] - heel[0])
