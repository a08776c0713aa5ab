"""Rotations from joint positions, which turn joints (of MDM, MotionDiffuse, HumanML3D) into a `Motion`.

Depends on how a human body bends: joints with several bones, and the directions of knees, elbows and feet. Independent
of features.
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
"""Weights of the foot's direction and of no twist, relative to 1 for a limb bent at a right angle."""
_STIFFNESS = 1.0
"""Weight of an unchanged twist from one frame to the next."""
_STRAIGHT_HINGE = 0.05
"""Sine of the bend at which the plane of a limb has the same weight as its hinge."""


def motion_of_joints(
    joints: Float[Tensor, "frames joints 3"], fps: float | int, skeleton: Skeleton | None = None
) -> Motion:
    """Build a motion from joint positions (z up, metres), all 24 or the first 22.

    Without a `skeleton`, joints keep their positions, and missing hands extend the forearms. With a `skeleton`, the
    motion is posed on it, so that bones have its lengths: the path of the pelvis is scaled about the floor (the lowest
    joint) by the ratio of the pelvis heights of the two bodies.

    Args:
        joints: Joint positions, [frames, joints, 3].
        fps: Frames per second.
        skeleton: Skeleton to pose, or None.

    Raises:
        ValueError: If the number of joints is neither 22 nor 24, or there are no frames.

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
    source = Skeleton.measured(rotations, joints, skeleton.offsets[0])
    floor = torch.stack([joints.new_zeros(()), joints.new_zeros(()), joints[..., 2].min()])
    scale = _pelvis_height(skeleton) / (_pelvis_height(source) or _pelvis_height(skeleton))
    return Motion.posed(rotations, floor + (joints[:, 0] - floor) * scale, fps, skeleton)


def bend_limb(
    upper: Float[Tensor, "frames 3 3"],
    lower: Float[Tensor, "frames 3 3"],
    joints: Float[Tensor, "frames 3 3"],
    reach: Float[Tensor, "frames 3"],
    hinge: Float[Tensor, "frames 3"],
) -> tuple[Float[Tensor, "frames 3 3"], Float[Tensor, "frames 3 3"]]:
    """Solve two-bone inverse kinematics in closed form for an arm or a leg.

    The limb bends or stretches in its current plane (or about `hinge` if it is straight); then the whole limb rotates
    by the shortest arc. A target that is too far is reached for as far as possible.

    Args:
        upper: World rotations of the upper bone, before.
        lower: World rotations of the lower bone, before.
        joints: Positions of the limb's start, bend and end for these rotations, [frames, 3, 3].
        reach: Vector from the start of the limb to the target.
        hinge: World axis of the elbow or knee, which defines the plane of a straight limb.

    Returns:
        World rotations of the upper and the lower bone, after.
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
    swing = shortest_arc(normalize(first + _rotate(bend, second), dim=-1), normalize(reach, dim=-1))
    return swing @ upper, swing @ bend @ lower


def joints_to_rotations(joints: Float[Tensor, "frames joints 3"], skeleton: Skeleton) -> Float[Tensor, "frames 22 3 3"]:
    """Compute local rotations that align the bones of `skeleton`, whatever their lengths, with those between `joints`.

    `joints` are all 24 or the first 22, z up. Directions are matched exactly, except for the three bones of the pelvis
    and of the chest, which are fitted jointly. Twists, which positions do not determine, follow from other joints: the
    spine's from pelvis and chest, those of upper arms and thighs from the directions of elbows and knees, those of
    thighs also from the feet; while a limb is straight, from the frames before and after. All other bones rotate by the
    shortest arc; wrists only if hands are given. A bone without length rotates with its parent.

    Raises `ValueError` if the number of joints is neither 22 nor 24, or there are no frames.
    """
    if joints.shape[1] not in (NUM_ROTATIONS, len(JOINTS)) or not len(joints):
        raise ValueError(
            f"joints must have shape [frames, {NUM_ROTATIONS} or {len(JOINTS)}, 3], not {tuple(joints.shape)}"
        )
    rest = skeleton.rest.to(joints)[None, : joints.shape[1]]
    bones = _Bones(_directions(joints), _directions(rest))
    world = bones.trunk()
    for side in ("left", "right"):
        world |= bones.arm(side, world["spine3"]) | bones.leg(side, world["pelvis"])
    rotations = torch.stack([world[joint] for joint in JOINTS[:NUM_ROTATIONS]], dim=1)
    return torch.cat([rotations[:, :1], rotations[:, list(PARENTS[1:NUM_ROTATIONS])].mT @ rotations[:, 1:]], dim=1)


def arm_rotations(
    joints: Float[Tensor, "frames 24 3"], side: str, chest: Float[Tensor, "frames 3 3"], skeleton: Skeleton
) -> Float[Tensor, "frames 2 3 3"]:
    """Compute world rotations of the upper arm and forearm of one side that match the directions of `joints`.

    Twists are chosen as in `joints_to_rotations`.

    Args:
        joints: Joint positions, [frames, 24, 3].
        side: "left" or "right".
        chest: World rotations of spine3, [frames, 3, 3].
        skeleton: Skeleton of the body.
    """
    bones = _Bones(_directions(joints[:, :NUM_ROTATIONS]), _directions(skeleton.rest.to(joints)[None, :NUM_ROTATIONS]))
    world = bones.arm(side, chest)
    return torch.stack([world[f"{side}_shoulder"], world[f"{side}_elbow"]], dim=1)


@dataclass(frozen=True)
class _Bones:
    """Unit vectors along the bones that end in each joint, by name, in the world (`seen`) and at rest."""

    seen: dict[str, Float[Tensor, "frames 3"]]
    rest: dict[str, Float[Tensor, "1 3"]]

    def trunk(self) -> dict[str, Tensor]:
        """Compute world rotations; the joints between pelvis and chest share the rotation evenly."""
        pelvis = self._fit("left_hip", "right_hip", "spine1")
        chest = self._fit("neck", "left_collar", "right_collar")
        turn = matrix_to_axis_angle(pelvis.mT @ chest)
        neck = self._swing(chest, "head")
        return {
            "pelvis": pelvis,
            "spine1": self._swing(pelvis @ axis_angle_to_matrix(turn / 3), "spine2"),
            "spine2": self._swing(pelvis @ axis_angle_to_matrix(turn * 2 / 3), "spine3"),
            "spine3": chest,
            "neck": neck,
            "head": neck,
        }

    def arm(self, side: str, chest: Tensor) -> dict[str, Tensor]:
        """Compute world rotations of one side; elbows bend the forearms forwards."""
        shoulder, elbow, wrist, hand = (f"{side}_{joint}" for joint in ("shoulder", "elbow", "wrist", "hand"))
        collar = self._swing(chest, shoulder)
        upper = self._swing(collar, elbow)
        upper = self._twist(upper, elbow, [self._bend_hint(upper, elbow, wrist)])
        fore = self._swing(upper, wrist)
        world = {f"{side}_collar": collar, shoulder: upper, elbow: fore}
        return world | {wrist: self._swing(fore, hand) if hand in self.seen else fore}

    def leg(self, side: str, pelvis: Tensor) -> dict[str, Tensor]:
        """Compute world rotations of one side; knees bend the shins backwards."""
        hip, knee, ankle, foot = (f"{side}_{joint}" for joint in ("hip", "knee", "ankle", "foot"))
        thigh = self._swing(pelvis, knee)
        thigh = self._twist(
            thigh, knee, [-self._bend_hint(thigh, knee, ankle), self._foot_hint(thigh, knee, ankle, foot)]
        )
        shin = self._swing(thigh, ankle)
        toes = self._swing(shin, foot)
        return {hip: thigh, knee: shin, ankle: toes, foot: toes}

    def _fit(self, *names: str) -> Tensor:
        """Fit the rotation that best aligns bones at rest with the observed bones (Kabsch 1976)."""
        import roma  # imported late: it takes as long to import as torch

        seen, rest = (torch.stack([bones[name] for name in names], dim=-1) for bones in (self.seen, self.rest))
        return roma.special_procrustes(seen @ rest.mT)

    def _swing(self, world: Tensor, name: str) -> Tensor:
        """Append to `world` the smallest rotation that aligns a bone with its observed direction."""
        return shortest_arc(_rotate(world, self.rest[name]), self.seen[name]) @ world

    def _twist(self, world: Tensor, bone: str, hints: Sequence[Tensor]) -> Tensor:
        """Rotate `world` about `bone` by the combined hints, with little change from frame to frame.

        A hint is a vector [frames, 2] whose direction is the twist ((1, 0) is no twist) and whose length is its weight.
        """
        none = hints[0].new_tensor([_STRAIGHT, 0.0]).expand_as(hints[0])
        twist = _smooth_twist([*hints, none])
        angle = torch.atan2(twist[:, 1], twist[:, 0])
        return axis_angle_to_matrix(self.seen[bone] * angle[:, None]) @ world

    def _bend_hint(self, world: Tensor, upper: str, lower: str) -> Tensor:
        """Return the hint of the lower bone, assuming that it bends forwards."""
        aside = _across(world, self.rest[upper], self.seen[upper], self.seen[lower])
        return aside * aside.norm(dim=-1, keepdim=True)

    def _foot_hint(self, world: Tensor, upper: str, lower: str, end: str) -> Tensor:
        """Return the hint of the foot's direction, seen from the upper bone as if the knee were straight."""
        identity = torch.eye(3, dtype=world.dtype, device=world.device)[None]
        seen, rest = (
            _across(at, self.rest[upper], bones[upper], _rotate(shortest_arc(bones[lower], bones[upper]), bones[end]))
            for at, bones in ((world, self.seen), (identity, self.rest))
        )
        cos, sin = normalize(rest, dim=-1).unbind(dim=-1)
        back = torch.stack([seen[:, 0] * cos + seen[:, 1] * sin, seen[:, 1] * cos - seen[:, 0] * sin], dim=-1)
        return _FOOT * back


def _across(world: Tensor, rest: Tensor, bone: Tensor, vector: Tensor) -> Float[Tensor, "frames 2"]:
    """Return the components of `vector` perpendicular to `bone`: along the body's forward direction, and sideways."""
    forward = rest.new_tensor([0.0, 0.0, 1.0])
    forward = _rotate(world, normalize(forward - rest * rest[..., 2:], dim=-1))
    aside = torch.linalg.cross(bone, forward)
    return torch.stack([(vector * forward).sum(dim=-1), (vector * aside).sum(dim=-1)], dim=-1)


def _smooth_twist(hints: Sequence[Float[Tensor, "frames 2"]]) -> Float[Tensor, "frames 2"]:
    """Minimise the sum over hints h of |h| |z - h / |h||² plus `_STIFFNESS` |z - previous z|² over vectors z."""
    stacked = torch.stack(list(hints)).double().cpu().numpy()
    weight, target = np.linalg.norm(stacked, axis=-1).sum(axis=0), stacked.sum(axis=0)
    if len(target) > 1:
        bands = np.full((2, len(target)), -_STIFFNESS)
        bands[1] = weight + 2 * _STIFFNESS
        bands[1, [0, -1]] -= _STIFFNESS
        from scipy.linalg import solveh_banded  # imported late: it is slow to import

        target = solveh_banded(bands, target)
    return torch.from_numpy(target).to(hints[0])


def _rotate(world: Tensor, vector: Tensor) -> Tensor:
    return (world @ vector[..., None])[..., 0]


def _directions(joints: Float[Tensor, "frames joints 3"]) -> dict[str, Float[Tensor, "frames 3"]]:
    names = JOINTS[: joints.shape[1]]
    bones = joints[:, 1:] - joints[:, list(PARENTS[1 : len(names)])]
    return dict(zip(names[1:], normalize(bones, dim=-1).unbind(dim=1), strict=True))


def _with_hands(joints: Tensor, rotations: Tensor, skeleton: Skeleton) -> Float[Tensor, "frames 24 3"]:
    """Append missing hands, placed by `skeleton`, to get all 24 joints."""
    wrists = list(PARENTS[joints.shape[1] :])
    hands = skeleton.offsets[joints.shape[1] :].to(joints)
    world = global_rotations(rotations, PARENTS)[:, wrists]
    return torch.cat([joints, joints[:, wrists] + _rotate(world, hands)], dim=1)


def _pelvis_height(skeleton: Skeleton) -> float:
    """Return the height of the pelvis above the feet at rest."""
    rest = skeleton.rest[:, 1]
    return float(rest[0] - rest.min())
