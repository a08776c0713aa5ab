"""Batches of matching motions and texts, for contrastive objectives."""

from __future__ import annotations

from dataclasses import dataclass

from jaxtyping import Bool
from torch import Tensor

from stmc.training.loss import Batch


@dataclass(frozen=True, eq=False)
class Pairs(Batch):
    """A batch whose rows are contrasted with each other.

    `alike[i, j]` is True if the text of row i also describes the motion of row j; None if no two rows match.
    """

    alike: Bool[Tensor, "batch batch"] | None = None
