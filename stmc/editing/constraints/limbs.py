"""Hands and feet: somewhere over a span, or wherever they are but still."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

from jaxtyping import Float
from torch import Tensor

from stmc.editing.constraints.pose import Pose, check_numbers, check_span
from stmc.io.untrusted import shown
from stmc.motion.body import JOINTS
from stmc.settings.records import SettingError


class _OfJoint:
    """What targets and holds share: by how much a joint is `_away` from where it should be."""

    unit: ClassVar[str] = "m"

    def errors(self, pose: Pose) -> Float[Tensor, " _"]:
        """Metres from the place."""
        return self._away(pose).norm(dim=-1)

    def residuals(self, pose: Pose) -> Float[Tensor, " _"]:
        """In each axis."""
        return self._away(pose).flatten()

    def _away(self, pose: Pose) -> Float[Tensor, "_ 3"]:
        """In metres, at each frame that it is about."""
        raise NotImplementedError


@dataclass(frozen=True)
class Target(_OfJoint):
    """A joint is at `point` (x, y and z in the world, metres) from `start` to `end` seconds (None: for one frame).

    Joints are those of `stmc.motion.body.JOINTS`. Wrists, hands, ankles and feet are there to the millimetre where arms
    and legs reach so far; others, and the way there, as well as guidance brings them. Raises `SettingError` for an
    unknown joint.

    Examples:
        >>> reach = stmc.Target("right_hand", (-0.2, -0.4, 1.2), start=0.5)
        >>> [motion] = stmc.load().generate("raise the right arm # 0 # 1", steps=1, constraints=[reach])
    """

    joint: str
    point: Sequence[float | int]
    start: float | int = 0.0
    end: float | int | None = None

    def __post_init__(self) -> None:
        _check_joint(self.joint)
        check_span(self.joint, self.start, self.end)
        object.__setattr__(self, "point", check_numbers("point", self.point, 3))

    def frames(self, pose: Pose) -> slice:
        """The frames it is about.

        Examples:
            >>> [motion] = stmc.load().generate("walk # 0 # 1", steps=1)
            >>> stmc.Target("left_hand", (0, 0, 1), start=0.5).frames(stmc.editing.constraints.Pose.of(motion))
            slice(10, 11, None)
        """
        return pose.frames_of(self.start, self.start if self.end is None else self.end)

    def settled(self, pose: Pose) -> Target:
        """Itself."""
        return self

    def _away(self, pose: Pose) -> Float[Tensor, "_ 3"]:
        where = pose.joint(self.joint)[self.frames(pose)]
        return where - where.new_tensor(self.point)


@dataclass(frozen=True)
class Hold(_OfJoint):
    """A joint stays where it is from `start` to `end` seconds (None: to the end), wherever that is.

    Examples:
        >>> hold = stmc.Hold("left_hand", 0.2, 0.8)
        >>> [motion] = stmc.load().generate("walk # 0 # 1", steps=1, constraints=[hold])
    """

    joint: str
    start: float | int = 0.0
    end: float | int | None = None

    def __post_init__(self) -> None:
        _check_joint(self.joint)
        check_span(self.joint, self.start, self.end)

    def settled(self, pose: Pose) -> Target | Hold:
        """At the place where the motion has it on average."""
        span = pose.frames_of(self.start, self.end)
        if span.start >= span.stop:
            return self
        place = pose.joint(self.joint)[span].mean(dim=0).tolist()
        return Target(self.joint, place, self.start, span.stop / pose.fps)

    def _away(self, pose: Pose) -> Float[Tensor, "_ 3"]:
        where = pose.joint(self.joint)[pose.frames_of(self.start, self.end)]
        return where - where.mean(dim=0, keepdim=True)


def _check_joint(joint: str) -> None:
    if joint not in JOINTS:
        raise SettingError(f"joint={shown(joint)}: choose from {', '.join(JOINTS)}")
