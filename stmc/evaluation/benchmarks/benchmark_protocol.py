"""The interface of every benchmark: timelines to generate motions for, and scores of the motions."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import NamedTuple, Protocol, runtime_checkable

from jaxtyping import Float
from torch import Tensor

from stmc.evaluation.metrics.smoothness import area_under_jerk, jerk_curve, peak_jerk
from stmc.evaluation.metrics.timeline_metrics import MotionEvaluator
from stmc.motion.motion import Motion
from stmc.motion.representation import JointsFrom
from stmc.timeline import Timeline


class Scores(NamedTuple):
    """The results of a measurement.

    Args:
        metrics: Values by the keys of `results.naming.MEASURES`.
        curves: Curves over frames by name.
        resampled: Values of some metrics on draws of the timelines; see `resampling`.
    """

    metrics: dict[str, float]
    curves: Mapping[str, list[float]] = MappingProxyType({})
    resampled: Mapping[str, list[float]] = MappingProxyType({})

    def with_jerk(self, jerks: Float[Tensor, "windows frames"], average: float | int) -> Scores:
        """Add the jerk of windows around transitions: its peak, its area above the average, and the curve "jerk".

        `jerks` and `average`, the jerk of real motion, are in m/frame³.
        """
        curve = jerk_curve(jerks)
        jerk_metrics = {"peak_jerk": peak_jerk(curve), "area_under_jerk": area_under_jerk(curve, average)}
        return Scores({**self.metrics, **jerk_metrics}, {**self.curves, "jerk": curve.tolist()}, self.resampled)


@runtime_checkable
class TextEvaluator(MotionEvaluator, Protocol):
    """An evaluator that also embeds texts, close to the motions that they describe, as `evaluators.Evaluator` does."""

    def texts(self, texts: Sequence[str]) -> Float[Tensor, "batch width"]: ...


@runtime_checkable
class Benchmark(Protocol):
    """Requests to a method and scores of the results; independent of models."""

    @property
    def joints_from(self) -> JointsFrom:
        """Source of the measured joints; see `Model.decode`."""
        ...

    def timelines(self, method: str) -> list[Timeline]:
        """Return the timelines for a method (a name in `composing.METHODS`), always the same and in the same order."""
        ...

    def measured(self, method: str, motions: Sequence[Motion], seed: int) -> Scores:
        """Compute the scores of motions.

        Args:
            method: Name of the method.
            motions: One motion for each of `timelines(method)`.
            seed: Seed of random choices in the measurement.
        """
        ...

    def real(self, seed: int) -> Scores:
        """Compute the scores of real motion."""
        ...
