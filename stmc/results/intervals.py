"""Means over seeds with their confidence intervals. Knows numbers alone."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from scipy.stats import t

from stmc.results.records import Result

CONFIDENCE = 0.95


@dataclass(frozen=True)
class Estimate:
    """A mean of `count` values; the interval is `mean` ± `half`, None where one value alone says nothing of chance."""

    mean: float
    half: float | None
    count: int


def estimate(values: Sequence[float | int]) -> Estimate:
    """The mean and its 95 % interval by Student's t distribution: t(0.975, n - 1) s / √n, s² with n - 1.

    Raises `ValueError` for no values.
    """
    count = len(values)
    if not count:
        raise ValueError("a mean of no values")
    mean = math.fsum(values) / count
    if count == 1:
        return Estimate(mean, None, 1)
    deviation = math.sqrt(math.fsum((value - mean) ** 2 for value in values) / (count - 1))
    return Estimate(mean, float(t.ppf((1 + CONFIDENCE) / 2, count - 1)) * deviation / math.sqrt(count), count)


def estimates(results: Iterable[Result]) -> dict[str, Estimate]:
    """Each metric that all runs of a setting have, over these runs."""
    runs = list(results)
    shared = [name for name in runs[0].metrics if all(name in run.metrics for run in runs)]
    return {name: estimate([run.metrics[name] for run in runs]) for name in shared}
