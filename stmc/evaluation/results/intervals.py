"""Means over seeds with confidence intervals, over seeds alone or over timelines and seeds."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import ndtri, stdtrit

from stmc.evaluation.results.result_records import Result, ResultError

CONFIDENCE = 0.95


@dataclass(frozen=True)
class Estimate:
    """Mean of `count` values with the interval `mean` ± `half`; `half` is None for a single value.

    `bootstrapped` tells that the interval covers the chance of timelines as well as that of seeds; `half` is then None
    if there are too few timelines.
    """

    mean: float
    half: float | None
    count: int
    bootstrapped: bool = False

    @property
    def of_too_few(self) -> bool:
        """Whether there are too few timelines for an interval or a rank."""
        return self.bootstrapped and self.half is None


def estimate(values: Sequence[float | int]) -> Estimate:
    """Compute the mean and its 95 % interval by Student's t distribution: t(0.975, n - 1) s / √n, s² with n - 1.

    Raises `ValueError` for no values.
    """
    count = len(values)
    if not count:
        raise ValueError("the mean of no values is undefined")
    mean = math.fsum(values) / count
    if count == 1:
        return Estimate(mean, None, 1)
    deviation = math.sqrt(math.fsum((value - mean) ** 2 for value in values) / (count - 1))
    return Estimate(mean, float(stdtrit(count - 1, (1 + CONFIDENCE) / 2)) * deviation / math.sqrt(count), count)


def bootstrap(values: Sequence[float | int], resampled: Sequence[Sequence[float | int]]) -> Estimate:
    """Compute the mean over seeds and its 95 % interval by a bootstrap over timelines and seeds.

    The interval is 1.96 standard deviations of the mean over resampled seeds of the value on resampled timelines. Seeds
    and timelines are crossed (the pigeonhole bootstrap, Owen 2007). With n seeds, a bootstrap sees only (n - 1) / n of
    their variance. Without resamples, which too few timelines lack, there is no interval. Raises `ResultError` if the
    numbers of resamples differ.

    Args:
        values: Value of each seed.
        resampled: Values of each seed on the same resamples of the timelines.
    """
    if len({len(row) for row in resampled}) != 1:
        raise ResultError("records cannot be compared: they have different resamples of the timelines")
    if not resampled[0]:
        return Estimate(math.fsum(values) / len(values), None, len(values), bootstrapped=True)
    table = np.asarray(resampled, dtype=np.float64)
    seeds = np.random.default_rng(0).integers(len(table), size=(table.shape[1], len(table)))
    means = table[seeds, np.arange(table.shape[1])[:, None]].mean(axis=1)
    half = float(ndtri((1 + CONFIDENCE) / 2)) * float(means.std(ddof=1))
    return Estimate(math.fsum(values) / len(values), half, len(values), bootstrapped=True)


def estimates(results: Iterable[Result]) -> dict[str, Estimate]:
    """Estimate each metric that all runs of a setting have; by `bootstrap` if all runs have resamples of it."""
    runs = list(results)
    shared = [name for name in runs[0].metrics if all(name in run.metrics for run in runs)]
    return {name: _estimate_metric(name, runs) for name in shared}


def _estimate_metric(name: str, runs: Sequence[Result]) -> Estimate:
    values = [run.metrics[name] for run in runs]
    if all(name in run.resampled for run in runs):
        return bootstrap(values, [run.resampled[name] for run in runs])
    return estimate(values)
