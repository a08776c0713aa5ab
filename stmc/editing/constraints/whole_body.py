"""Keyframes: the pose of the whole body at a moment."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import torch
from jaxtyping import Float
from torch import Tensor

from stmc.editing.constraints.pose import Pose, check_span
from stmc.motion.geometry import heading, rotation_z
from stmc.motion.motion import Motion


@dataclass(frozen=True, eq=False)
class Keyframe:
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
    unit: ClassVar[str] = "m"

    def __post_init__(self) -> None:
        check_span("keyframe", self.at, None)

    def errors(self, pose: Pose) -> Float[Tensor, " _"]:
        """Metres by which the joint that is farthest off, seen from the pelvis, is elsewhere."""
        span = pose.frames_of(self.at, self.at)
        return self._away(pose, span).norm(dim=-1).amax(dim=-1)

    def residuals(self, pose: Pose) -> Float[Tensor, " _"]:
        """Of each joint, seen from the pelvis, and of its height."""
        span = pose.frames_of(self.at, self.at)
        height = pose.translation[span, 2] - self.pose.translation[0, 2].to(pose.translation)
        return torch.cat([self._away(pose, span).flatten(), height])

    def settled(self, pose: Pose) -> Keyframe:
        """Itself."""
        return self

    def _away(self, pose: Pose, span: slice) -> Float[Tensor, "_ 24 3"]:
        wanted = self.pose.joints[:1].to(pose.joints)
        wanted = _seen(wanted, heading(self.pose.rotations[:1, 0]).to(pose.joints))
        return _seen(pose.joints[span], pose.heading[span]) - wanted


def _seen(joints: Float[Tensor, "_ 24 3"], angle: Float[Tensor, " _"]) -> Float[Tensor, "_ 24 3"]:
    """From the pelvis, turned to heading zero."""
    return (joints - joints[:, :1]) @ rotation_z(-angle).mT
