"""MTT's 500 timelines without AMASS: geometric checks of what motions show, and retrieval with any evaluator.

Measures of the original timelines (STMC, section 4.1). Depends on checks, timelines and an evaluator; independent of
models.
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
from stmc.evaluation.benchmarks.crops import crop_spans, jerk_rows, requested_timelines
from stmc.evaluation.benchmarks.mtt_checks import MTT_CHECKS, same_meaning
from stmc.evaluation.benchmarks.published_timelines import sample_published_timelines
from stmc.evaluation.benchmarks.resampling import Rows, Units, draw_metrics
from stmc.evaluation.metrics.retrieval import cosines, ranks, scores
from stmc.evaluation.metrics.smoothness import pose_steps, quarter_points
from stmc.evaluation.metrics.timeline_metrics import Span, measured_points
from stmc.motion.kinematics import foot_sliding, hand_step, local_joints
from stmc.motion.motion import Motion
from stmc.motion.representation import JointsFrom, SmplRepresentation
from stmc.settings.records import SettingError
from stmc.timeline import Timeline, TimelineError

PER_TEXT = 4
"""Maximum number of recorded motions of a text."""


@dataclass(frozen=True, eq=False)
class MttOpen:
    """A `Benchmark` of timelines of MTT's texts.

    Args:
        requested: The timelines.
        evaluator: Evaluator of texts and motions.
        recorded: Recorded motions of some of the texts. Their pass rates are the ceiling and, for other texts, the
            chance; without them neither is reported.
        joints_from: Source of the measured joints; see `Model.decode`.
        judge: Second evaluator, whose retrieval is reported beside that of the first ("judge_recall_1", …).

    Raises:
        TimelineError: If a text is not one of MTT's.
        SettingError: If the judge expects another frame rate.
    """

    requested: Sequence[Timeline]
    evaluator: TextEvaluator
    recorded: Mapping[str, Sequence[Motion]] = field(default_factory=dict)
    joints_from: JointsFrom = "skeleton"
    judge: TextEvaluator | None = None

    def __post_init__(self) -> None:
        if self.judge is not None and self.judge.fps != self.evaluator.fps:
            raise SettingError(f"judge: works at {self.judge.fps:g} fps, but the evaluator at {self.evaluator.fps:g}")
        texts = [prompt.text for timeline in self.requested for prompt in timeline.prompts]
        if unknown := [text for text in texts if text not in MTT_CHECKS]:
            raise TimelineError(f"{unknown[0]!r} is not one of MTT's {len(MTT_CHECKS)} texts")

    def timelines(self, method: str) -> list[Timeline]:
        """Return the timelines of the benchmark; for "independent", one timeline per prompt."""
        return requested_timelines(method, self.requested)

    def measured(self, method: str, motions: Sequence[Motion], seed: int) -> Scores:
        """Compute the scores of motions.

        They are the percentages of crops that show their text ("shown", and "shown/TEXT" for each text) and of
        timelines whose crops all do ("timelines_shown"); R@1, R@3 and M2T of the crops among MTT's texts, also by the
        judge; transition distance, foot sliding and hand steps in centimetres, and the jerk around transitions.
        "independent" motions have no transitions and are no timelines, so that only their crops are measured.

        Args:
            method: Name of the method.
            motions: One motion for each of `timelines(method)`.
            seed: Ignored.
        """
        motions = [motion.resampled(self.evaluator.fps) for motion in motions]
        spans = crop_spans(method, self.requested, [len(motion) for motion in motions], self.evaluator.fps, _NUMBERS)
        counts = [len(timeline.prompts) if method == INDEPENDENT else 1 for timeline in self.requested]
        evidence = self._evidence(motions, spans, np.repeat(np.arange(len(self.requested)), counts).tolist())
        compute = partial(self._metrics, evidence, whole=method != INDEPENDENT)
        metrics = compute(np.arange(len(self.requested))) | self._by_text(evidence)
        if self.recorded:
            metrics["shown_chance"] = self._chance
        if method == INDEPENDENT:
            return Scores(metrics, resampled=draw_metrics(len(self.requested), compute))
        metrics["hand_step"] = 100 * max(map(hand_step, motions))
        scores = Scores(metrics, resampled=draw_metrics(len(self.requested), compute))
        jerks = evidence.jerks.values
        return scores.with_jerk(jerks, self._real_jerk(jerks)) if len(jerks) else scores

    def real(self, seed: int) -> Scores:
        """Compute the scores of the recorded motions, which show their texts from beginning to end.

        Raises `TimelineError` if there are none.
        """
        rows = [(motion, text) for text, samples in self.recorded.items() for motion in samples]
        if not rows:
            raise TimelineError("no recordings of MTT's texts; set benchmark.cache to prepared data that show some")
        motions = [motion.resampled(self.evaluator.fps) for motion, _ in rows]
        spans = [[(0, len(motion), _NUMBERS[text])] for motion, (_, text) in zip(motions, rows, strict=True)]
        evidence = self._evidence(motions, spans, list(range(len(rows))))
        metrics = self._metrics(evidence, np.arange(len(rows)), whole=True) | self._by_text(evidence)
        del metrics["timelines_shown"]
        metrics |= {"shown_chance": self._chance, "hand_step": 100 * max(map(hand_step, motions))}
        jerks = evidence.jerks.values
        return Scores(metrics).with_jerk(jerks, self._real_jerk(jerks)) if len(jerks) else Scores(metrics)

    def _evidence(self, motions: Sequence[Motion], spans: Sequence[Sequence[Span]], units: Sequence[int]) -> _Evidence:
        pairs = [(motion, *span) for motion, prompts in zip(motions, spans, strict=True) for span in prompts]
        numbers = torch.tensor([number for *_, number in pairs])
        texts = list(MTT_CHECKS)
        shown = [MTT_CHECKS[texts[number]].shows(motion.trimmed(start, end)) for motion, start, end, number in pairs]
        retrieval = {prefix: self._retrieve(prefix, motions, spans) for prefix in self._evaluators}
        points = [measured_points(prompts, len(motion)) for prompts, motion in zip(spans, motions, strict=True)]
        steps = [
            pose_steps(local_joints(motion))[[point - 1 for point in frames]]
            for motion, frames in zip(motions, points, strict=True)
        ]
        counts = [len(prompts) for prompts in spans]
        answers = torch.tensor(shown).float()
        return _Evidence(
            shown=Rows.spread(answers, counts, units),
            numbers=numbers,
            whole=Rows(torch.stack([crops.amin() for crops in answers.split(counts)]), units),
            ranks={
                prefix: Rows.spread(ranks(table, _SYNONYMS[numbers]), counts, units)
                for prefix, table in retrieval.items()
            },
            cosines={
                prefix: Rows.spread(table.gather(1, numbers[:, None])[:, 0], counts, units)
                for prefix, table in retrieval.items()
            },
            steps=Rows.spread(torch.cat(steps), list(map(len, steps)), units),
            slides=Rows(torch.tensor([100 * foot_sliding(motion) for motion in motions]), units),
            hands=Rows(torch.tensor([100 * hand_step(motion) for motion in motions]), units),
            jerks=jerk_rows(motions, points, units, self.evaluator.fps),
        )

    def _metrics(self, evidence: _Evidence, units: Units, whole: bool) -> dict[str, float]:
        """Compute the metrics of some of the timelines."""
        metrics = {"shown": 100 * float(evidence.shown.of(units).mean())}
        for prefix in self._evaluators:
            positions, similarities = evidence.ranks[prefix].of(units), evidence.cosines[prefix].of(units)
            metrics |= {
                f"{prefix}recall_1": 100 * float((positions < 1).double().mean()),
                f"{prefix}recall_3": 100 * float((positions < 3).double().mean()),
                f"{prefix}m2t": float(scores(similarities).double().mean()),
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
        """Compute the percentage of the crops of each text that show it."""
        shown = evidence.shown.values
        return {
            f"shown/{text}": 100 * float(shown[evidence.numbers == number].mean())
            for text, number in _NUMBERS.items()
            if bool((evidence.numbers == number).any())
        }

    def _retrieve(
        self, prefix: str, motions: Sequence[Motion], spans: Sequence[Sequence[Span]]
    ) -> Float[Tensor, "crops texts"]:
        """Compute the cosines between all crops and MTT's texts by one of the evaluators."""
        evaluator = self._evaluators[prefix]
        features = [evaluator.features(motion) for motion in motions]
        crops = [rows[start:end] for rows, prompts in zip(features, spans, strict=True) for start, end, _ in prompts]
        return cosines(evaluator.motions(crops), self._latents[prefix])

    @cached_property
    def _evaluators(self) -> dict[str, TextEvaluator]:
        """The evaluators by the prefix of their metrics."""
        return {"": self.evaluator} | ({"judge_": self.judge} if self.judge is not None else {})

    @cached_property
    def _latents(self) -> dict[str, Float[Tensor, "texts width"]]:
        return {prefix: evaluator.texts(list(MTT_CHECKS)) for prefix, evaluator in self._evaluators.items()}

    @cached_property
    def _chance(self) -> float:
        """The pass rate of recorded motions of other texts, averaged over texts."""
        requested, chances = [prompt.text for timeline in self.requested for prompt in timeline.prompts], {}
        for text in set(requested):
            others = [motions for other, motions in self.recorded.items() if text not in same_meaning(other)]
            rates = [sum(map(MTT_CHECKS[text].shows, motions)) / len(motions) for motions in others]
            chances[text] = sum(rates) / max(1, len(rates))
        return 100 * sum(chances[text] for text in requested) / max(1, len(requested))

    def _real_jerk(self, otherwise: Float[Tensor, "windows frames"]) -> float:
        """Return the mean jerk of recorded motions at their quarters or, without any, the mean of `otherwise`."""
        motions = [motion.resampled(self.evaluator.fps) for samples in self.recorded.values() for motion in samples]
        points = [quarter_points(len(motion)) for motion in motions]
        jerks = jerk_rows(motions, points, range(len(motions)), self.evaluator.fps).values
        return float((jerks if len(jerks) else otherwise).mean())


@dataclass(frozen=True, eq=False)
class _Evidence:
    """Measurements row by row, each of one timeline.

    For crops: whether they show their text (0 or 1), the index of the text, and its rank and cosine by each evaluator.
    For motions: whether all crops show their texts, foot sliding and the largest hand step in centimetres. For
    transitions: the step of the pose in metres, and the jerk.
    """

    shown: Rows
    numbers: Tensor
    whole: Rows
    ranks: Mapping[str, Rows]
    cosines: Mapping[str, Rows]
    steps: Rows
    slides: Rows
    hands: Rows
    jerks: Rows


_NUMBERS = {text: number for number, text in enumerate(MTT_CHECKS)}


def _synonyms() -> Bool[Tensor, "texts texts"]:
    """Return which texts mean the same, that is, describe each other's motions."""
    meant = torch.tensor([[text in same_meaning(other) for other in MTT_CHECKS] for text in MTT_CHECKS])
    return meant & meant.T


_SYNONYMS = _synonyms()


def mtt_open(
    evaluator: TextEvaluator,
    texts: str | Path,
    cache: str | Path | Sequence[str | Path] | None = None,
    first: int | None = None,
    judge: TextEvaluator | None = None,
) -> MttOpen:
    """Build the benchmark of MTT's 500 timelines from its 60 texts, by the authors' own draw.

    Args:
        evaluator: Evaluator of texts and motions.
        texts: The authors' texts.txt.
        cache: Folders of prepared data that show some of the texts.
        first: Number of timelines; None uses all.
        judge: Second evaluator; None uses the first alone.

    Raises:
        TimelineError: If a text has no check.
        CacheError: If a folder holds no prepared data.
    """
    requested = sample_published_timelines(read_texts(Path(texts).expanduser()))[:first]
    recorded = {} if cache is None else recorded_motions(read_caches(cache))
    return MttOpen(requested, evaluator, recorded, judge=judge)


def recorded_motions(cache: Cache) -> dict[str, list[Motion]]:
    """Decode up to `PER_TEXT` motions of each text that a clip of `cache` shows.

    Held-out clips come first, then unmirrored ones. Motions are cut to the length of the longest prompts.
    """
    representation, motions = SmplRepresentation(), {}
    for text, check in MTT_CHECKS.items():
        clips = [clip for clip in cache.clips if clip.content in check.actions and cache.texts[clip.texts]]
        clips.sort(key=lambda clip: (clip.split not in HELD_OUT, clip.mirrored, clip.name))
        rows = [cache.features[clip.start : min(clip.end, clip.start + int(LONGEST * cache.fps))] for clip in clips]
        if rows:
            motions[text] = [representation.decode(features, cache.fps, cache.skeleton) for features in rows[:PER_TEXT]]
    return motions
