"""The metrics of motions generated from timelines (STMC, section 4.2): text agreement of crops, and realism."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor

from stmc.evaluation.metrics.plausibility import check_joints
from stmc.evaluation.metrics.realism import CROP_SECONDS, crop_starts, fid, published_crop_starts
from stmc.evaluation.metrics.retrieval import cosines, ranks, scores
from stmc.evaluation.metrics.smoothness import (
    published_transition_distance,
    published_transition_points,
    quarter_points,
    transition_distance,
    transition_points,
)
from stmc.motion.kinematics import local_joints
from stmc.motion.motion import Motion
from stmc.motion.representation import HUMANML3D_LAYOUT
from stmc.motion.representation.humanml3d import features_to_local_joints, z_up

Span = tuple[int, int, int]
"""First frame, frame after the last, and index of the prompt's text in the ground truth."""


@runtime_checkable
class MotionEvaluator(Protocol):
    """An object that embeds motions, as `evaluators.Evaluator` does; `fps` is the frame rate of its features."""

    @property
    def fps(self) -> float | int: ...

    def features(self, motion: Motion) -> Float[Tensor, "_ features"]: ...

    def motions(self, features: Sequence[Float[Tensor, "_ features"]]) -> Float[Tensor, "batch width"]: ...


@dataclass(frozen=True, eq=False)
class GroundTruth:
    """The latents of every atomic text, and of a real motion of it.

    Args:
        texts: Latents of the texts, [texts, width].
        motions: Latents of the real motions, [texts, width].
        others: Latents of the real motions for FID; None uses `motions`, as published.
    """

    texts: Float[Tensor, "texts width"]
    motions: Float[Tensor, "texts width"]
    others: Float[Tensor, "_ width"] | None = None

    @property
    def real(self) -> Float[Tensor, "_ width"]:
        """Latents of the real motions for FID."""
        return self.motions if self.others is None else self.others


@dataclass(frozen=True)
class Semantics:
    """Agreement of crops with their texts.

    Args:
        recall_1: Percentage of crops whose own text is the best of all texts.
        recall_3: Percentage of crops whose own text is among the best three.
        m2t: TMR-Score in [0, 1] between crops and their texts.
        m2m: TMR-Score in [0, 1] between crops and the real motions of their texts.
    """

    recall_1: float
    recall_3: float
    m2t: float
    m2m: float


@dataclass(frozen=True)
class TimelineScores:
    """All metrics of motions generated from timelines.

    Args:
        semantics: Agreement of crops with their texts.
        fid: FID of the crops.
        fid_plus: FID+ of five-second crops from anywhere.
        transition: Transition distance in centimetres.
    """

    semantics: Semantics
    fid: float
    fid_plus: float
    transition: float


def semantics(crops: Float[Tensor, "crops width"], numbers: Sequence[int], truth: GroundTruth) -> Semantics:
    """Compute `Semantics` from the latents of crops and the indices of their texts.

    The ground truth's own value is `semantics(truth.motions, range(n), truth)`.

    Args:
        crops: Latents of the crops, [crops, width].
        numbers: Index of each crop's text.
        truth: The ground truth.
    """
    indices = torch.tensor(list(numbers))
    right = torch.nn.functional.one_hot(indices, len(truth.texts)).bool()
    positions = ranks(cosines(crops, truth.texts), right)
    to_text, to_motion = (
        scores(torch.nn.functional.cosine_similarity(crops, latents[indices], dim=-1)).double().mean()
        for latents in (truth.texts, truth.motions)
    )
    recall_1, recall_3 = (100 * float((positions < count).double().mean()) for count in (1, 3))
    return Semantics(recall_1, recall_3, float(to_text), float(to_motion))


def measured_points(spans: Sequence[Span], frames: int) -> tuple[int, ...]:
    """Return the frames of a motion at which transitions are measured.

    These are the begins and ends of prompts within the motion or, if there are none, its quarters, as for real motion.
    """
    return transition_points(_edges(spans), frames) or quarter_points(frames)


def timeline_scores(
    motions: Sequence[Motion],
    spans: Sequence[Sequence[Span]],
    evaluator: MotionEvaluator,
    truth: GroundTruth,
    seed: int = 0,
) -> TimelineScores:
    """Compute all metrics of motions.

    Transitions are the begins and ends of prompts within a motion, measured by joints relative to the pelvis in its
    heading frame; a motion without any is measured at its quarters, as real motions are. FID+ uses five crops of each
    motion, drawn over its whole length.

    Args:
        motions: The motions.
        spans: Spans of the prompts of each motion, in frames at the evaluator's frame rate.
        evaluator: Evaluator of the motions.
        truth: The ground truth.
        seed: Seed of the crops.

    Raises:
        ImplausibleMotion: If the joints cannot be people's.
    """
    motions = _resample(motions, evaluator.fps)
    features = [evaluator.features(motion) for motion in motions]
    crop = int(CROP_SECONDS * evaluator.fps)
    starts = crop_starts([len(rows) for rows in features], crop, seed)
    poses = [local_joints(motion) for motion in motions]
    points = [measured_points(prompts, len(pose)) for prompts, pose in zip(spans, poses, strict=True)]
    distance = transition_distance(poses, points)
    return _scores(features, spans, starts, crop, evaluator, truth, distance)


def published_timeline_scores(
    motions: Sequence[Motion],
    spans: Sequence[Sequence[Span]],
    evaluator: MotionEvaluator,
    truth: GroundTruth,
    seed: int = 0,
) -> TimelineScores:
    """Compute the values that the published code prints for the same motions, to compare with the paper's tables.

    The evaluator must use HumanML3D's 263 features. The values differ in FID+ (`published_crop_starts`, the same for
    every `seed`) and in the transition distance (`published_transition_distance`, at `published_transition_points`).

    Args:
        motions: The motions.
        spans: Spans of the prompts of each motion, in frames at the evaluator's frame rate.
        evaluator: Evaluator of the motions.
        truth: The ground truth.
        seed: Ignored.

    Raises:
        ImplausibleMotion: If the joints cannot be people's.
        ValueError: If the evaluator has other features, or a motion is too short.
    """
    features = _published_features(motions, evaluator)
    crop = int(CROP_SECONDS * evaluator.fps)
    starts = [published_crop_starts(rows.shape[1], crop) for rows in features]
    for number, rows in enumerate(features):
        if len(rows) <= max(starts[number]):
            raise ValueError(
                f"motion {number}: {len(rows)} frames are too few; published crops begin at up to {max(starts[0])}"
            )
    points = [
        published_transition_points(_edges(prompts), len(rows))
        if transition_points(_edges(prompts), len(rows))
        else quarter_points(len(rows))
        for prompts, rows in zip(spans, features, strict=True)
    ]
    poses = [z_up(features_to_local_joints(rows)) for rows in features]
    distance = published_transition_distance(poses, points)
    return _scores(features, spans, starts, crop, evaluator, truth, distance)


def real_transition(motions: Sequence[Motion], evaluator: MotionEvaluator) -> float:
    """Return the distance in centimetres between consecutive frames of real motions, at their quarters.

    The transitions of `timeline_scores` are compared with it.
    """
    poses = [local_joints(motion) for motion in _resample(motions, evaluator.fps)]
    return _at_quarters(poses)


def published_real_transition(motions: Sequence[Motion], evaluator: MotionEvaluator) -> float:
    """Compute the value that the published code prints in the row of the ground truth.

    It uses the joints of HumanML3D's features (22, one frame fewer, on its skeleton), relative to the pelvis.
    """
    return _at_quarters([z_up(features_to_local_joints(rows)) for rows in _published_features(motions, evaluator)])


@dataclass(frozen=True)
class Formulas:
    """The formulas of a table.

    Args:
        scores: Computes the metrics of generated motions.
        real_transition: Computes the transition distance of the ground truth, whose other metrics have one formula.
    """

    scores: Callable[..., TimelineScores]
    real_transition: Callable[[Sequence[Motion], MotionEvaluator], float]


DEFINED = Formulas(timeline_scores, real_transition)
"""The formulas defined in the paper."""
PUBLISHED = Formulas(published_timeline_scores, published_real_transition)
"""The formulas of the published code, to compare with the paper's tables."""


def _published_features(motions: Sequence[Motion], evaluator: MotionEvaluator) -> list[Float[Tensor, "_ features"]]:
    features = [evaluator.features(motion) for motion in _resample(motions, evaluator.fps)]
    if (width := features[0].shape[1]) != HUMANML3D_LAYOUT.width:
        raise ValueError(
            f"the evaluator uses {width} features; the published formulas need one of HumanML3D's "
            f"{HUMANML3D_LAYOUT.width}, such as the published TMR (stmc import)"
        )
    return features


def _at_quarters(poses: Sequence[Float[Tensor, "_ joints 3"]]) -> float:
    return 100 * transition_distance(poses, [quarter_points(len(pose)) for pose in poses])


def _resample(motions: Sequence[Motion], fps: float | int) -> list[Motion]:
    check_joints([motion.joints for motion in motions])
    return [motion.resampled(fps) for motion in motions]


def _edges(spans: Sequence[Span]) -> list[tuple[int, int]]:
    return [(start, end) for start, end, _ in spans]


def _scores(
    features: Sequence[Tensor],
    spans: Sequence[Sequence[Span]],
    starts: Sequence[Sequence[int]],
    crop: int,
    evaluator: MotionEvaluator,
    truth: GroundTruth,
    distance: float,
) -> TimelineScores:
    pairs = [(rows, span) for rows, prompts in zip(features, spans, strict=True) for span in prompts]
    crops = evaluator.motions([rows[start:end] for rows, (start, end, _) in pairs])
    anywhere = evaluator.motions(
        [
            rows[start : start + crop]
            for rows, first_frames in zip(features, starts, strict=True)
            for start in first_frames
        ]
    )
    matched = semantics(crops, [number for _, (_, _, number) in pairs], truth)
    return TimelineScores(matched, fid(crops, truth.real), fid(anywhere, truth.real), 100 * distance)
