"""Batches for what tells pairs of motion and text from non-pairs: which texts are true of which motions of a batch.

Knows draws of a corpus and the sentences of its clips; knows no network and no loss.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor


def similar(sentences: Float[Tensor, "batch width"], threshold: float | int = 0.8) -> Bool[Tensor, "batch batch"]:
    """Which texts say almost the same, by the scores (cosine / 2 + 1/2) of their sentence embeddings: those above
    `threshold` (TMR, section 3.3)."""
    unit = F.normalize(sentences, dim=-1)
    return (unit @ unit.T) / 2 + 0.5 > threshold
