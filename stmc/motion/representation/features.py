"""What every representation is: motions as feature vectors with a named layout, and back.

Knows what follows from the layout alone, and no formula: these are `smpl`'s, `humanml3d`'s and `babel`'s.
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
"""Where a decoded motion has its joints from: a skeleton that is posed, or the features' own positions."""


@runtime_checkable
class Representation(Protocol):
    """Motion ⇄ features that are not normalised and do not depend on where the body stands and looks."""

    def __repr__(self) -> str:
        return f"{type(self).__name__}({', '.join(f'{each.name} {each.size}' for each in self.layout.fields)})"

    @property
    def layout(self) -> Layout:
        """The fields, in their order."""
        ...

    @property
    def width(self) -> int:
        """Numbers per frame."""
        return self.layout.width

    @property
    def columns(self) -> dict[BodyPart, tuple[int, ...]]:
        """The columns that each body part owns."""
        return self.layout.columns

    @property
    def skeleton(self) -> Skeleton:
        """The body whose motions the features are, unless the data or the user has another."""
        ...

    def encode(self, motion: Motion) -> Float[Tensor, "_ features"]:
        """Features of the motion in its dtype; as many rows as frames, or fewer where the format needs a next frame."""
        ...

    def decode(
        self,
        features: Float[Tensor, "frames features"],
        fps: float | int,
        skeleton: Skeleton | None = None,
        heading: float | int = 0.0,
    ) -> Motion:
        """A motion with a frame for each row that starts above the origin with `heading` radians, from any features.

        Joints are the features' own; with a `skeleton` it is posed, so that bones keep its lengths.
        """
        ...
