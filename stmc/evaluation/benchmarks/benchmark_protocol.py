"""What every benchmark offers, whatever it measures: timelines to make motions of, and what to make of the motions."""

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
    """What was measured: numbers by the keys of `results.naming.MEASURES`, curves over frames by their names, and of
    some numbers what they are on draws of the timelines (see `resampling`)."""

    metrics: dict[str, float]
    curves: Mapping[str, list[float]] = MappingProxyType({})
    resampled: Mapping[str, list[float]] = MappingProxyType({})

    def with_jerk(self, jerks: Float[Tensor, "windows frames"], average: float | int) -> Scores:
        """These, and of the jerk in windows around transitions, in m/frame³, the peak, the area between it and the
        `average` of real motion, and the curve "jerk"."""
        curve = jerk_curve(jerks)
        jerky = {"peak_jerk": peak_jerk(curve), "area_under_jerk": area_under_jerk(curve, average)}
        return Scores({**self.metrics, **jerky}, {**self.curves, "jerk": curve.tolist()}, self.resampled)


@runtime_checkable
class TextEvaluator(MotionEvaluator, Protocol):
    """An evaluator of texts, too, as `evaluators.Evaluator` is: their latents are near those of the motions they tell
    of."""

    def texts(self, texts: Sequence[str]) -> Float[Tensor, "batch width"]: ...


@runtime_checkable
class Benchmark(Protocol):
    """Knows what is asked for, and how good what comes is; knows no model."""

    @property
    def joints_from(self) -> JointsFrom:
        """Which joints of the features that a model makes are measured (see `Model.decode`)."""
        ...

    def timelines(self, method: str) -> list[Timeline]:
        """What a method (a name of `composing.METHODS`) is to make motions of, in order: always the same."""
        ...

    def measured(self, method: str, motions: Sequence[Motion], seed: int) -> Scores:
        """The scores of motions, one for each of `timelines(method)`; what is random in measuring follows `seed`."""
        ...

    def real(self, seed: int) -> Scores:
        """The same of real motion."""
        ...
