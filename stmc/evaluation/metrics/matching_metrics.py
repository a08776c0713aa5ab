"""The metrics of Guo et al. (2022) on embeddings: agreement of motions with texts, and variety of motions.

Depends on embeddings compared by Euclidean distance; independent of networks (see `evaluators.guo`). FID is
`realism.frechet_distance` of the same embeddings.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from stmc.evaluation.metrics.retrieval import ranks

POOL_SIZE = 32
"""Number of candidates of R-precision."""
TOP = (1, 2, 3)


def matching_score(texts: Float[Tensor, "pairs width"], motions: Float[Tensor, "pairs width"]) -> float:
    """Return the mean distance between the embeddings of a motion and its text: "MM-Dist"; lower is better."""
    return float((texts - motions).norm(dim=-1).double().mean())


def r_precision(
    texts: Float[Tensor, "pairs width"],
    motions: Float[Tensor, "pairs width"],
    positives: Bool[Tensor, "pairs pairs"] | None = None,
) -> tuple[float, ...]:
    """Return the fractions of texts whose own motion is among the nearest 1, 2 and 3 of the 32 in their batch.

    Batches follow the given order; an incomplete last batch is dropped.

    Args:
        texts: Embeddings of texts, [pairs, width].
        motions: Embeddings of motions, [pairs, width].
        positives: True if text i also describes motion j, [pairs, pairs]. Motion j is then no candidate for text i, so
            that equally correct motions neither lower nor raise the rank.

    Raises:
        ValueError: If there are fewer pairs than one batch.
    """
    hits = [
        _hits(texts[batch], motions[batch], None if positives is None else positives[batch, batch])
        for batch in _batches(len(texts))
    ]
    return _mean_hits(hits)


def r_precision_of_distinct(
    texts: Float[Tensor, "pairs width"], motions: Float[Tensor, "pairs width"], captions: Sequence[str]
) -> tuple[float, ...]:
    """Compute `r_precision` as FlowMDM does, for comparison with its tables.

    Of equal captions within a batch only the first pair is kept, and the fractions refer to the remaining pairs.

    Args:
        texts: Embeddings of texts, [pairs, width].
        motions: Embeddings of motions, [pairs, width].
        captions: Caption of each pair.
    """
    hits = []
    for batch in _batches(len(texts)):
        rows = range(len(texts))[batch]
        first_rows = list({captions[row]: row for row in reversed(rows)}.values())
        hits.append(_hits(texts[first_rows], motions[first_rows]))
    return _mean_hits(hits)


def embedding_diversity(embeddings: Float[Tensor, "_ width"], pairs: int = 300, seed: int = 0) -> float:
    """Return the mean distance of random pairs, whose two sides are drawn separately without replacement.

    Args:
        embeddings: Embeddings, [motions, width].
        pairs: Number of pairs.
        seed: Seed of the pairs.

    Raises:
        ValueError: If there are fewer embeddings than pairs.
    """
    first, second = _pairs(len(embeddings), pairs, seed)
    return float((embeddings[first] - embeddings[second]).norm(dim=-1).double().mean())


def multimodality(embeddings: Float[Tensor, "texts repetitions width"], pairs: int = 10, seed: int = 0) -> float:
    """Return the mean distance of random pairs of motions of one text, over all texts: the variety of its motions.

    All texts use the same pairs.

    Args:
        embeddings: Embeddings, [texts, repetitions, width].
        pairs: Number of pairs.
        seed: Seed of the pairs.

    Raises:
        ValueError: If there are fewer repetitions than pairs.
    """
    first, second = _pairs(embeddings.shape[1], pairs, seed)
    return float((embeddings[:, first] - embeddings[:, second]).norm(dim=-1).double().mean())


def _hits(texts: Tensor, motions: Tensor, positives: Tensor | None = None) -> list[float]:
    table = -torch.cdist(texts, motions, compute_mode="donot_use_mm_for_euclid_dist")
    if positives is not None:
        table = table.masked_fill(positives & ~torch.eye(len(positives), dtype=torch.bool), -torch.inf)
    positions = ranks(table)
    return [float((positions < top).double().mean()) for top in TOP]


def _batches(pairs: int) -> list[slice]:
    if pairs < POOL_SIZE:
        raise ValueError(f"{pairs} pairs are fewer than a batch of {POOL_SIZE}")
    return [slice(start, start + POOL_SIZE) for start in range(0, pairs - POOL_SIZE + 1, POOL_SIZE)]


def _mean_hits(hits: Sequence[Sequence[float]]) -> tuple[float, ...]:
    return tuple(float(fraction) for fraction in np.mean(hits, axis=0))


def _pairs(count: int, pairs: int, seed: int) -> tuple[Tensor, Tensor]:
    if count < pairs:
        raise ValueError(f"{pairs} pairs without replacement need at least {pairs} embeddings; got {count}")
    rng = np.random.RandomState(seed)  # the generator of the published numbers
    first, second = (torch.from_numpy(rng.choice(count, pairs, replace=False)) for _ in range(2))
    return first, second
