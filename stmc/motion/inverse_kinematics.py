"""Rotations from joint positions: what makes motions of joints (MDM, MotionDiffuse, HumanML3D) motions like all others.

Knows how a human body bends: which joints carry several bones, where knees, elbows and feet point. Knows no features.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import normalize

from stmc.motion.body import JOINTS, NUM_ROTATIONS, PARENTS
from stmc.motion.body_model import Skeleton
from stmc.motion.geometry import axis_angle_to_matrix, global_rotations, matrix_to_axis_angle, shortest_arc
from stmc.motion.motion import Motion

_FOOT, _STRAIGHT = 0.03, 0.005
"""What a foot's direction, and having no twist, count against a limb that is bent by a right angle, which counts 1."""
_STIFFNESS = 1.0
"""What the same twist as in the frame before counts."""

_STRAIGHT_HINGE = 0.05
"""The sine of the bend of a limb whose own plane counts as much as the hinge."""


def motion_of_joints(
    joints: Float[Tensor, "frames joints 3"], fps: float | int, skeleton: Skeleton | None = None
) -> Motion:
    """The motion of a body with these joint positions (z up, metres), all 24 or the first 22.

    Joints stay where they are, and missing hands go on from the forearms; with a `skeleton` they are posed, so that
    bones have its lengths: the pelvis' path is scaled about the floor (the lowest joint), by how high the two bodies'
    pelvises stand. Raises `ValueError` for another number of joints, and for no frames.

    Examples:
        >>> [motion] = stmc.load().generate("walk # 0 # 1", steps=1)
        >>> stmc.motion_of_joints(motion.joints[:, :22], fps=20)
        Motion(20 frames at 20 fps, 1.00 s)
    """
    body = Skeleton.default() if skeleton is None else skeleton
    rotations = joints_to_rotations(joints, body)
    joints = _with_hands(joints, rotations, body)
    if skeleton is None:
        return Motion(rotations, joints[:, 0], joints, fps)
    own = Skeleton.measured(rotations, joints, skeleton.offsets[0])
    floor = torch.stack([joints.new_zeros(()), joints.new_zeros(()), joints[..., 2].min()])
    scale = _leg(skeleton) / (_leg(own) or _leg(skeleton))
    return Motion.posed(rotations, floor + (joints[:, 0] - floor) * scale, fps, skeleton)


def bend_limb(
    upper: Float[Tensor, "frames 3 3"],
    lower: Float[Tensor, "frames 3 3"],
    joints: Float[Tensor, "frames 3 3"],
    reach: Float[Tensor, "frames 3"],
    hinge: Float[Tensor, "frames 3"],
) -> tuple[Float[Tensor, "frames 3 3"], Float[Tensor, "frames 3 3"]]:
    """World rotations of the two bones of an arm or a leg that leads along `reach` from where it begins, or as far as
    it can: two-bone inverse kinematics in closed form.

    `joints`: where the limb begins, bends and ends with the rotations `upper` and `lower`. It bends or stretches in the
    plane in which it is bent (about `hinge`, the world's axis of its elbow or knee, where it is straight); then the
    whole limb turns the shortest way.
    """
    first, second = joints[:, 1] - joints[:, 0], joints[:, 2] - joints[:, 1]
    along, below = normalize(first, dim=-1), normalize(second, dim=-1)
    bent = torch.linalg.cross(along, below)
    hinge = normalize(hinge - (hinge * along).sum(dim=-1, keepdim=True) * along, dim=-1)
    axis = normalize(bent + _STRAIGHT_HINGE * hinge, dim=-1)
    now = torch.atan2((bent * axis).sum(dim=-1), (along * below).sum(dim=-1))
    flat = (1 - (below * axis).sum(dim=-1) ** 2).clamp(min=1e-12).sqrt()
    squares = reach.square().sum(dim=-1) - first.square().sum(dim=-1) - second.square().sum(dim=-1)
    cosine = (squares / (2 * first.norm(dim=-1) * second.norm(dim=-1) * flat)).clamp(-1, 1)
    bend = axis_angle_to_matrix(axis * (torch.acos(cosine) - now)[:, None])
    swing = shortest_arc(normalize(first + _rotated(bend, second), dim=-1), normalize(reach, dim=-1))
    return swing @ upper, swing @ bend @ lower


def joints_to_rotations(joints: Float[Tensor, "frames joints 3"], skeleton: Skeleton) -> Float[Tensor, "frames 22 3 3"]:
    """Local rotations that turn `skeleton`'s bones, whatever their lengths, into the directions between `joints`.

    All 24 joints or the first 22, z up. Directions are met exactly, but for the three bones each that pelvis and chest
    carry: these two turn so that all three fit best. Twists, which positions do not show, follow from what else the
    body shows: the spine's from pelvis and chest, upper arms' and thighs' from where elbows and knees point, thighs'
    also from the feet; while a limb is straight, from the frames before and after. The other bones turn the shortest
    way; wrists only where there are hands. A bone without length turns with the one before.

    Raises `ValueError` for another number of joints, and for no frames.
    """
    if joints.shape[1] not in (NUM_ROTATIONS, len(JOINTS)) or not len(joints):
        raise ValueError(
            f"joints must be frames of {NUM_ROTATIONS} or {len(JOINTS)} positions, not {tuple(joints.shape)}"
        )
    rest = skeleton.rest.to(joints)[None, : joints.shape[1]]
    bones = _Bones(_directions(joints), _directions(rest))
    world = bones.trunk()
    for side in ("left", "right"):
        world |= bones.arm(side, world["spine3"]) | bones.leg(side, world["pelvis"])
    turned = torch.stack([world[joint] for joint in JOINTS[:NUM_ROTATIONS]], dim=1)
    return torch.cat([turned[:, :1], turned[:, list(PARENTS[1:NUM_ROTATIONS])].mT @ turned[:, 1:]], dim=1)


def arm_rotations(
    joints: Float[Tensor, "frames 24 3"],
    side: str,
    chest: Float[Tensor, "frames 3 3"],
    skeleton: Skeleton,
) -> Float[Tensor, "frames 2 3 3"]:
    """World rotations of upper arm and forearm on one side that point as `joints` do, below a `chest` (the world
    rotation of spine3); twists as those of `joints_to_rotations`."""
    bones = _Bones(_directions(joints[:, :NUM_ROTATIONS]), _directions(skeleton.rest.to(joints)[None, :NUM_ROTATIONS]))
    world = bones.arm(side, chest)
    return torch.stack([world[f"{side}_shoulder"], world[f"{side}_elbow"]], dim=1)


@dataclass(frozen=True)
class _Bones:
    """Unit vectors along the bones that end in each joint, by its name, as seen in the world and at rest."""

    seen: dict[str, Float[Tensor, "frames 3"]]
    rest: dict[str, Float[Tensor, "1 3"]]

    def trunk(self) -> dict[str, Tensor]:
        """World rotations: what is between pelvis and chest turns step by step."""
        pelvis = self._fitted("left_hip", "right_hip", "spine1")
        chest = self._fitted("neck", "left_collar", "right_collar")
        turn = matrix_to_axis_angle(pelvis.mT @ chest)
        neck = self._swung(chest, "head")
        return {
            "pelvis": pelvis,
            "spine1": self._swung(pelvis @ axis_angle_to_matrix(turn / 3), "spine2"),
            "spine2": self._swung(pelvis @ axis_angle_to_matrix(turn * 2 / 3), "spine3"),
            "spine3": chest,
            "neck": neck,
            "head": neck,
        }

    def arm(self, side: str, chest: Tensor) -> dict[str, Tensor]:
        """World rotations of one side; elbows bend the forearms forward."""
        shoulder, elbow, wrist, hand = (f"{side}_{joint}" for joint in ("shoulder", "elbow", "wrist", "hand"))
        collar = self._swung(chest, shoulder)
        upper = self._swung(collar, elbow)
        upper = self._twisted(upper, elbow, [self._bend(upper, elbow, wrist)])
        fore = self._swung(upper, wrist)
        world = {f"{side}_collar": collar, shoulder: upper, elbow: fore}
        return world | {wrist: self._swung(fore, hand) if hand in self.seen else fore}

    def leg(self, side: str, pelvis: Tensor) -> dict[str, Tensor]:
        """World rotations of one side; knees bend the shins backwards."""
        hip, knee, ankle, foot = (f"{side}_{joint}" for joint in ("hip", "knee", "ankle", "foot"))
        thigh = self._swung(pelvis, knee)
        thigh = self._twisted(thigh, knee, [-self._bend(thigh, knee, ankle), self._pointing(thigh, knee, ankle, foot)])
        shin = self._swung(thigh, ankle)
        toes = self._swung(shin, foot)
        return {hip: thigh, knee: shin, ankle: toes, foot: toes}

    def _fitted(self, *names: str) -> Tensor:
        """The rotation that brings bones at rest closest to where they are seen (Kabsch 1976)."""
        import roma  # not above: it takes as long to import as torch

        seen, rest = (torch.stack([bones[name] for name in names], dim=-1) for bones in (self.seen, self.rest))
        return roma.special_procrustes(seen @ rest.mT)

    def _swung(self, world: Tensor, name: str) -> Tensor:
        """`world`, and the smallest rotation after it that brings a bone to where it is seen."""
        return shortest_arc(_rotated(world, self.rest[name]), self.seen[name]) @ world

    def _twisted(self, world: Tensor, bone: str, hints: Sequence[Tensor]) -> Tensor:
        """`world` turned about `bone` by what the hints say together, little from frame to frame.

        A hint is a vector [frames, 2] for each frame: its direction is the twist (no twist is (1, 0)), its length says
        how much it counts.
        """
        none = hints[0].new_tensor([_STRAIGHT, 0.0]).expand_as(hints[0])
        twist = _steady([*hints, none])
        angle = torch.atan2(twist[:, 1], twist[:, 0])
        return axis_angle_to_matrix(self.seen[bone] * angle[:, None]) @ world

    def _bend(self, world: Tensor, upper: str, lower: str) -> Tensor:
        """The hint that the lower bone gives, were it bent forward."""
        aside = _across(world, self.rest[upper], self.seen[upper], self.seen[lower])
        return aside * aside.norm(dim=-1, keepdim=True)

    def _pointing(self, world: Tensor, upper: str, lower: str, end: str) -> Tensor:
        """The hint that the direction of the foot gives, seen from the upper bone as if the knee were straight."""
        same = torch.eye(3, dtype=world.dtype, device=world.device)[None]
        seen, rest = (
            _across(at, self.rest[upper], bones[upper], _rotated(shortest_arc(bones[lower], bones[upper]), bones[end]))
            for at, bones in ((world, self.seen), (same, self.rest))
        )
        cos, sin = normalize(rest, dim=-1).unbind(dim=-1)
        back = torch.stack([seen[:, 0] * cos + seen[:, 1] * sin, seen[:, 1] * cos - seen[:, 0] * sin], dim=-1)
        return _FOOT * back


def _across(world: Tensor, rest: Tensor, bone: Tensor, vector: Tensor) -> Float[Tensor, "frames 2"]:
    """What of `vector` is perpendicular to `bone`: along the body's forward direction there, and to its side."""
    forward = rest.new_tensor([0.0, 0.0, 1.0])
    forward = _rotated(world, normalize(forward - rest * rest[..., 2:], dim=-1))
    aside = torch.linalg.cross(bone, forward)
    return torch.stack([(vector * forward).sum(dim=-1), (vector * aside).sum(dim=-1)], dim=-1)


def _steady(hints: Sequence[Float[Tensor, "frames 2"]]) -> Float[Tensor, "frames 2"]:
    """The vectors z with the least sum over hints h of |h| |z - h / |h||² and of `_STIFFNESS` |z - z before|²."""
    together = torch.stack(list(hints)).double().cpu().numpy()
    weight, target = np.linalg.norm(together, axis=-1).sum(axis=0), together.sum(axis=0)
    if len(target) > 1:
        bands = np.full((2, len(target)), -_STIFFNESS)
        bands[1] = weight + 2 * _STIFFNESS
        bands[1, [0, -1]] -= _STIFFNESS
        from scipy.linalg import solveh_banded  # not above: it is slow to import

        target = solveh_banded(bands, target)
    return torch.from_numpy(target).to(hints[0])


def _rotated(world: Tensor, vector: Tensor) -> Tensor:
    return (world @ vector[..., None])[..., 0]


def _directions(joints: Float[Tensor, "frames joints 3"]) -> dict[str, Float[Tensor, "frames 3"]]:
    names = JOINTS[: joints.shape[1]]
    bones = joints[:, 1:] - joints[:, list(PARENTS[1 : len(names)])]
    return dict(zip(names[1:], normalize(bones, dim=-1).unbind(dim=1), strict=True))


def _with_hands(joints: Tensor, rotations: Tensor, skeleton: Skeleton) -> Float[Tensor, "frames 24 3"]:
    """All 24 joints: hands that are not given are where `skeleton` has them."""
    wrists = list(PARENTS[joints.shape[1] :])
    hands = skeleton.offsets[joints.shape[1] :].to(joints)
    turned = global_rotations(rotations, PARENTS)[:, wrists]
    return torch.cat([joints, joints[:, wrists] + _rotated(turned, hands)], dim=1)


def _leg(skeleton: Skeleton) -> float:
    """How high the pelvis stands above the feet at rest."""
    rest = skeleton.rest[:, 1]
    return float(rest[0] - rest.min())
