"""The interface of every representation: motions as feature vectors with a named layout, and back.

This module derives properties from the layout alone; `smpl`, `humanml3d` and `babel` hold the formulas.
"""

from __future__ import annotations

from typing import Literal, Protocol, runtime_checkable

from jaxtyping import Float
from torch import Tensor

from stmc.motion.body import BodyPart
from stmc.motion.body_model import Skeleton
from stmc.motion.motion import Motion
from stmc.motion.representation.layout import Layout

JointsFrom = Literal["skeleton", "features"]
"""Source of the joints of a decoded motion: a posed skeleton, or the positions in the features."""


@runtime_checkable
class Representation(Protocol):
    """Motion ⇄ features that are not normalised and do not depend on the body's position and heading."""

    def __repr__(self) -> str:
        return f"{type(self).__name__}({', '.join(f'{field.name} {field.size}' for field in self.layout.fields)})"

    @property
    def layout(self) -> Layout:
        """The fields, in order."""
        ...

    @property
    def width(self) -> int:
        """Number of features per frame."""
        return self.layout.width

    @property
    def columns(self) -> dict[BodyPart, tuple[int, ...]]:
        """The columns that each body part owns."""
        return self.layout.columns

    @property
    def skeleton(self) -> Skeleton:
        """The body of the features, unless the data or the user has another one."""
        ...

    def encode(self, motion: Motion) -> Float[Tensor, "_ features"]:
        """Compute the features of a motion in its dtype.

        There are as many rows as frames, or fewer if the format needs a next frame.
        """
        ...

    def decode(
        self,
        features: Float[Tensor, "frames features"],
        fps: float | int,
        skeleton: Skeleton | None = None,
        heading: float | int = 0.0,
    ) -> Motion:
        """Decode any features to a motion with one frame per row, starting above the origin.

        Args:
            features: Features, [frames, features].
            fps: Frames per second.
            skeleton: Skeleton to pose, so that bones have its lengths; None uses the joints of the features.
            heading: Initial heading in radians.
        """
        ...
