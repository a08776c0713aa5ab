"""Measurements of a trained model: success rates of sentences and actions, and score thresholds of the recogniser.

Depends on sentences and names of actions; independent of motions, models and evaluators.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property

RARELY = 0.5
"""Success rate below which an action rarely works."""

MANY, SHOWN_RATE = 8, 0.75
"""Number of samples that prove that a model shows a text, and the fraction of them that must show it: 6 of 8."""


@dataclass(frozen=True)
class Trial:
    """The success rate of a sentence: the fraction of its `samples` that show its `action`.

    Rates, from 0 to 1, are judged by `geometry` and by an `evaluator` (None: not judged). `steps`, `guidance` (None:
    the model's is fixed) and `seed`, the first of consecutive seeds, are those of the samples.
    """

    action: str
    samples: int
    geometry: float | int | None = None
    evaluator: float | int | None = None
    steps: int = 1
    guidance: float | int | None = None
    seed: int = 0

    @property
    def rate(self) -> float | int | None:
        """The fraction of the samples that show the action: judged by geometry if possible, else by the evaluator."""
        return self.evaluator if self.geometry is None else self.geometry

    @property
    def proven(self) -> bool:
        """Whether there are `MANY` samples, and at least `SHOWN_RATE` of them show the action."""
        return self.samples >= MANY and self.rate is not None and self.rate >= SHOWN_RATE


@dataclass(frozen=True)
class Calibration:
    """Measurements of a model: `trials` by sentence, and thresholds of the recogniser.

    `threshold` applies to all actions (None: the vocabulary's default); `thresholds` override it for single actions.
    `weights` is the SHA-256 of the measured model's weights; "" before they are written.

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
        """The success rate of each action over the samples of all its sentences.

        If geometry judged any of them, only those count.
        """
        judged = [(trial, trial.rate) for trial in self.trials.values() if trial.rate is not None]
        by_geometry = {trial.action for trial, _ in judged if trial.geometry is not None}
        samples: dict[str, int] = {}
        passed: dict[str, float] = {}
        for trial, rate in judged:
            if trial.geometry is not None or trial.action not in by_geometry:
                samples[trial.action] = samples.get(trial.action, 0) + trial.samples
                passed[trial.action] = passed.get(trial.action, 0.0) + trial.samples * rate
        return {action: passed[action] / samples[action] for action in samples}

    def trial(self, text: str) -> Trial | None:
        """Return the judged trial of the text itself, in any case and spacing, if there is one."""
        trial = self._by_words.get(_words(text))
        return None if trial is None or trial.rate is None else trial

    def rate(self, text: str, action: str) -> float | int | None:
        """Return the success rate of a text, or else that of its action; None if neither was measured."""
        trial = self.trial(text)
        return self.rates.get(action) if trial is None else trial.rate

    def threshold_of(self, action: str, otherwise: float | int) -> float | int:
        """Return the threshold of an action, or else that of the model, or else `otherwise`."""
        common = otherwise if self.threshold is None else self.threshold
        return self.thresholds.get(action, common)

    def with_trials(self, trials: Mapping[str, Trial]) -> Calibration:
        """Add trials; a new trial of a sentence replaces one that has no more samples."""
        better = {text: each for text, each in trials.items() if each.samples >= self._samples(text)}
        return replace(self, trials={**self.trials, **better})

    def _samples(self, text: str) -> int:
        return self.trials[text].samples if text in self.trials else 0

    @cached_property
    def _by_words(self) -> Mapping[str, Trial]:
        return {_words(text): trial for text, trial in self.trials.items()}


def _words(text: str) -> str:
    return " ".join(text.lower().split())
