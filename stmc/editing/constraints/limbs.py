"""Constraints on hands and feet: a position over a span of time, or no movement.

A finished motion reaches targets to the millimetre: two-bone inverse kinematics bends arms and legs.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from stmc.editing.constraints.constraint import Constraint, Field, span_fields
from stmc.editing.constraints.pose import RAMP, Pose, bump, check_numbers, check_span
from stmc.io.untrusted import quote
from stmc.motion.body import JOINTS, PARENTS, BodyPart
from stmc.motion.body_model import Skeleton
from stmc.motion.geometry import global_rotations
from stmc.motion.inverse_kinematics import bend_limb
from stmc.motion.motion import Motion
from stmc.settings.records import SettingError

_LEAST = 0.001
"""Error in metres within which a limb has reached its target."""

_CHAINS = {
    "wrist": ("shoulder", "elbow", "wrist"),
    "hand": ("shoulder", "elbow", "wrist"),
    "ankle": ("hip", "knee", "ankle"),
    "foot": ("hip", "knee", "ankle"),
}
"""Limb that ends in each joint of a target."""

_HINGES = {
    "left_elbow": (0.0, -1.0, 0.0), "right_elbow": (0.0, 1.0, 0.0), "left_knee": (1.0, 0.0, 0.0),
    "right_knee": (1.0, 0.0, 0.0),
}  # fmt: skip
"""Axis of the upper bone about which the lower bone bends: forearms forwards, shins backwards."""

_OFFERED = tuple(f"{side}_{end}" for end in ("hand", "foot", "wrist", "ankle") for side in ("left", "right"))
_JOINT = Field("joint", "joint", "Joint", "right_hand", (*_OFFERED, "head", "pelvis"))


class _JointConstraint(Constraint):
    """The base of targets and holds: a constraint on the position of one joint."""

    def errors(self, pose: Pose) -> Float[Tensor, " _"]:
        """Compute distances from the position, in metres."""
        return self._offsets(pose).norm(dim=-1)

    def residuals(self, pose: Pose) -> Float[Tensor, " _"]:
        """Compute offsets from the position, in metres along each axis."""
        return self._offsets(pose).flatten()

    def _offsets(self, pose: Pose) -> Float[Tensor, "_ 3"]:
        """Compute offsets in metres at each constrained frame."""
        raise NotImplementedError


@dataclass(frozen=True)
class Target(_JointConstraint):
    """A joint is at `point` (x, y and z in the world, metres) from `start` to `end` seconds (None: for one frame).

    Joints are those of `stmc.motion.body.JOINTS`. Wrists, hands, ankles and feet are exact to the millimetre if arms
    and legs are long enough; the accuracy of other joints, and of the approach, is that of guidance. Raises
    `SettingError` for an unknown joint.

    Examples:
        >>> reach = stmc.Target("right_hand", (-0.2, -0.4, 1.2), start=0.5)
        >>> [motion] = stmc.load().generate("raise the right arm # 0 # 1", steps=1, constraints=[reach])
    """

    joint: str
    point: Sequence[float | int]
    start: float | int = 0.0
    end: float | int | None = None
    name = "target"
    about = "A hand or foot is at a place: drag the ball."
    open_end = "start"
    fields = (*span_fields(1.0), _JOINT, Field("point", "point", "Place", (-0.3, -0.4, 1.2)))

    def __post_init__(self) -> None:
        _check_joint(self.joint)
        check_span(self.joint, self.start, self.end)
        object.__setattr__(self, "point", check_numbers("point", self.point, 3))

    def frames(self, pose: Pose) -> slice:
        """Return the frames from the start to the end, or a single frame."""
        return pose.frames_of(self.start, self.start if self.end is None else self.end)

    def leg_frames(self, pose: Pose) -> slice | None:
        """Return the frames of the target if its joint belongs to the legs."""
        return self.frames(pose) if self.joint in BodyPart.LEGS.joints else None

    def project(self, motion: Motion, skeleton: Skeleton, free: Float[Tensor, "frames 5"]) -> Motion:
        """Bend the limb; if it is too short, move the pelvis by the remaining distance."""
        bent, span = _bend(motion, self, skeleton, free), self.frames(Pose.of(motion))
        if span.start >= span.stop or float(self.errors(Pose.of(bent)).max()) < _LEAST:
            return bent
        offset = bent.joints.new_tensor(self.point) - bent.joints[:, JOINTS.index(self.joint)]
        ramp = bump(motion.frames, span, round(RAMP * motion.fps), offset)
        weight = ramp * free[:, list(BodyPart).index(BodyPart.LEGS)]
        nearest = torch.arange(motion.frames, device=offset.device).clamp(span.start, span.stop - 1)
        translation = motion.translation + weight[:, None] * offset[nearest]
        return _bend(Motion.posed(motion.rotations, translation, motion.fps, skeleton), self, skeleton, free)

    def _offsets(self, pose: Pose) -> Float[Tensor, "_ 3"]:
        positions = pose.joint(self.joint)[self.frames(pose)]
        return positions - positions.new_tensor(self.point)


@dataclass(frozen=True)
class Hold(_JointConstraint):
    """A joint stays in place from `start` to `end` seconds (None: to the end); the motion determines the position.

    Examples:
        >>> hold = stmc.Hold("left_hand", 0.2, 0.8)
        >>> [motion] = stmc.load().generate("walk # 0 # 1", steps=1, constraints=[hold])
    """

    joint: str
    start: float | int = 0.0
    end: float | int | None = None
    name = "hold"
    about = "A hand or foot stays where it is."
    fields = (*span_fields(2.0), _JOINT)

    def __post_init__(self) -> None:
        _check_joint(self.joint)
        check_span(self.joint, self.start, self.end)

    def frames(self, pose: Pose) -> slice:
        """Return the frames from the start to the end."""
        return pose.frames_of(self.start, self.end)

    def anchored_at(self, pose: Pose) -> Target | Hold:
        """Return a target at the joint's mean position in the motion."""
        span = self.frames(pose)
        if span.start >= span.stop:
            return self
        place = pose.joint(self.joint)[span].mean(dim=0).tolist()
        return Target(self.joint, place, self.start, span.stop / pose.fps)

    def _offsets(self, pose: Pose) -> Float[Tensor, "_ 3"]:
        positions = pose.joint(self.joint)[self.frames(pose)]
        return positions - positions.mean(dim=0, keepdim=True)


def _check_joint(joint: str) -> None:
    if joint not in JOINTS:
        raise SettingError(f"joint={quote(joint)}: choose from {', '.join(JOINTS)}")


def _bend(motion: Motion, target: Target, skeleton: Skeleton, free: Tensor) -> Motion:
    """Bend the limb to put the joint at the target, fading in and out; the end of the limb keeps its direction."""
    side, _, end = target.joint.partition("_")
    span = target.frames(Pose.of(motion))
    if end not in _CHAINS or span.start >= span.stop:
        return motion
    chain = [JOINTS.index(f"{side}_{name}") for name in _CHAINS[end]]
    part = list(BodyPart).index(next(part for part in BodyPart if target.joint in part.joints))
    path = motion.joints[:, JOINTS.index(target.joint)]
    offset = path.new_tensor(target.point) - path
    nearest = torch.arange(motion.frames, device=path.device).clamp(span.start, span.stop - 1)
    weight = bump(motion.frames, span, round(RAMP * motion.fps), path) * free[:, part]
    reach = motion.joints[:, chain[-1]] + weight[:, None] * offset[nearest] - motion.joints[:, chain[0]]
    world = global_rotations(motion.rotations, PARENTS)
    hinge = world[:, chain[0]] @ world.new_tensor(_HINGES[JOINTS[chain[1]]])
    upper, lower = bend_limb(world[:, chain[0]], world[:, chain[1]], motion.joints[:, chain], reach, hinge)
    rotations, above = motion.rotations.clone(), world[:, PARENTS[chain[0]]]
    bent = torch.stack([above.mT @ upper, upper.mT @ lower, lower.mT @ world[:, chain[2]]], dim=1)
    changed = weight > 0
    rotations[changed] = rotations[changed].index_copy(1, torch.tensor(chain, device=path.device), bent[changed])
    return Motion.posed(rotations, motion.translation, motion.fps, skeleton)
