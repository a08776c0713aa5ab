"""The bootstrap over the requests of a benchmark (Efron 1979): the variation of its numbers with other timelines.

All records use the same draws of timelines, whatever the method and seed, so that several records can be averaged draw
by draw, and compared. Depends on rows and the units (timelines, compositions) that they belong to; independent of
metrics.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Float, Int, Shaped
from torch import Tensor

from stmc.evaluation.metrics.timeline_metrics import MotionEvaluator
from stmc.motion.motion import Motion

DRAWS = 200
"""Number of draws; the standard error is then accurate within 5 %."""
FEWEST = 5
"""Minimum number of units for a bootstrap: draws of one or two units hardly differ."""
Units = Int[np.ndarray, " units"]
Measured = Callable[[Units], Mapping[str, float]]


def draw_metrics(count: int, measured: Measured) -> dict[str, list[float]]:
    """Measure `DRAWS` draws of `count` units with replacement: values of each metric, with six digits.

    Metrics that some draw lacks are omitted. With fewer than `FEWEST` units the lists are empty.
    """
    if count < FEWEST:
        return {name: [] for name in measured(np.arange(count))}
    draws = np.random.default_rng(0).integers(count, size=(DRAWS, count))
    results = [measured(units) for units in draws]
    shared = [name for name in results[0] if all(name in metrics for metrics in results)]
    return {name: [float(f"{metrics[name]:.6g}") for metrics in results] for name in shared}


@dataclass(frozen=True, eq=False)
class Rows:
    """Values, one per row, and the index of the unit that each row belongs to."""

    values: Shaped[Tensor, "rows ..."]
    owners: Sequence[int]

    @classmethod
    def spread(cls, values: Shaped[Tensor, "rows ..."], counts: Sequence[int], units: Sequence[int]) -> Rows:
        """Assign rows to units by way of motions.

        Args:
            values: Rows of all motions, in order.
            counts: Number of rows of each motion.
            units: Index of the unit of each motion.
        """
        return cls(values, np.repeat(units, counts).tolist())

    def of(self, units: Units) -> Shaped[Tensor, "chosen ..."]:
        """Return the rows of units; rows of repeated units repeat."""
        return self.values[self.numbers(units)]

    def numbers(self, units: Units) -> Int[Tensor, " chosen"]:
        """Return the indices of the rows of units."""
        empty = np.zeros(0, dtype=int)
        return torch.from_numpy(np.concatenate([empty, *(self._indices.get(int(unit), empty) for unit in units)]))

    @cached_property
    def _indices(self) -> dict[int, np.ndarray]:
        owners = np.asarray(self.owners, dtype=int)
        return {unit: np.flatnonzero(owners == unit) for unit in set(self.owners)}


@dataclass(frozen=True, eq=False)
class Remembering:
    """An evaluator that records the latents it computes in `latents`, one tensor per call."""

    evaluator: MotionEvaluator
    latents: list[Tensor] = field(default_factory=list)

    @property
    def fps(self) -> float | int:
        """Frame rate of the features."""
        return self.evaluator.fps

    def features(self, motion: Motion) -> Float[Tensor, "_ features"]:
        """Compute the evaluator's features."""
        return self.evaluator.features(motion)

    def motions(self, features: Sequence[Float[Tensor, "_ features"]]) -> Float[Tensor, "batch width"]:
        """Compute the evaluator's latents, and record them."""
        self.latents.append(self.evaluator.motions(features))
        return self.latents[-1]
