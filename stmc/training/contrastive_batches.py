"""Batches of motions and texts that belong together, for what learns to tell pairs from non-pairs.

Knows no data set and no network.
"""

from __future__ import annotations

from dataclasses import dataclass

from jaxtyping import Bool
from torch import Tensor

from stmc.training.loss import Batch


@dataclass(frozen=True, eq=False)
class Pairs(Batch):
    """A batch whose rows are compared with each other. `alike[i, j]` says that row i's text is true of row j's motion,
    too; None where no two rows have anything in common."""

    alike: Bool[Tensor, "batch batch"] | None = None
