"""The benchmark of timelines with several tracks (STMC, section 4): atomic prompts, timelines of them, real motions.

Knows which frames of a motion should show which text; how that is measured is `metrics.timelines`' matter.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
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
from stmc.evaluation.benchmarks.atomic_prompts import LONGEST, AtomicPrompt, read_atomic_prompts
from stmc.evaluation.benchmarks.benchmark_protocol import Scores, TextEvaluator
from stmc.evaluation.benchmarks.crops import asked_of, crop_spans, jerk_rows
from stmc.evaluation.benchmarks.ground_truth import ReferenceMotions, amass_reference_motions, cache_reference_motions
from stmc.evaluation.benchmarks.questions import QUESTIONS, Question
from stmc.evaluation.benchmarks.resampling import Remembering, Rows, Units, resampled
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
from stmc.timeline import Timeline, TimelineError

PER_TEXT = 12
"""Real clips of each text that FID compares with in the open benchmark."""


@dataclass(frozen=True, eq=False)
class MultiTrack:
    """A `Benchmark` of `asked` timelines whose texts are those of `atomic_prompts`.

    `truth` are the evaluator's latents of the atomic prompts in their order, `reference_motions` the motions that show
    them, at its frame rate. `formulas` and `joints_from` say how to measure, and which joints of a model's features: by
    definition, or as published to compare with the paper's tables. `questions` are those that geometry can answer about
    a motion, for some of the texts: no learned evaluator is asked.
    """

    asked: Sequence[Timeline]
    atomic_prompts: Sequence[AtomicPrompt]
    evaluator: TextEvaluator
    truth: GroundTruth
    reference_motions: Sequence[Motion]
    formulas: Formulas = DEFINED
    joints_from: JointsFrom = "skeleton"
    questions: Mapping[str, Question] = field(default_factory=dict)

    def __post_init__(self) -> None:
        known = {prompt.text for prompt in self.atomic_prompts}
        for timeline in self.asked:
            for prompt in timeline.prompts:
                if prompt.text not in known:
                    raise TimelineError(f"timeline {timeline.name}: {prompt.text!r} is none of the {len(known)} texts")

    @classmethod
    def of(
        cls,
        asked: Sequence[Timeline],
        atomic_prompts: Sequence[AtomicPrompt],
        evaluator: TextEvaluator,
        reference_motions: ReferenceMotions,
        others: Sequence[Motion] = (),
        formulas: Formulas = DEFINED,
        joints_from: JointsFrom = "skeleton",
        questions: Mapping[str, Question] = MappingProxyType({}),
    ) -> MultiTrack:
        """The benchmark with the latents of its atomic prompts, shown by `reference_motions`, and of the `others` that
        FID compares with (none: as published, the atomic prompts' own)."""
        shown = [
            reference_motions(prompt.clip, prompt.start, prompt.end).resampled(evaluator.fps)
            for prompt in atomic_prompts
        ]
        latents = evaluator.motions([evaluator.features(motion) for motion in [*shown, *others]])
        truth = GroundTruth(
            texts=evaluator.texts([prompt.text for prompt in atomic_prompts]),
            motions=latents[: len(atomic_prompts)],
            others=latents[len(atomic_prompts) :] if others else None,
        )
        return cls(asked, atomic_prompts, evaluator, truth, shown, formulas, joints_from, questions)

    def timelines(self, method: str) -> list[Timeline]:
        """Those of the benchmark; for "independent" each of their prompts as a timeline."""
        return asked_of(method, self.asked)

    def measured(self, method: str, motions: Sequence[Motion], seed: int) -> Scores:
        """See `formulas`; "shown" is the share, in percent, of the crops with a question that answer it, "shown_chance"
        that of real motions of the other texts. The hand steps are the largest that any motion has, and the 99th
        percentile of theirs. The peak jerk, the area under the jerk and the curve "jerk" are of windows around the
        transitions, compared with those around the quarters of real motion.

        One text stands for its whole motion, which is measured as every prompt's, as in the paper; "independent"
        motions have no transitions and are not whole, so only their crops are measured.
        """
        motions = [motion.resampled(self.evaluator.fps) for motion in motions]
        spans, evaluator = self._spans(method, [len(motion) for motion in motions]), Remembering(self.evaluator)
        scores = self.formulas.scores(motions, spans, evaluator, self.truth, seed)
        evidence = self._evidence(method, motions, spans, *evaluator.latents)
        metrics = self._shown(motions, spans) | asdict(scores.semantics) | {"fid": scores.fid}
        if method != INDEPENDENT:
            metrics |= {"fid_plus": scores.fid_plus, "transition": scores.transition} | _hand_steps(motions)
        found = Scores(metrics, resampled=resampled(len(self.asked), partial(self._again, evidence, method)))
        return found if method == INDEPENDENT else self._with_jerk(found, evidence.jerks.values)

    def real(self, seed: int) -> Scores:
        """Of the atomic prompts' real motions. FID is that of two random halves of what FID compares with: the least
        that can be hoped for; 0 where that is the atomic prompts' own motions, as published."""
        found = semantics(self.truth.motions, range(len(self.atomic_prompts)), self.truth)
        least = 0.0
        if self.truth.others is not None:
            order = torch.from_numpy(np.random.default_rng(seed).permutation(len(self.truth.real)))
            least = fid(*(self.truth.real[half] for half in order.tensor_split(2)))
        whole = [[(0, len(motion), number)] for number, motion in enumerate(self.reference_motions)]
        metrics = self._shown(self.reference_motions, whole) | asdict(found)
        distance = self.formulas.real_transition(self.reference_motions, self.evaluator)
        metrics |= {"fid": least, "fid_plus": least, "transition": distance} | _hand_steps(self.reference_motions)
        return self._with_jerk(Scores(metrics), self._real_jerks)

    @cached_property
    def _real_jerks(self) -> Float[Tensor, "windows frames"]:
        return self._jerks(self.reference_motions, [quarter_points(len(motion)) for motion in self.reference_motions])

    def _jerks(self, motions: Sequence[Motion], points: Sequence[Sequence[int]]) -> Float[Tensor, "windows frames"]:
        """In m/frame³, of the windows around the points of each motion that lie within it."""
        return self._jerk_rows(motions, points, range(len(motions))).values

    def _jerk_rows(self, motions: Sequence[Motion], points: Sequence[Sequence[int]], units: Sequence[int]) -> Rows:
        return jerk_rows(motions, points, units, self.evaluator.fps)

    def _with_jerk(self, scores: Scores, jerks: Float[Tensor, "windows frames"]) -> Scores:
        """As they are where all motions, or all real ones, are shorter than a window."""
        return (
            scores.with_jerk(jerks, float(self._real_jerks.mean())) if len(jerks) and len(self._real_jerks) else scores
        )

    def _shown(self, motions: Sequence[Motion], spans: Sequence[Sequence[Span]]) -> dict[str, float]:
        answers = [answer for _, answer in self._answers(motions, spans)]
        return {"shown": 100 * sum(answers) / len(answers), "shown_chance": 100 * self._chance} if answers else {}

    def _answers(self, motions: Sequence[Motion], spans: Sequence[Sequence[Span]]) -> list[tuple[int, bool]]:
        """The motion's number and the answer of every crop with a question."""
        answers = []
        for place, (motion, each) in enumerate(zip(motions, spans, strict=True)):
            for start, end, number in each:
                if question := self.questions.get(self.atomic_prompts[number].text):
                    answers.append((place, bool(question(motion.trimmed(start, end)))))
        return answers

    @cached_property
    def _chance(self) -> float:
        """How often real motions of the texts with other questions, each counting the same, answer those of the asked
        prompts."""
        asked = [prompt.text for timeline in self.asked for prompt in timeline.prompts if prompt.text in self.questions]
        rates = {}
        for text in set(asked):
            question, named = self.questions[text], zip(self.atomic_prompts, self.reference_motions, strict=True)
            others = [motion for prompt, motion in named if self.questions.get(prompt.text) is not question]
            rates[text] = sum(bool(question(motion)) for motion in others) / max(1, len(others))
        return sum(rates[text] for text in asked) / max(1, len(asked))

    def _evidence(
        self,
        method: str,
        motions: Sequence[Motion],
        spans: Sequence[Sequence[Span]],
        crops: Float[Tensor, "crops width"],
        anywhere: Float[Tensor, "_ width"],
    ) -> _Evidence:
        counts = [len(timeline.prompts) if method == INDEPENDENT else 1 for timeline in self.asked]
        units = np.repeat(np.arange(len(self.asked)), counts).tolist()
        answers = self._answers(motions, spans)
        points = [measured_points(each, len(motion)) for each, motion in zip(spans, motions, strict=True)]
        steps = [
            pose_steps(local_joints(motion))[[at - 1 for at in chosen]]
            for motion, chosen in zip(motions, points, strict=True)
        ]
        per_motion = len(anywhere) // len(motions)
        return _Evidence(
            crops=Rows.spread(crops, [len(each) for each in spans], units),
            texts=torch.tensor([number for each in spans for *_, number in each]),
            anywhere=Rows.spread(anywhere, [per_motion] * len(motions), units),
            answers=Rows(torch.tensor([float(answer) for _, answer in answers]), [units[at] for at, _ in answers]),
            steps=Rows.spread(torch.cat(steps), list(map(len, steps)), units),
            hands=Rows(torch.tensor([100 * hand_step(motion) for motion in motions]), units),
            jerks=self._jerk_rows(motions, points, units),
        )

    def _again(self, evidence: _Evidence, method: str, units: Units) -> dict[str, float]:
        """What `measured` finds of some of the timelines: but for the largest hand step, which no draw tells of, and
        the transitions by the published formula."""
        chosen = evidence.crops.numbers(units)
        crops = evidence.crops.values[chosen]
        metrics = asdict(semantics(crops, evidence.texts[chosen].tolist(), self.truth)) | {
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
        return crop_spans(method, self.asked, lengths, self.evaluator.fps, numbers)


def open_mtt(
    evaluator: TextEvaluator, cache: str | Path | Sequence[str | Path], first: int | None = None
) -> MultiTrack:
    """The benchmark that anybody can run: bundled timelines, and real motion from the recordings of the Bandai Namco
    and the CMU data sets that are held out of training, prepared in the folders `cache`.

    FID compares with as many real clips of every text, drawn from those that it describes; of cyclic contents they
    last as long as a prompt can at most. `first`: only so many of the timelines. Raises `CacheError` for caches that
    do not show every text.
    """
    folder, prepared = Path(str(files("stmc") / "assets" / "open_mtt")), read_caches(cache)
    atomic_prompts = read_atomic_prompts(folder / "prompts.json")
    asked = Timeline.read_all(folder / "timelines.json")[:first]
    reference_motions = cache_reference_motions(prepared, SmplRepresentation())
    rng, others = np.random.default_rng(0), []
    for prompt in atomic_prompts:
        clips = prepared.held_out(prompt.text)
        if not clips:
            raise CacheError(
                f"{cache}: no held-out clip shows {prompt.text!r}; prepare the Bandai Namco and the CMU data sets and "
                "name both"
            )
        drawn = [clips[index] for index in rng.integers(len(clips), size=PER_TEXT)]
        others += [reference_motions(clip.name, 0.0, _seconds(clip, prepared.fps)) for clip in drawn]
    contents = {clip.name: clip.content for clip in prepared.clips}
    questions = {
        prompt.text: QUESTIONS[contents[prompt.clip]] for prompt in atomic_prompts if contents[prompt.clip] in QUESTIONS
    }
    return MultiTrack.of(asked, atomic_prompts, evaluator, reference_motions, others, questions=questions)


def published_mtt(
    evaluator: TextEvaluator,
    folder: str | Path,
    amass: str | Path,
    body: str | Path | None = None,
    first: int | None = None,
    joints_from: JointsFrom = "features",
) -> MultiTrack:
    """The paper's benchmark, measured as published: `folder` holds its MTT.txt, texts.txt and motions.txt; see
    `amass_reference_motions` for the rest. The paper's tables were made from the joints of the features."""
    folder = Path(folder).expanduser()
    atomic_prompts = read_atomic_prompts(folder / "texts.txt", folder / "motions.txt")
    reference_motions = amass_reference_motions(amass, evaluator.fps, body)
    asked = Timeline.read_all(folder / "MTT.txt")[:first]
    return MultiTrack.of(
        asked, atomic_prompts, evaluator, reference_motions, formulas=PUBLISHED, joints_from=joints_from
    )


@dataclass(frozen=True, eq=False)
class _Evidence:
    """What was found of motions, row by row, each of one of the asked timelines: latents of the crops, with their
    texts' numbers, and of crops from anywhere; answers to questions (0 or 1); steps of the pose in transitions, metres;
    each motion's largest hand step, centimetres; the jerk around transitions."""

    crops: Rows
    texts: Int[Tensor, " crops"]
    anywhere: Rows
    answers: Rows
    steps: Rows
    hands: Rows
    jerks: Rows


def _hand_steps(motions: Sequence[Motion]) -> dict[str, float]:
    """Of each motion's own largest: the largest, and the 99th percentile; in centimetres."""
    steps = [100 * hand_step(motion) for motion in motions]
    return {"hand_step": max(steps), "hand_step_99": float(np.quantile(steps, 0.99))}


def _seconds(clip: Clip, fps: float | int) -> float:
    """How long it lasts; a cyclic one shows its text in any piece, so also in one as long as prompts are at most."""
    seconds = (clip.end - clip.start) / fps
    return min(seconds, LONGEST) if clip.cyclic else seconds
