"""MTT's 500 timelines without AMASS: geometric checks say what is shown, an evaluator of your choice what is found.

Measures of the timelines as they are (STMC, section 4.1). Knows checks, timelines and an evaluator; knows no model.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property, partial
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from stmc.composing.sampling import INDEPENDENT
from stmc.data.cache import HELD_OUT, Cache, read_caches
from stmc.evaluation.benchmarks.atomic_prompts import LONGEST, read_texts
from stmc.evaluation.benchmarks.benchmark_protocol import Scores, TextEvaluator
from stmc.evaluation.benchmarks.crops import asked_of, crop_spans, jerk_rows
from stmc.evaluation.benchmarks.mtt_checks import MTT_CHECKS, same_meaning
from stmc.evaluation.benchmarks.published_timelines import sample_published_timelines
from stmc.evaluation.benchmarks.resampling import Rows, Units, resampled
from stmc.evaluation.metrics.retrieval import cosines, ranks, scores
from stmc.evaluation.metrics.smoothness import pose_steps, quarter_points
from stmc.evaluation.metrics.timeline_metrics import Span, measured_points
from stmc.motion.kinematics import foot_sliding, hand_step, local_joints
from stmc.motion.motion import Motion
from stmc.motion.representation import JointsFrom, SmplRepresentation
from stmc.timeline import Timeline, TimelineError

PER_TEXT = 4
"""Recorded motions of a text that a model's are compared with."""


@dataclass(frozen=True, eq=False)
class MttOpen:
    """A `Benchmark` of `asked` timelines of MTT's texts. `recorded` are motions that show a text, for those of the
    texts that some do: their passes are the ceiling and, of other texts, the chance; none: neither is known."""

    asked: Sequence[Timeline]
    evaluator: TextEvaluator
    recorded: Mapping[str, Sequence[Motion]] = field(default_factory=dict)
    joints_from: JointsFrom = "skeleton"

    def __post_init__(self) -> None:
        texts = [prompt.text for timeline in self.asked for prompt in timeline.prompts]
        if unknown := [text for text in texts if text not in MTT_CHECKS]:
            raise TimelineError(f"{unknown[0]!r} is none of MTT's {len(MTT_CHECKS)} texts")

    def timelines(self, method: str) -> list[Timeline]:
        """Those of the benchmark; for "independent" each of their prompts as a timeline."""
        return asked_of(method, self.asked)

    def measured(self, method: str, motions: Sequence[Motion], seed: int) -> Scores:
        """In percent the crops that show their text ("shown", and for each text "shown/TEXT") and the timelines whose
        crops all do ("timelines_shown"); R@1, R@3 and M2T of the crops among MTT's texts; transition distance, foot
        sliding and hand steps in centimetres, and the jerk around transitions.

        "independent" motions have no transitions and are no timelines, so only their crops are measured.
        """
        motions = [motion.resampled(self.evaluator.fps) for motion in motions]
        spans = crop_spans(method, self.asked, [len(motion) for motion in motions], self.evaluator.fps, _NUMBERS)
        counts = [len(timeline.prompts) if method == INDEPENDENT else 1 for timeline in self.asked]
        evidence = self._evidence(motions, spans, np.repeat(np.arange(len(self.asked)), counts).tolist())
        found = partial(self._metrics, evidence, whole=method != INDEPENDENT)
        metrics = found(np.arange(len(self.asked))) | self._by_text(evidence)
        if self.recorded:
            metrics["shown_chance"] = self._chance
        if method == INDEPENDENT:
            return Scores(metrics, resampled=resampled(len(self.asked), found))
        metrics["hand_step"] = 100 * max(map(hand_step, motions))
        scores = Scores(metrics, resampled=resampled(len(self.asked), found))
        jerks = evidence.jerks.values
        return scores.with_jerk(jerks, self._real_jerk(jerks)) if len(jerks) else scores

    def real(self, seed: int) -> Scores:
        """Of the recorded motions, each of which shows its text from beginning to end. Raises `TimelineError` where
        there are none."""
        rows = [(motion, text) for text, several in self.recorded.items() for motion in several]
        if not rows:
            raise TimelineError("no recordings of MTT's texts: name prepared data that show some (benchmark.cache=…)")
        motions = [motion.resampled(self.evaluator.fps) for motion, _ in rows]
        spans = [[(0, len(motion), _NUMBERS[text])] for motion, (_, text) in zip(motions, rows, strict=True)]
        evidence = self._evidence(motions, spans, list(range(len(rows))))
        metrics = self._metrics(evidence, np.arange(len(rows)), whole=True) | self._by_text(evidence)
        del metrics["timelines_shown"]
        metrics |= {"shown_chance": self._chance, "hand_step": 100 * max(map(hand_step, motions))}
        jerks = evidence.jerks.values
        return Scores(metrics).with_jerk(jerks, self._real_jerk(jerks)) if len(jerks) else Scores(metrics)

    def _evidence(self, motions: Sequence[Motion], spans: Sequence[Sequence[Span]], units: Sequence[int]) -> _Evidence:
        pairs = [(motion, *span) for motion, each in zip(motions, spans, strict=True) for span in each]
        numbers = torch.tensor([number for *_, number in pairs])
        texts = list(MTT_CHECKS)
        shown = [MTT_CHECKS[texts[number]].shows(motion.trimmed(start, end)) for motion, start, end, number in pairs]
        features = [self.evaluator.features(motion) for motion in motions]
        crops = [rows[start:end] for rows, each in zip(features, spans, strict=True) for start, end, _ in each]
        table = cosines(self.evaluator.motions(crops), self._latents)
        points = [measured_points(each, len(motion)) for each, motion in zip(spans, motions, strict=True)]
        steps = [
            pose_steps(local_joints(motion))[[at - 1 for at in chosen]]
            for motion, chosen in zip(motions, points, strict=True)
        ]
        counts = [len(each) for each in spans]
        answers = torch.tensor(shown).float()
        return _Evidence(
            shown=Rows.spread(answers, counts, units),
            numbers=numbers,
            whole=Rows(torch.stack([each.amin() for each in answers.split(counts)]), units),
            ranks=Rows.spread(ranks(table, _SYNONYMS[numbers]), counts, units),
            cosines=Rows.spread(table.gather(1, numbers[:, None])[:, 0], counts, units),
            steps=Rows.spread(torch.cat(steps), list(map(len, steps)), units),
            slides=Rows(torch.tensor([100 * foot_sliding(motion) for motion in motions]), units),
            hands=Rows(torch.tensor([100 * hand_step(motion) for motion in motions]), units),
            jerks=jerk_rows(motions, points, units, self.evaluator.fps),
        )

    def _metrics(self, evidence: _Evidence, units: Units, whole: bool) -> dict[str, float]:
        """What is found of some of the timelines."""
        found = evidence.ranks.of(units)
        metrics = {
            "shown": 100 * float(evidence.shown.of(units).mean()),
            "recall_1": 100 * float((found < 1).double().mean()),
            "recall_3": 100 * float((found < 3).double().mean()),
            "m2t": float(scores(evidence.cosines.of(units)).double().mean()),
        }
        if whole:
            metrics |= {
                "timelines_shown": 100 * float(evidence.whole.of(units).mean()),
                "transition": 100 * float(evidence.steps.of(units).mean()),
                "hand_step_99": float(np.quantile(evidence.hands.of(units).numpy(), 0.99)),
            }
            slides = float(evidence.slides.of(units).nanmean())
            metrics |= {} if math.isnan(slides) else {"sliding": slides}
        return metrics

    def _by_text(self, evidence: _Evidence) -> dict[str, float]:
        """The share of the crops of each text that show it."""
        shown = evidence.shown.values
        return {
            f"shown/{text}": 100 * float(shown[evidence.numbers == number].mean())
            for text, number in _NUMBERS.items()
            if bool((evidence.numbers == number).any())
        }

    @cached_property
    def _latents(self) -> Float[Tensor, "texts width"]:
        return self.evaluator.texts(list(MTT_CHECKS))

    @cached_property
    def _chance(self) -> float:
        """How often recorded motions of the other texts, each counting the same, pass the checks of the asked."""
        asked, chances = [prompt.text for timeline in self.asked for prompt in timeline.prompts], {}
        for text in set(asked):
            others = [motions for other, motions in self.recorded.items() if text not in same_meaning(other)]
            shares = [sum(map(MTT_CHECKS[text].shows, motions)) / len(motions) for motions in others]
            chances[text] = sum(shares) / max(1, len(shares))
        return 100 * sum(chances[text] for text in asked) / max(1, len(asked))

    def _real_jerk(self, otherwise: Float[Tensor, "windows frames"]) -> float:
        """The mean jerk of recorded motions at their quarters; without any, the mean of `otherwise`."""
        motions = [motion.resampled(self.evaluator.fps) for several in self.recorded.values() for motion in several]
        points = [quarter_points(len(motion)) for motion in motions]
        jerks = jerk_rows(motions, points, range(len(motions)), self.evaluator.fps).values
        return float((jerks if len(jerks) else otherwise).mean())


@dataclass(frozen=True, eq=False)
class _Evidence:
    """What was found, row by row, each of one of the timelines: of crops whether they show their text (0 or 1), its
    number, its rank and its cosine; of motions whether all is shown, centimetres of sliding and of the largest hand
    step; of transitions the step of the pose in metres and the jerk."""

    shown: Rows
    numbers: Tensor
    whole: Rows
    ranks: Rows
    cosines: Rows
    steps: Rows
    slides: Rows
    hands: Rows
    jerks: Rows


_NUMBERS = {text: number for number, text in enumerate(MTT_CHECKS)}


def _synonyms() -> Bool[Tensor, "texts texts"]:
    """Which texts mean the same: each is true of the other's motions."""
    meant = torch.tensor([[text in same_meaning(other) for other in MTT_CHECKS] for text in MTT_CHECKS])
    return meant & meant.T


_SYNONYMS = _synonyms()


def mtt_open(
    evaluator: TextEvaluator,
    texts: str | Path,
    cache: str | Path | Sequence[str | Path] | None = None,
    first: int | None = None,
) -> MttOpen:
    """MTT's 500 timelines from its 60 `texts`, the authors' texts.txt, by their own draw; `cache`: prepared data that
    show some of the texts; `first`: only so many of the timelines.

    Raises `TimelineError` for a text without a check, `CacheError` for a folder without prepared data.
    """
    asked = sample_published_timelines(read_texts(Path(texts).expanduser()))[:first]
    return MttOpen(asked, evaluator, {} if cache is None else recorded_motions(read_caches(cache)))


def recorded_motions(cache: Cache) -> dict[str, list[Motion]]:
    """Up to `PER_TEXT` motions of each text that a clip of `cache` shows, held-out ones and unmirrored ones first, cut
    to the length of the longest prompts."""
    representation, motions = SmplRepresentation(), {}
    for text, check in MTT_CHECKS.items():
        clips = [clip for clip in cache.clips if clip.content in check.actions and cache.texts[clip.texts]]
        clips.sort(key=lambda clip: (clip.split not in HELD_OUT, clip.mirrored, clip.name))
        rows = [cache.features[clip.start : min(clip.end, clip.start + int(LONGEST * cache.fps))] for clip in clips]
        if rows:
            motions[text] = [representation.decode(each, cache.fps, cache.skeleton) for each in rows[:PER_TEXT]]
    return motions
