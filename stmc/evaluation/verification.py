"""Judge by geometry whether a sampled motion shows its prompts.

The recogniser says which action a prompt asks for, and the action has a check. Depends on the checks and on the
recognition of prompts; independent of denoisers.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType

from stmc.evaluation.benchmarks.mtt_checks import MTT_CHECKS
from stmc.evaluation.benchmarks.questions import QUESTIONS, Question
from stmc.io.untrusted import quote
from stmc.model import Model
from stmc.motion.motion import Motion
from stmc.timeline import Timeline

SHORTEST = 1.0
"""Minimum duration in seconds of prompts that are judged."""

SURE = 0.3
"""Minimum probability of the action of prompts that are judged, chosen on one of two lists of MTT's paraphrases."""


@dataclass(frozen=True)
class Missed:
    """A prompt that a motion does not show from `start` to `end`, in seconds, by the check of its `action`."""

    text: str
    start: float | int
    end: float | int
    action: str

    @property
    def advice(self) -> str:
        """A line that says what is missing, and what to do."""
        return (
            f"{quote(self.text)} does not show from {self.start:g} to {self.end:g} s by the geometric test of "
            f"{self.action}; try another seed"
        )


def find_missed(model: Model, timeline: Timeline, motion: Motion) -> list[Missed]:
    """Return the prompts that a motion of the timeline does not show.

    A prompt of at least `SHORTEST` seconds is judged if the model knows it, if its action has a probability of at least
    `SURE`, and if the action has a check. Checks are strict: 4 % of recordings fail those of the fifty actions, and 9 %
    those of MTT's texts.

    Args:
        model: Model whose vocabulary has a classifier; otherwise no action has a probability, and no prompt is judged.
        timeline: Timeline of the motion.
        motion: Motion to judge.

    Examples:
        >>> model, timeline = stmc.load(), stmc.Timeline.parse("walk forwards # 0 # 2")
        >>> [motion] = model.generate("stand # 0 # 2", steps=5)
        >>> [each.action for each in stmc.evaluation.verification.find_missed(model, timeline, motion)]
        ['walk']
    """
    recognitions = {each.text: each for each in model.recognise([prompt.text for prompt in timeline.prompts])}
    missed = []
    for prompt in timeline.prompts:
        recognition = recognitions.get(prompt.text)
        if recognition is None or not recognition.known or recognition.confidence < SURE:
            continue
        if prompt.end - prompt.start < SHORTEST:
            continue
        shown = motion.trimmed(round(prompt.start * motion.fps), round(prompt.end * motion.fps))
        checks = CHECKS.get(recognition.action, ())
        if checks and not any(check(shown) for check in checks):
            missed.append(Missed(prompt.text, prompt.start, prompt.end, recognition.action))
    return missed


def _by_action() -> Mapping[str, Sequence[Question]]:
    checks: dict[str, list[Question]] = {}
    for check in MTT_CHECKS.values():
        for action in check.actions:
            checks.setdefault(action, []).append(check.shows)
    for action, question in QUESTIONS.items():
        checks.setdefault(action, [question])
    return MappingProxyType(checks)


CHECKS: Mapping[str, Sequence[Question]] = _by_action()
"""The checks of each action, of which one must pass: those of MTT's texts, or else its question."""
