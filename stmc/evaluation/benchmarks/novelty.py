"""How far the sentences of a test are from those of a training, and what a model makes of near and of far ones.

Knows sentences and their embeddings; knows no model.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import pairwise
from statistics import fmean
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from stmc.text import TextEncoder
from stmc.text.vocabulary.sentences import embed_sentences

EDGES = (0.7, 0.8, 0.9)
"""Cosines between the bins. From the last on a sentence is nearly one of the training, in another order."""


class Bin(NamedTuple):
    """Sentences whose nearest training sentence is about as near: the cosines, how many, and their mean success (None
    of none)."""

    name: str
    count: int
    success: float | None


def nearest_cosines(
    sentences: Sequence[str], training: Sequence[str], encoder: TextEncoder
) -> Float[Tensor, " sentences"]:
    """The cosine of each sentence to the nearest one of the training."""
    asked, known = (embed_sentences(list(dict.fromkeys(texts)), encoder) for texts in (sentences, training))
    nearest = dict(zip(dict.fromkeys(sentences), (asked @ known.T).amax(dim=1).tolist(), strict=True))
    return torch.tensor([nearest[text] for text in sentences])


def success_by_distance(shares: Mapping[str, float], training: Sequence[str], encoder: TextEncoder) -> list[Bin]:
    """The mean of the `shares` (of samples that show what a sentence says) in bins of the distance to the training."""
    cosines, found = nearest_cosines(list(shares), training, encoder).tolist(), []
    for low, high in pairwise((-float("inf"), *EDGES, float("inf"))):
        own = [share for share, cosine in zip(shares.values(), cosines, strict=True) if low <= cosine < high]
        name = f"below {high:g}" if low < -1 else f"{low:g} and more" if high > 1 else f"{low:g} to {high:g}"
        found.append(Bin(name, len(own), fmean(own) if own else None))
    return found
