"""The bootstrap over what a benchmark asks for (Efron 1979): how far its numbers would move with other timelines.

Every record has the numbers of the same draws of timelines, whatever its method and seed: so what several records say
can be averaged draw by draw, and compared. Knows rows and to which of the units (timelines, compositions) each belongs;
knows no metric.
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
"""Enough for a standard error that is right within 5 %."""

FEWEST = 5
"""Units that a bootstrap needs: draws of one or two of them are hardly ever other ones, and spread by nothing."""

Units = Int[np.ndarray, " units"]
Measured = Callable[[Units], Mapping[str, float]]


def resampled(count: int, measured: Measured) -> dict[str, list[float]]:
    """What is measured on `DRAWS` draws of `count` units with replacement, metric by metric, in six digits; without
    those that some draw has nothing to tell of. Of fewer units than `FEWEST` there are no draws of any metric."""
    if count < FEWEST:
        return {name: [] for name in measured(np.arange(count))}
    draws = np.random.default_rng(0).integers(count, size=(DRAWS, count))
    found = [measured(units) for units in draws]
    shared = [name for name in found[0] if all(name in each for each in found)]
    return {name: [float(f"{each[name]:.6g}") for each in found] for name in shared}


@dataclass(frozen=True, eq=False)
class Rows:
    """Values, a row each, and the number of the unit that each belongs to."""

    values: Shaped[Tensor, "rows ..."]
    owners: Sequence[int]

    @classmethod
    def spread(cls, values: Shaped[Tensor, "rows ..."], counts: Sequence[int], units: Sequence[int]) -> Rows:
        """Of motions in order, so many rows each, when each motion belongs to one of the `units`."""
        return cls(values, np.repeat(units, counts).tolist())

    def of(self, units: Units) -> Shaped[Tensor, "chosen ..."]:
        """The rows of these units, of those that come twice twice."""
        return self.values[self.numbers(units)]

    def numbers(self, units: Units) -> Int[Tensor, " chosen"]:
        """Which rows these are."""
        none = np.zeros(0, dtype=int)
        return torch.from_numpy(np.concatenate([none, *(self._places.get(int(unit), none) for unit in units)]))

    @cached_property
    def _places(self) -> dict[int, np.ndarray]:
        owners = np.asarray(self.owners, dtype=int)
        return {unit: np.flatnonzero(owners == unit) for unit in set(self.owners)}


@dataclass(frozen=True, eq=False)
class Remembering:
    """An evaluator that keeps the latents that it was asked for, in `latents`, a tensor for each time."""

    evaluator: MotionEvaluator
    latents: list[Tensor] = field(default_factory=list)

    @property
    def fps(self) -> float | int:
        """Of the features."""
        return self.evaluator.fps

    def features(self, motion: Motion) -> Float[Tensor, "_ features"]:
        """The evaluator's."""
        return self.evaluator.features(motion)

    def motions(self, features: Sequence[Float[Tensor, "_ features"]]) -> Float[Tensor, "batch width"]:
        """The evaluator's, which are kept."""
        self.latents.append(self.evaluator.motions(features))
        return self.latents[-1]
