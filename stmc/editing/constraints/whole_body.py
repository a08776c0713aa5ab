"""Keyframes: the pose of the whole body at a moment."""

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
"""Frames by which a second may miss the frame that it names: 1.15 s at 20 frames a second are 22.999… frames."""


@dataclass(frozen=True, eq=False)
class Keyframe(Constraint):
    """The body has the `pose` at `at` seconds: rotations of all joints and the height of the pelvis, as they are in
    the first frame of a motion. Where it stands and looks is left open: see `Path`, `Heading` and `Target`.

    Examples:
        >>> model = stmc.load()
        >>> [raised] = model.generate("raise the right arm # 0 # 1", steps=1)
        >>> key = stmc.Keyframe(raised.trimmed(10, 11), at=0.5)
        >>> [motion] = model.generate("walk # 0 # 1", steps=1, constraints=[key])
    """

    pose: Motion
    at: float | int
    name = "keyframe"
    about = "The pose at the cursor is had again at that time."
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
        """Metres by which the joint that is farthest off, seen from the pelvis, is elsewhere."""
        return self._away(pose).norm(dim=-1).amax(dim=-1)

    def residuals(self, pose: Pose) -> Float[Tensor, " _"]:
        """Of each joint, seen from the pelvis, and of its height."""
        height = pose.translation[self.frames(pose), 2] - self.pose.translation[0, 2].to(pose.translation)
        return torch.cat([self._away(pose).flatten(), height])

    def frames(self, pose: Pose) -> slice:
        """The one frame."""
        return pose.frames_of(self.at, self.at)

    def leg_frames(self, pose: Pose) -> slice:
        """The one frame."""
        return self.frames(pose)

    def project(self, motion: Motion, skeleton: Skeleton, free: Float[Tensor, "frames 5"]) -> Motion:
        """Turn the joints to the pose, and lift or lower the pelvis to its height."""
        span = self.frames(Pose.of(motion))
        if span.start >= span.stop:
            return motion
        wanted = self.pose.to(dtype=motion.rotations.dtype)
        goal = wanted.rotations[0].clone()
        goal[0] = rotation_z(motion.heading[span.start] - wanted.heading[0]) @ goal[0]
        left = matrix_to_axis_angle(motion.rotations[span.start].mT @ goal)
        share = bump(motion.frames, span, round(RAMP * motion.fps), left)[:, None] * _of_joints(free)
        rotations = motion.rotations @ axis_angle_to_matrix(share[..., None] * left)
        translation = motion.translation.clone()
        translation[:, 2] += share[:, 0] * (wanted.translation[0, 2] - translation[span.start, 2])
        return Motion.posed(rotations, translation, motion.fps, skeleton)

    @classmethod
    def from_json(
        cls, find: Callable[[str], Motion], /, at: float | int, motion: str, second: float | int = 0.0
    ) -> Keyframe:
        """The pose at a `second` of the motion that `find` finds by its name."""
        pose = find(motion)
        if not 0 <= second * pose.fps + _ROUNDING < pose.frames:
            allowed = f"from 0 to below {pose.duration:g} needed"
            raise SettingError(f"keyframe: {motion} has no pose at {second:g} s: {allowed}")
        frame = int(second * pose.fps + _ROUNDING)
        return cls(pose.trimmed(frame, frame + 1), at)

    def to_json(self, save: Callable[[Motion], str]) -> dict[str, dict[str, Any]]:
        """The pose as a motion of its own."""
        return {self.name: {"at": self.at, "motion": save(self.pose)}}

    def _away(self, pose: Pose) -> Float[Tensor, "_ 24 3"]:
        span, wanted = self.frames(pose), self.pose.joints[:1].to(pose.joints)
        wanted = _seen(wanted, heading(self.pose.rotations[:1, 0]).to(pose.joints))
        return _seen(pose.joints[span], pose.heading[span]) - wanted


def _seen(joints: Float[Tensor, "_ 24 3"], angle: Float[Tensor, " _"]) -> Float[Tensor, "_ 24 3"]:
    """From the pelvis, turned to heading zero."""
    return (joints - joints[:, :1]) @ rotation_z(-angle).mT


def _of_joints(free: Float[Tensor, "frames 5"]) -> Float[Tensor, "frames 22"]:
    owners = [next(i for i, part in enumerate(BodyPart) if joint in part.joints) for joint in JOINTS[:NUM_ROTATIONS]]
    return free[:, owners]
