"""Keyframes: the pose of the whole body at a point in time."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from stmc.editing.constraints.constraint import Constraint, Field, Order
from stmc.editing.constraints.pose import RAMP, Pose, bump, check_span
from stmc.motion.body import JOINTS, NUM_ROTATIONS, BodyPart
from stmc.motion.body_model import Skeleton
from stmc.motion.geometry import axis_angle_to_matrix, heading, matrix_to_axis_angle, rotation_z
from stmc.motion.motion import Motion
from stmc.settings.records import SettingError

_ROUNDING = 1e-6
"""Rounding tolerance in frames: 1.15 s at 20 frames per second are 22.999… frames."""


@dataclass(frozen=True, eq=False)
class Keyframe(Constraint):
    """The body has the `pose` at `at` seconds: the joint rotations and pelvis height of a motion's first frame.

    Position and heading stay free; see `Path`, `Heading` and `Target`.

    Examples:
        >>> model = stmc.load()
        >>> [raised] = model.generate("raise the right arm # 0 # 1", steps=1)
        >>> key = stmc.Keyframe(raised.trimmed(10, 11), at=0.5)
        >>> [motion] = model.generate("walk # 0 # 1", steps=1, constraints=[key])
    """

    pose: Motion
    at: float | int
    name = "keyframe"
    about = "The body takes the pose at the cursor again at that time."
    tolerance = 0.05
    order = Order.POSE
    fields = (
        Field("at", "moment", "At (s)"),
        Field("second", "motion_second", "Its second"),
        Field("motion", "motion", "Motion"),
    )

    def __post_init__(self) -> None:
        check_span("keyframe", self.at, None)

    def errors(self, pose: Pose) -> Float[Tensor, " _"]:
        """Compute the largest error of a joint relative to the pelvis, in metres."""
        return self._offsets(pose).norm(dim=-1).amax(dim=-1)

    def residuals(self, pose: Pose) -> Float[Tensor, " _"]:
        """Compute offsets of the joints relative to the pelvis, and of its height, in metres."""
        height = pose.translation[self.frames(pose), 2] - self.pose.translation[0, 2].to(pose.translation)
        return torch.cat([self._offsets(pose).flatten(), height])

    def frames(self, pose: Pose) -> slice:
        """Return the frame of the keyframe."""
        return pose.frames_of(self.at, self.at)

    def leg_frames(self, pose: Pose) -> slice:
        """Return the frame of the keyframe."""
        return self.frames(pose)

    def project(self, motion: Motion, skeleton: Skeleton, free: Float[Tensor, "frames 5"]) -> Motion:
        """Turn the joints to the pose, and lift or lower the pelvis to its height."""
        span = self.frames(Pose.of(motion))
        if span.start >= span.stop:
            return motion
        target = self.pose.to(dtype=motion.rotations.dtype)
        goal = target.rotations[0].clone()
        goal[0] = rotation_z(motion.heading[span.start] - target.heading[0]) @ goal[0]
        turn = matrix_to_axis_angle(motion.rotations[span.start].mT @ goal)
        weight = bump(motion.frames, span, round(RAMP * motion.fps), turn)[:, None] * _joint_weights(free)
        rotations = motion.rotations @ axis_angle_to_matrix(weight[..., None] * turn)
        translation = motion.translation.clone()
        translation[:, 2] += weight[:, 0] * (target.translation[0, 2] - translation[span.start, 2])
        return Motion.posed(rotations, translation, motion.fps, skeleton)

    @classmethod
    def from_json(
        cls, find: Callable[[str], Motion], /, at: float | int, motion: str, second: float | int = 0.0
    ) -> Keyframe:
        """Make a keyframe of the pose in a motion.

        Args:
            find: Function that returns a motion by its name.
            at: Time of the keyframe, in seconds.
            motion: Name of the motion.
            second: Time of the pose in the motion, in seconds.
        """
        pose = find(motion)
        if not 0 <= second * pose.fps + _ROUNDING < pose.frames:
            valid = f"must be from 0 to below {pose.duration:g}"
            raise SettingError(f"keyframe: {motion} has no pose at {second:g} s: {valid}")
        frame = int(second * pose.fps + _ROUNDING)
        return cls(pose.trimmed(frame, frame + 1), at)

    def to_json(self, save: Callable[[Motion], str]) -> dict[str, dict[str, Any]]:
        """Return the JSON object, with the pose as a separate motion."""
        return {self.name: {"at": self.at, "motion": save(self.pose)}}

    def _offsets(self, pose: Pose) -> Float[Tensor, "_ 24 3"]:
        span, target = self.frames(pose), self.pose.joints[:1].to(pose.joints)
        target = _local_joints(target, heading(self.pose.rotations[:1, 0]).to(pose.joints))
        return _local_joints(pose.joints[span], pose.heading[span]) - target


def _local_joints(joints: Float[Tensor, "_ 24 3"], angle: Float[Tensor, " _"]) -> Float[Tensor, "_ 24 3"]:
    """Return joints relative to the pelvis, turned to heading zero."""
    return (joints - joints[:, :1]) @ rotation_z(-angle).mT


def _joint_weights(free: Float[Tensor, "frames 5"]) -> Float[Tensor, "frames 22"]:
    owners = [next(i for i, part in enumerate(BodyPart) if joint in part.joints) for joint in JOINTS[:NUM_ROTATIONS]]
    return free[:, owners]
