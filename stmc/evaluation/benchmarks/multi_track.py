"""The benchmark of timelines with several tracks (STMC, section 4): atomic prompts, timelines of them, real motions.

Defines the frames of a motion that should show each text; `metrics.timeline_metrics` measures them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property, partial
from importlib.resources import files
from pathlib import Path
from types import MappingProxyType

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from stmc.composing.sampling import INDEPENDENT
from stmc.data.cache import CacheError, Clip, read_caches
from stmc.data.sources.contents import CONTENTS
from stmc.evaluation.benchmarks.atomic_prompts import LONGEST, AtomicPrompt, read_atomic_prompts
from stmc.evaluation.benchmarks.benchmark_protocol import Scores, TextEvaluator
from stmc.evaluation.benchmarks.crops import crop_spans, jerk_rows, requested_timelines
from stmc.evaluation.benchmarks.ground_truth import ReferenceMotions, amass_reference_motions, cache_reference_motions
from stmc.evaluation.benchmarks.questions import QUESTIONS, Question
from stmc.evaluation.benchmarks.resampling import Remembering, Rows, Units, draw_metrics
from stmc.evaluation.metrics.realism import fid
from stmc.evaluation.metrics.smoothness import pose_steps, quarter_points
from stmc.evaluation.metrics.timeline_metrics import (
    DEFINED,
    PUBLISHED,
    Formulas,
    GroundTruth,
    Span,
    measured_points,
    semantics,
)
from stmc.motion.kinematics import hand_step, local_joints
from stmc.motion.motion import Motion
from stmc.motion.representation import JointsFrom, SmplRepresentation
from stmc.settings.records import SettingError, quote
from stmc.timeline import Timeline, TimelineError

PER_TEXT = 12
"""Number of real clips of each text for FID in the open benchmark."""


@dataclass(frozen=True, eq=False)
class MultiTrack:
    """A `Benchmark` of timelines whose texts are those of atomic prompts.

    Args:
        requested: The timelines.
        atomic_prompts: The atomic prompts.
        evaluator: Evaluator of texts and motions.
        truth: Latents of the atomic prompts, in their order.
        reference_motions: Motions that show the atomic prompts, at the evaluator's frame rate.
        formulas: Formulas of the metrics: those of the paper's definitions, or the published ones to compare with the
            paper's tables.
        joints_from: Source of the measured joints; see `Model.decode`.
        questions: Geometric questions for some of the texts, without a learned evaluator.

    Raises:
        TimelineError: If a text of a timeline is not an atomic prompt.
    """

    requested: Sequence[Timeline]
    atomic_prompts: Sequence[AtomicPrompt]
    evaluator: TextEvaluator
    truth: GroundTruth
    reference_motions: Sequence[Motion]
    formulas: Formulas = DEFINED
    joints_from: JointsFrom = "skeleton"
    questions: Mapping[str, Question] = field(default_factory=dict)

    def __post_init__(self) -> None:
        texts = {prompt.text for prompt in self.atomic_prompts}
        for timeline in self.requested:
            for prompt in timeline.prompts:
                if prompt.text not in texts:
                    raise TimelineError(
                        f"timeline {timeline.name}: {prompt.text!r} is not one of the {len(texts)} texts"
                    )

    @classmethod
    def of(
        cls,
        requested: Sequence[Timeline],
        atomic_prompts: Sequence[AtomicPrompt],
        evaluator: TextEvaluator,
        reference_motions: ReferenceMotions,
        others: Sequence[Motion] = (),
        formulas: Formulas = DEFINED,
        joints_from: JointsFrom = "skeleton",
        questions: Mapping[str, Question] = MappingProxyType({}),
    ) -> MultiTrack:
        """Build the benchmark, and compute the latents.

        Args:
            requested: The timelines.
            atomic_prompts: The atomic prompts.
            evaluator: Evaluator of texts and motions.
            reference_motions: Looks up the motions of the atomic prompts.
            others: Real motions for FID; none uses those of the atomic prompts, as published.
            formulas: Formulas of the metrics.
            joints_from: Source of the measured joints.
            questions: Geometric questions for some of the texts.
        """
        motions = [
            reference_motions(prompt.clip, prompt.start, prompt.end).resampled(evaluator.fps)
            for prompt in atomic_prompts
        ]
        latents = evaluator.motions([evaluator.features(motion) for motion in [*motions, *others]])
        truth = GroundTruth(
            texts=evaluator.texts([prompt.text for prompt in atomic_prompts]),
            motions=latents[: len(atomic_prompts)],
            others=latents[len(atomic_prompts) :] if others else None,
        )
        return cls(requested, atomic_prompts, evaluator, truth, motions, formulas, joints_from, questions)

    def timelines(self, method: str) -> list[Timeline]:
        """Return the timelines of the benchmark; for "independent", one timeline per prompt."""
        return requested_timelines(method, self.requested)

    def measured(self, method: str, motions: Sequence[Motion], seed: int) -> Scores:
        """Compute the scores of motions; see `formulas`.

        "shown" is the percentage of the crops with a question that pass it, "shown_chance" that of real motions of the
        other texts. The hand steps are the largest one of any motion, and the 99th percentile of the motions' largest
        ones. The peak jerk, the area under the jerk and the curve "jerk" are those of windows around the transitions,
        compared with windows around the quarters of real motion.

        "one_text" motions are measured as a whole for every prompt, as in the paper. "independent" motions have no
        transitions and are not whole, so that only their crops are measured.

        Args:
            method: Name of the method.
            motions: One motion for each of `timelines(method)`.
            seed: Seed of the crops of FID+.
        """
        motions = [motion.resampled(self.evaluator.fps) for motion in motions]
        spans, evaluator = self._spans(method, [len(motion) for motion in motions]), Remembering(self.evaluator)
        scores = self.formulas.scores(motions, spans, evaluator, self.truth, seed)
        evidence = self._evidence(method, motions, spans, *evaluator.latents)
        metrics = self._success(motions, spans) | asdict(scores.semantics) | {"fid": scores.fid}
        if method != INDEPENDENT:
            metrics |= {"fid_plus": scores.fid_plus, "transition": scores.transition} | _hand_steps(motions)
        result = Scores(
            metrics, resampled=draw_metrics(len(self.requested), partial(self._measure_again, evidence, method))
        )
        return result if method == INDEPENDENT else self._with_jerk(result, evidence.jerks.values)

    def real(self, seed: int) -> Scores:
        """Compute the scores of the atomic prompts' real motions.

        FID is that of two random halves of the real motions for FID, the lowest possible value; it is 0 if those are
        the atomic prompts' own motions, as published.
        """
        agreement = semantics(self.truth.motions, range(len(self.atomic_prompts)), self.truth)
        least = 0.0
        if self.truth.others is not None:
            order = torch.from_numpy(np.random.default_rng(seed).permutation(len(self.truth.real)))
            least = fid(*(self.truth.real[half] for half in order.tensor_split(2)))
        whole = [[(0, len(motion), number)] for number, motion in enumerate(self.reference_motions)]
        metrics = self._success(self.reference_motions, whole) | asdict(agreement)
        distance = self.formulas.real_transition(self.reference_motions, self.evaluator)
        metrics |= {"fid": least, "fid_plus": least, "transition": distance} | _hand_steps(self.reference_motions)
        return self._with_jerk(Scores(metrics), self._real_jerks)

    @cached_property
    def _real_jerks(self) -> Float[Tensor, "windows frames"]:
        return self._jerks(self.reference_motions, [quarter_points(len(motion)) for motion in self.reference_motions])

    def _jerks(self, motions: Sequence[Motion], points: Sequence[Sequence[int]]) -> Float[Tensor, "windows frames"]:
        """Compute the jerk in m/frame³ of the complete windows around the points of each motion."""
        return self._jerk_rows(motions, points, range(len(motions))).values

    def _jerk_rows(self, motions: Sequence[Motion], points: Sequence[Sequence[int]], units: Sequence[int]) -> Rows:
        return jerk_rows(motions, points, units, self.evaluator.fps)

    def _with_jerk(self, scores: Scores, jerks: Float[Tensor, "windows frames"]) -> Scores:
        """Add the jerk, unless all motions, or all real ones, are shorter than a window."""
        return (
            scores.with_jerk(jerks, float(self._real_jerks.mean())) if len(jerks) and len(self._real_jerks) else scores
        )

    def _success(self, motions: Sequence[Motion], spans: Sequence[Sequence[Span]]) -> dict[str, float]:
        answers = [answer for _, answer in self._answers(motions, spans)]
        return {"shown": 100 * sum(answers) / len(answers), "shown_chance": 100 * self._chance} if answers else {}

    def _answers(self, motions: Sequence[Motion], spans: Sequence[Sequence[Span]]) -> list[tuple[int, bool]]:
        """Return the index of the motion and the answer for every crop with a question."""
        answers = []
        for index, (motion, prompts) in enumerate(zip(motions, spans, strict=True)):
            for start, end, number in prompts:
                if question := self.questions.get(self.atomic_prompts[number].text):
                    answers.append((index, bool(question(motion.trimmed(start, end)))))
        return answers

    @cached_property
    def _chance(self) -> float:
        """The pass rate of real motions of texts with other questions, averaged over texts."""
        requested = [
            prompt.text for timeline in self.requested for prompt in timeline.prompts if prompt.text in self.questions
        ]
        rates = {}
        for text in set(requested):
            question, pairs = self.questions[text], zip(self.atomic_prompts, self.reference_motions, strict=True)
            others = [motion for prompt, motion in pairs if self.questions.get(prompt.text) is not question]
            rates[text] = sum(bool(question(motion)) for motion in others) / max(1, len(others))
        return sum(rates[text] for text in requested) / max(1, len(requested))

    def _evidence(
        self,
        method: str,
        motions: Sequence[Motion],
        spans: Sequence[Sequence[Span]],
        crops: Float[Tensor, "crops width"],
        anywhere: Float[Tensor, "_ width"],
    ) -> _Evidence:
        counts = [len(timeline.prompts) if method == INDEPENDENT else 1 for timeline in self.requested]
        units = np.repeat(np.arange(len(self.requested)), counts).tolist()
        answers = self._answers(motions, spans)
        points = [measured_points(prompts, len(motion)) for prompts, motion in zip(spans, motions, strict=True)]
        steps = [
            pose_steps(local_joints(motion))[[point - 1 for point in frames]]
            for motion, frames in zip(motions, points, strict=True)
        ]
        per_motion = len(anywhere) // len(motions)
        return _Evidence(
            crops=Rows.spread(crops, [len(prompts) for prompts in spans], units),
            texts=torch.tensor([number for prompts in spans for *_, number in prompts]),
            anywhere=Rows.spread(anywhere, [per_motion] * len(motions), units),
            answers=Rows(
                torch.tensor([float(answer) for _, answer in answers]), [units[index] for index, _ in answers]
            ),
            steps=Rows.spread(torch.cat(steps), list(map(len, steps)), units),
            hands=Rows(torch.tensor([100 * hand_step(motion) for motion in motions]), units),
            jerks=self._jerk_rows(motions, points, units),
        )

    def _measure_again(self, evidence: _Evidence, method: str, units: Units) -> dict[str, float]:
        """Compute the results of `measured` for some of the timelines.

        Excluded are the largest hand step, for which draws are not informative, and transitions by the published
        formula.
        """
        rows = evidence.crops.numbers(units)
        crops = evidence.crops.values[rows]
        metrics = asdict(semantics(crops, evidence.texts[rows].tolist(), self.truth)) | {
            "fid": fid(crops, self.truth.real)
        }
        if len(answers := evidence.answers.of(units)):
            metrics["shown"] = 100 * float(answers.mean())
        if method == INDEPENDENT:
            return metrics
        metrics["fid_plus"] = fid(evidence.anywhere.of(units), self.truth.real)
        metrics["hand_step_99"] = float(np.quantile(evidence.hands.of(units).numpy(), 0.99))
        if self.formulas is DEFINED:
            metrics["transition"] = 100 * float(evidence.steps.of(units).mean())
        return self._with_jerk(Scores(metrics), evidence.jerks.of(units)).metrics

    def _spans(self, method: str, lengths: Sequence[int]) -> list[list[Span]]:
        numbers = {prompt.text: number for number, prompt in enumerate(self.atomic_prompts)}
        return crop_spans(method, self.requested, lengths, self.evaluator.fps, numbers)


def open_mtt(
    evaluator: TextEvaluator,
    cache: str | Path | Sequence[str | Path],
    first: int | None = None,
    paraphrase: int | None = None,
) -> MultiTrack:
    """Build the benchmark that anybody can run: bundled timelines, and held-out recordings of Bandai Namco and CMU.

    FID compares with the same number of real clips of every text, drawn from those that it describes; clips of cyclic
    actions are cut to the maximum duration of a prompt.

    Args:
        evaluator: Evaluator of texts and motions.
        cache: Folders of the prepared data sets.
        first: Number of timelines; None uses all.
        paraphrase: Which of the three held-out sentences of its action replaces each text, 1 to 3, in the timelines
            and for the evaluator; None keeps the texts, which are training sentences of both.

    Raises:
        CacheError: If the caches do not show every text.
        SettingError: If there is no such paraphrase.
    """
    if paraphrase not in (None, 1, 2, 3):
        raise SettingError(f"paraphrase={quote(paraphrase)}: must be null, 1, 2 or 3")
    folder, prepared = Path(str(files("stmc") / "assets" / "open_mtt")), read_caches(cache)
    atomic_prompts = read_atomic_prompts(folder / "prompts.json")
    requested = Timeline.read_all(folder / "timelines.json")[:first]
    reference_motions = cache_reference_motions(prepared, SmplRepresentation())
    rng, others = np.random.default_rng(0), []
    for prompt in atomic_prompts:
        clips = prepared.held_out(prompt.text)
        if not clips:
            raise CacheError(
                f"{cache}: no held-out clip shows {prompt.text!r}; prepare the Bandai Namco and CMU data sets and "
                "name both folders"
            )
        drawn = [clips[index] for index in rng.integers(len(clips), size=PER_TEXT)]
        others += [reference_motions(clip.name, 0.0, _seconds(clip, prepared.fps)) for clip in drawn]
    contents = {clip.name: clip.content for clip in prepared.clips}
    if paraphrase is not None:
        atomic_prompts, requested = _paraphrased(atomic_prompts, requested, paraphrase)
    questions = {
        prompt.text: QUESTIONS[contents[prompt.clip]] for prompt in atomic_prompts if contents[prompt.clip] in QUESTIONS
    }
    return MultiTrack.of(requested, atomic_prompts, evaluator, reference_motions, others, questions=questions)


def _paraphrased(
    atomic_prompts: Sequence[AtomicPrompt], requested: Sequence[Timeline], number: int
) -> tuple[list[AtomicPrompt], list[Timeline]]:
    """Replace texts, which are first sentences of actions, by held-out sentence `number` of the same action."""
    sentences = {content.sentences[0]: content.unseen for content in CONTENTS.values()}
    texts = {prompt.text: sentences[prompt.text][number - 1] for prompt in atomic_prompts}
    timelines = [
        replace(timeline, prompts=[replace(prompt, text=texts[prompt.text]) for prompt in timeline.prompts])
        for timeline in requested
    ]
    return [replace(prompt, text=texts[prompt.text]) for prompt in atomic_prompts], timelines


def published_mtt(
    evaluator: TextEvaluator,
    folder: str | Path,
    amass: str | Path,
    body: str | Path | None = None,
    first: int | None = None,
    joints_from: JointsFrom = "features",
) -> MultiTrack:
    """Build the paper's benchmark, measured as published.

    Args:
        evaluator: Evaluator of texts and motions.
        folder: Folder of MTT.txt, texts.txt and motions.txt.
        amass: Folder of AMASS; see `amass_reference_motions`.
        body: Folder of SMPL-H; see `amass_reference_motions`.
        first: Number of timelines; None uses all.
        joints_from: Source of the measured joints. The paper's tables use the joints of the features.
    """
    folder = Path(folder).expanduser()
    atomic_prompts = read_atomic_prompts(folder / "texts.txt", folder / "motions.txt")
    reference_motions = amass_reference_motions(amass, evaluator.fps, body)
    requested = Timeline.read_all(folder / "MTT.txt")[:first]
    return MultiTrack.of(
        requested, atomic_prompts, evaluator, reference_motions, formulas=PUBLISHED, joints_from=joints_from
    )


@dataclass(frozen=True, eq=False)
class _Evidence:
    """Measurements row by row, each of one timeline.

    They are latents of the crops, with the indices of their texts, and of crops from anywhere; answers to questions (0
    or 1); steps of the pose in transitions in metres; each motion's largest hand step in centimetres; and the jerk
    around transitions.
    """

    crops: Rows
    texts: Int[Tensor, " crops"]
    anywhere: Rows
    answers: Rows
    steps: Rows
    hands: Rows
    jerks: Rows


def _hand_steps(motions: Sequence[Motion]) -> dict[str, float]:
    """Return the largest of the motions' hand steps, and the 99th percentile of their largest ones, in centimetres."""
    steps = [100 * hand_step(motion) for motion in motions]
    return {"hand_step": max(steps), "hand_step_99": float(np.quantile(steps, 0.99))}


def _seconds(clip: Clip, fps: float | int) -> float:
    """Return the duration of a clip, for a cyclic action at most that of the longest prompts.

    Any part of a cyclic clip shows its text.
    """
    seconds = (clip.end - clip.start) / fps
    return min(seconds, LONGEST) if clip.cyclic else seconds
