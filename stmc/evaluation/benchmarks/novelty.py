"""The distance of test sentences from training sentences, and the success of a model on near and far ones."""

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
"""Cosines between the bins. A sentence in the last bin is nearly a training sentence with the words in another order.
"""


class Bin(NamedTuple):
    """Sentences with a similar distance from training.

    Args:
        name: Range of cosines to the nearest training sentence.
        size: Number of sentences.
        success: Their mean success, or None without sentences.
    """

    name: str
    size: int
    success: float | None


def nearest_cosines(
    sentences: Sequence[str], training: Sequence[str], encoder: TextEncoder
) -> Float[Tensor, " sentences"]:
    """Compute the cosine between each sentence and its nearest training sentence.

    Args:
        sentences: Test sentences.
        training: Training sentences.
        encoder: Text encoder.
    """
    tested, trained = (embed_sentences(list(dict.fromkeys(texts)), encoder) for texts in (sentences, training))
    nearest = dict(zip(dict.fromkeys(sentences), (tested @ trained.T).amax(dim=1).tolist(), strict=True))
    return torch.tensor([nearest[text] for text in sentences])


def success_by_distance(shares: Mapping[str, float], training: Sequence[str], encoder: TextEncoder) -> list[Bin]:
    """Average success rates in bins of the distance from training.

    Args:
        shares: Fraction of samples that show each sentence.
        training: Training sentences.
        encoder: Text encoder.
    """
    cosines, bins = nearest_cosines(list(shares), training, encoder).tolist(), []
    for low, high in pairwise((-float("inf"), *EDGES, float("inf"))):
        successes = [success for success, cosine in zip(shares.values(), cosines, strict=True) if low <= cosine < high]
        name = f"below {high:g}" if low < -1 else f"{low:g} and more" if high > 1 else f"{low:g} to {high:g}"
        bins.append(Bin(name, len(successes), fmean(successes) if successes else None))
    return bins
