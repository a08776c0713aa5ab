"""Means over seeds with their confidence intervals: by the chance of seeds alone, or of what was asked for, too. Knows
numbers alone."""

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
    """A mean of `count` values; the interval is `mean` ± `half`, None where one value alone says nothing of chance.
    `bootstrapped`: of the chance of the timelines, too, else of the seeds' alone; without `half`, of too few timelines
    to say anything of it."""

    mean: float
    half: float | None
    count: int
    bootstrapped: bool = False

    @property
    def of_too_few(self) -> bool:
        """Whether so few timelines were asked for that neither an interval nor a rank means anything."""
        return self.bootstrapped and self.half is None


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
    return Estimate(mean, float(stdtrit(count - 1, (1 + CONFIDENCE) / 2)) * deviation / math.sqrt(count), count)


def bootstrap(values: Sequence[float | int], resampled: Sequence[Sequence[float | int]]) -> Estimate:
    """The mean of each seed's value, and its 95 % interval when timelines and seeds are both drawn anew with
    replacement: 1.96 standard deviations of the mean over drawn seeds of the value on drawn timelines.

    `resampled` has each seed's values on the same draws of timelines, so that timelines and seeds are crossed, as they
    are in a benchmark (Owen 2007, the pigeonhole bootstrap). Few seeds tell little of seeds: of n of them a bootstrap
    sees (n - 1) / n of the variance. Without draws (of too few timelines) there is no interval. Raises `ResultError`
    for draws of different numbers.
    """
    if len({len(row) for row in resampled}) != 1:
        raise ResultError("records are resampled by different draws of the timelines: they do not compare")
    if not resampled[0]:
        return Estimate(math.fsum(values) / len(values), None, len(values), bootstrapped=True)
    table = np.asarray(resampled, dtype=np.float64)
    seeds = np.random.default_rng(0).integers(len(table), size=(table.shape[1], len(table)))
    means = table[seeds, np.arange(table.shape[1])[:, None]].mean(axis=1)
    half = float(ndtri((1 + CONFIDENCE) / 2)) * float(means.std(ddof=1))
    return Estimate(math.fsum(values) / len(values), half, len(values), bootstrapped=True)


def estimates(results: Iterable[Result]) -> dict[str, Estimate]:
    """Each metric that all runs of a setting have, over these runs; by `bootstrap` where all have draws of it."""
    runs = list(results)
    shared = [name for name in runs[0].metrics if all(name in run.metrics for run in runs)]
    return {name: _estimated(name, runs) for name in shared}


def _estimated(name: str, runs: Sequence[Result]) -> Estimate:
    values = [run.metrics[name] for run in runs]
    if all(name in run.resampled for run in runs):
        return bootstrap(values, [run.resampled[name] for run in runs])
    return estimate(values)
