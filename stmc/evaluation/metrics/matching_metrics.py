"""The measures of Guo et al. (2022) on embeddings: whether motions match their texts, and how varied motions are.

Knows embeddings compared by Euclidean distance; knows no network (see `evaluators.guo`). FID is `realism`'s
`frechet_distance` of the same embeddings.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from stmc.evaluation.metrics.retrieval import ranks

POOL_SIZE = 32
"""Candidates among which R-precision looks for the right motion."""

TOP = (1, 2, 3)


def matching_score(texts: Float[Tensor, "pairs width"], motions: Float[Tensor, "pairs width"]) -> float:
    """Mean distance of a motion's embedding from its text's: "MM-Dist" in tables; lower is better."""
    return float((texts - motions).norm(dim=-1).double().mean())


def r_precision(
    texts: Float[Tensor, "pairs width"],
    motions: Float[Tensor, "pairs width"],
    positives: Bool[Tensor, "pairs pairs"] | None = None,
) -> tuple[float, ...]:
    """Shares of texts whose own motion is among the nearest 1, 2 and 3 of the 32 in their batch, in the given order;
    what is left over is dropped.

    `positives[i, j]` that text i is true of motion j, too: then j is no candidate for i, so that equally right motions
    neither spoil nor save the text's own. Raises `ValueError` for less than one batch.
    """
    hits = [
        _hits(texts[batch], motions[batch], None if positives is None else positives[batch, batch])
        for batch in _batches(len(texts))
    ]
    return _shares(hits)


def r_precision_of_distinct(
    texts: Float[Tensor, "pairs width"], motions: Float[Tensor, "pairs width"], captions: Sequence[str]
) -> tuple[float, ...]:
    """`r_precision` as FlowMDM has it: of equal captions within a batch only the first pair is kept, and the batch's
    shares are over those that are left. For comparison with its tables."""
    hits = []
    for batch in _batches(len(texts)):
        rows = range(len(texts))[batch]
        kept = list({captions[row]: row for row in reversed(rows)}.values())
        hits.append(_hits(texts[kept], motions[kept]))
    return _shares(hits)


def embedding_diversity(embeddings: Float[Tensor, "_ width"], pairs: int = 300, seed: int = 0) -> float:
    """Mean distance of `pairs` random pairs, the two sides drawn without replacement each for itself.

    Raises `ValueError` for less embeddings than pairs.
    """
    first, second = _pairs(len(embeddings), pairs, seed)
    return float((embeddings[first] - embeddings[second]).norm(dim=-1).double().mean())


def multimodality(embeddings: Float[Tensor, "texts repetitions width"], pairs: int = 10, seed: int = 0) -> float:
    """Mean distance of `pairs` random pairs of motions of one text, over all texts: how varied its motions are.

    The same pairs for all texts. Raises `ValueError` for less repetitions than pairs.
    """
    first, second = _pairs(embeddings.shape[1], pairs, seed)
    return float((embeddings[:, first] - embeddings[:, second]).norm(dim=-1).double().mean())


def _hits(texts: Tensor, motions: Tensor, positives: Tensor | None = None) -> list[float]:
    table = -torch.cdist(texts, motions, compute_mode="donot_use_mm_for_euclid_dist")
    if positives is not None:
        table = table.masked_fill(positives & ~torch.eye(len(positives), dtype=torch.bool), -torch.inf)
    found = ranks(table)
    return [float((found < top).double().mean()) for top in TOP]


def _batches(pairs: int) -> list[slice]:
    if pairs < POOL_SIZE:
        raise ValueError(f"{pairs} pairs make no batch of {POOL_SIZE}")
    return [slice(start, start + POOL_SIZE) for start in range(0, pairs - POOL_SIZE + 1, POOL_SIZE)]


def _shares(hits: Sequence[Sequence[float]]) -> tuple[float, ...]:
    return tuple(float(share) for share in np.mean(hits, axis=0))


def _pairs(count: int, pairs: int, seed: int) -> tuple[Tensor, Tensor]:
    if count < pairs:
        raise ValueError(f"{pairs} pairs without replacement need as many embeddings, not {count}")
    rng = np.random.RandomState(seed)  # the generator of the published numbers
    return tuple(torch.from_numpy(rng.choice(count, pairs, replace=False)) for _ in range(2))
