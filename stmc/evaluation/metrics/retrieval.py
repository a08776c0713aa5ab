"""Retrieval between texts and motions: the rank of the correct candidate by its score.

Depends on tables of scores alone. The protocols are those of TMR (Petrovich et al. 2023, section 4.1).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor

COUNTS = (1, 2, 3, 5, 10)
"""The k of the reported recalls R@k."""


@dataclass(frozen=True)
class Retrieval:
    """Results of retrieval in one direction.

    Args:
        recall: Percentage of queries with a correct answer among the best k, by k.
        median_rank: Median rank of the correct answer; 1 is best.
        candidates: Number of candidates.
    """

    recall: dict[int, float]
    median_rank: float
    candidates: int


def cosines(
    queries: Float[Tensor, "queries width"], candidates: Float[Tensor, "candidates width"]
) -> Float[Tensor, "queries candidates"]:
    """Compute cosine similarities between latents, in [-1, 1]."""
    return F.normalize(queries, dim=-1) @ F.normalize(candidates, dim=-1).T


def scores(cosine: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
    """Convert cosines to scores in [0, 1], (1 + cosine) / 2, as in TMR-Score."""
    return (1 + cosine) / 2


def ranks(
    table: Float[Tensor, "queries candidates"], right: Bool[Tensor, "queries candidates"] | None = None
) -> Float[Tensor, " queries"]:
    """Count the wrong candidates that score better than the correct one (0 is best); ties count half.

    `right` is True at each query's correct answers, the diagonal by default; the best of several counts (TMR's protocol
    "threshold"). Raises `ValueError` if a query has no correct answer, or a score is NaN.
    """
    if table.isnan().any():
        raise ValueError(f"{int(table.isnan().sum())} of {table.numel()} scores are NaN")
    if right is None:
        if len(table) != table.shape[1]:
            raise ValueError(f"{len(table)} queries and {table.shape[1]} candidates; pass `right`")
        right = torch.eye(len(table), dtype=torch.bool, device=table.device)
    if not right.any(dim=1).all():
        raise ValueError(f"query {int((~right.any(dim=1)).nonzero()[0])} has no correct answer")
    best = table.masked_fill(~right, -torch.inf).amax(dim=1, keepdim=True)
    return (table > best).sum(dim=1) + ((table == best) & ~right).sum(dim=1) / 2


def summary(positions: Float[Tensor, " queries"], candidates: int) -> Retrieval:
    """Compute recalls and the median from `ranks`."""
    recall = {count: 100 * float((positions < count).double().mean()) for count in COUNTS}
    return Retrieval(recall, float(np.median(positions.numpy(force=True))) + 1, candidates)


def t2m_m2t(
    table: Float[Tensor, "pairs pairs"], right: Bool[Tensor, "pairs pairs"] | None = None
) -> tuple[Retrieval, Retrieval]:
    """Evaluate text-to-motion and motion-to-text retrieval from scores [text, motion] of pairs: the protocol "all".

    `right` is True if text i also describes motion j: the protocol "threshold", for example with `similar_texts`.
    """
    back = None if right is None else right.T
    return summary(ranks(table, right), len(table)), summary(ranks(table.T, back), len(table))


def similar_texts(
    sentences: Float[Tensor, "pairs width"], threshold: float | int = 0.95
) -> Bool[Tensor, "pairs pairs"]:
    """Return which texts have nearly the same meaning: their sentence embeddings score above `threshold`."""
    return (scores(cosines(sentences, sentences)) > threshold).fill_diagonal_(True)


def small_batches(
    table: Float[Tensor, "pairs pairs"], names: Sequence[str], size: int = 32
) -> tuple[Retrieval, Retrieval]:
    """Evaluate retrieval within batches: the protocol "guo", text-to-motion and motion-to-text.

    Pairs are sorted by name and shuffled with a fixed seed; an incomplete last batch is dropped, and the results of the
    batches are averaged.

    Args:
        table: Scores [text, motion] of pairs.
        names: Name of each pair.
        size: Number of pairs in a batch.

    Raises:
        ValueError: If there are fewer pairs than one batch.
    """
    if len(names) < size:
        raise ValueError(f"{len(names)} pairs are fewer than a batch of {size}")
    order = np.argsort(np.array(names), kind="stable")
    np.random.RandomState(0).shuffle(order)
    batches = torch.from_numpy(order[: len(order) // size * size]).reshape(-1, size)
    results = [t2m_m2t(table[batch][:, batch]) for batch in batches]
    return _mean([first for first, _ in results]), _mean([second for _, second in results])


def _mean(results: Sequence[Retrieval]) -> Retrieval:
    recall = {count: float(np.mean([result.recall[count] for result in results])) for count in COUNTS}
    return Retrieval(recall, float(np.mean([result.median_rank for result in results])), results[0].candidates)
