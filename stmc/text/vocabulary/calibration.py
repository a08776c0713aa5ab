"""What was measured of a model after its training: how often its samples show which sentences and actions, and from
which score on a prompt counts as known.

Knows sentences and the names of actions; knows no motion, no model and no judge.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property

RARELY = 0.5
"""Share of the samples below which an action works rarely."""


@dataclass(frozen=True)
class Trial:
    """How often `samples` of a sentence that asks for an `action` show it: by `geometry`, and by an `evaluator` (shares
    from 0 to 1; None: not judged). `steps`, `guidance` (None: the model's is fixed) and `seed`, the first of
    consecutive ones, are those of the samples."""

    action: str
    samples: int
    geometry: float | int | None = None
    evaluator: float | int | None = None
    steps: int = 1
    guidance: float | int | None = None
    seed: int = 0

    @property
    def rate(self) -> float | int | None:
        """The share of the samples that show the action, by geometry where it can tell."""
        return self.evaluator if self.geometry is None else self.geometry


@dataclass(frozen=True)
class Calibration:
    """`trials` by their sentences, and thresholds of the recogniser: `threshold` (None: the vocabulary's own) and those
    of actions that have one of their own. `weights` is the SHA-256 of the model's weights, whose measurements these
    are; "" before they are written.

    Examples:
        >>> trials = {"walk forwards": Trial("walk", 8, geometry=1.0), "stroll": Trial("walk", 24, geometry=0.5)}
        >>> calibration = Calibration(trials)
        >>> calibration.rate("walk forwards", "walk"), calibration.rate("amble along", "walk")
        (1.0, 0.625)
    """

    trials: Mapping[str, Trial] = field(default_factory=dict)
    threshold: float | int | None = None
    thresholds: Mapping[str, float | int] = field(default_factory=dict)
    weights: str = ""

    @property
    def is_empty(self) -> bool:
        """Whether nothing was measured."""
        return not self.trials and self.threshold is None and not self.thresholds

    @cached_property
    def rates(self) -> Mapping[str, float]:
        """Of each action the share of all samples that show it, whichever sentence they were asked with; where some
        were judged by geometry, of those."""
        judged = [each for each in self.trials.values() if each.rate is not None]
        by_geometry = {each.action for each in judged if each.geometry is not None}
        samples: dict[str, int] = {}
        passed: dict[str, float] = {}
        for each in judged:
            if each.geometry is not None or each.action not in by_geometry:
                samples[each.action] = samples.get(each.action, 0) + each.samples
                passed[each.action] = passed.get(each.action, 0.0) + each.samples * each.rate
        return {action: passed[action] / samples[action] for action in samples}

    def rate(self, text: str, action: str) -> float | int | None:
        """How often a text's samples show it: its own trial's share, else its action's; None where nobody measured."""
        own = self._by_words.get(_words(text))
        return self.rates.get(action) if own is None or own.rate is None else own.rate

    def threshold_of(self, action: str, otherwise: float | int) -> float | int:
        """The action's own threshold, else the model's, else that of the vocabulary."""
        common = otherwise if self.threshold is None else self.threshold
        return self.thresholds.get(action, common)

    def with_trials(self, trials: Mapping[str, Trial]) -> Calibration:
        """The calibration with more trials; a sentence that is asked again replaces its old trial."""
        return replace(self, trials={**self.trials, **trials})

    @cached_property
    def _by_words(self) -> Mapping[str, Trial]:
        return {_words(text): trial for text, trial in self.trials.items()}


def _words(text: str) -> str:
    return " ".join(text.lower().split())
