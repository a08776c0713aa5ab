"""Retrieval between texts and motions: where the right one stands among all candidates, by their scores.

Knows tables of scores alone. Protocols are those of TMR (Petrovich et al. 2023, section 4.1).
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
"""The k of the recalls R@k that are reported."""


@dataclass(frozen=True)
class Retrieval:
    """How one side was found from the other: the shares in percent of queries whose right answer was among the best k,
    by k; the median rank, 1 being best; and how many candidates there were."""

    recall: dict[int, float]
    median_rank: float
    candidates: int


def cosines(
    queries: Float[Tensor, "queries width"], candidates: Float[Tensor, "candidates width"]
) -> Float[Tensor, "queries candidates"]:
    """Cosines of the angles between latents, in [-1, 1]."""
    return F.normalize(queries, dim=-1) @ F.normalize(candidates, dim=-1).T


def scores(cosine: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
    """Cosines as scores in [0, 1]: (1 + cosine) / 2, as TMR-Score has it."""
    return (1 + cosine) / 2


def ranks(
    table: Float[Tensor, "queries candidates"], right: Bool[Tensor, "queries candidates"] | None = None
) -> Float[Tensor, " queries"]:
    """How many wrong candidates score better than the right one (0 is best); of those that tie with it, half.

    `right` names each query's right answers, the diagonal by default; of several, the best counts (that is TMR's
    protocol "threshold"). Raises `ValueError` for a query without any, and for scores that are not numbers.
    """
    if table.isnan().any():
        raise ValueError(f"{int(table.isnan().sum())} of {table.numel()} scores are not numbers")
    if right is None:
        if len(table) != table.shape[1]:
            raise ValueError(f"{len(table)} queries and {table.shape[1]} candidates: say which are right")
        right = torch.eye(len(table), dtype=torch.bool, device=table.device)
    if not right.any(dim=1).all():
        raise ValueError(f"query {int((~right.any(dim=1)).nonzero()[0])} has no right answer")
    best = table.masked_fill(~right, -torch.inf).amax(dim=1, keepdim=True)
    return (table > best).sum(dim=1) + ((table == best) & ~right).sum(dim=1) / 2


def summary(found: Float[Tensor, " queries"], candidates: int) -> Retrieval:
    """Recalls and median of `ranks`."""
    recall = {count: 100 * float((found < count).double().mean()) for count in COUNTS}
    return Retrieval(recall, float(np.median(found.numpy(force=True))) + 1, candidates)


def t2m_m2t(
    table: Float[Tensor, "pairs pairs"], right: Bool[Tensor, "pairs pairs"] | None = None
) -> tuple[Retrieval, Retrieval]:
    """Text-to-motion and motion-to-text, from scores [text, motion] of pairs: the protocol "all".

    `right[i, j]` that text i is true of motion j, too: the protocol "threshold", e.g. of `similar_texts`.
    """
    back = None if right is None else right.T
    return summary(ranks(table, right), len(table)), summary(ranks(table.T, back), len(table))


def similar_texts(
    sentences: Float[Tensor, "pairs width"], threshold: float | int = 0.95
) -> Bool[Tensor, "pairs pairs"]:
    """Which texts say almost the same, by the scores of their sentence embeddings: those above `threshold`."""
    return (scores(cosines(sentences, sentences)) > threshold).fill_diagonal_(True)


def small_batches(
    table: Float[Tensor, "pairs pairs"], names: Sequence[str], size: int = 32
) -> tuple[Retrieval, Retrieval]:
    """The protocol "guo": pairs in the order of their `names`, shuffled by a fixed seed, are retrieved within batches
    of `size`; what is left over is dropped, the batches' numbers are averaged. Text-to-motion, then motion-to-text.

    Raises `ValueError` for less than one batch.
    """
    if len(names) < size:
        raise ValueError(f"{len(names)} pairs make no batch of {size}")
    order = np.argsort(np.array(names), kind="stable")
    np.random.RandomState(0).shuffle(order)
    batches = torch.from_numpy(order[: len(order) // size * size]).reshape(-1, size)
    results = [t2m_m2t(table[batch][:, batch]) for batch in batches]
    return _mean([first for first, _ in results]), _mean([second for _, second in results])


def _mean(results: Sequence[Retrieval]) -> Retrieval:
    recall = {count: float(np.mean([result.recall[count] for result in results])) for count in COUNTS}
    return Retrieval(recall, float(np.mean([result.median_rank for result in results])), results[0].candidates)
