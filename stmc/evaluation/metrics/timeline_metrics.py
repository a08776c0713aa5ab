"""The measures of motions made from timelines (STMC, section 4.2): do crops match their texts, is the whole realistic?

Knows motions, the spans of their prompts, and any evaluator that turns motion into latents; knows no timeline file, no
network and no way to make motions.
"""

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
"""First frame, frame after the last, and number of the prompt's text among the ground truth's."""


@runtime_checkable
class MotionEvaluator(Protocol):
    """What turns motions into latents, as `evaluators.Evaluator` does. `fps`: of the features."""

    @property
    def fps(self) -> float | int: ...

    def features(self, motion: Motion) -> Float[Tensor, "_ features"]: ...

    def motions(self, features: Sequence[Float[Tensor, "_ features"]]) -> Float[Tensor, "batch width"]: ...


@dataclass(frozen=True, eq=False)
class GroundTruth:
    """The latents of every atomic text, and of a real motion that shows it; `others` are those of all the real motions
    that FID compares with (None: `motions`, as published)."""

    texts: Float[Tensor, "texts width"]
    motions: Float[Tensor, "texts width"]
    others: Float[Tensor, "_ width"] | None = None

    @property
    def real(self) -> Float[Tensor, "_ width"]:
        """What FID compares with."""
        return self.motions if self.others is None else self.others


@dataclass(frozen=True)
class Semantics:
    """How well crops match their texts: the shares, in percent, of crops whose own text is the best, and among the best
    three, of all texts; and TMR-Scores in [0, 1] between crops and their texts (M2T) and their real motions (M2M)."""

    recall_1: float
    recall_3: float
    m2t: float
    m2m: float


@dataclass(frozen=True)
class TimelineScores:
    """Semantics of the crops; realism: FID of the crops and FID+ of five-second crops from anywhere; and the transition
    distance in centimetres."""

    semantics: Semantics
    fid: float
    fid_plus: float
    transition: float


def semantics(crops: Float[Tensor, "crops width"], numbers: Sequence[int], truth: GroundTruth) -> Semantics:
    """Of the latents of crops, each with its text's number. The ground truth's own: `semantics(truth.motions, range(n),
    truth)`."""
    own = torch.tensor(list(numbers))
    right = torch.nn.functional.one_hot(own, len(truth.texts)).bool()
    found = ranks(cosines(crops, truth.texts), right)
    to_text, to_motion = (
        scores(torch.nn.functional.cosine_similarity(crops, latents[own], dim=-1)).double().mean()
        for latents in (truth.texts, truth.motions)
    )
    shares = [100 * float((found < count).double().mean()) for count in (1, 3)]
    return Semantics(*shares, float(to_text), float(to_motion))


def measured_points(spans: Sequence[Span], frames: int) -> tuple[int, ...]:
    """The frames at which the transitions of a motion of so many frames are measured: every begin and end of a prompt
    within it; where it has none, its quarters, as of real motion."""
    return transition_points(_edges(spans), frames) or quarter_points(frames)


def timeline_scores(
    motions: Sequence[Motion],
    spans: Sequence[Sequence[Span]],
    evaluator: MotionEvaluator,
    truth: GroundTruth,
    seed: int = 0,
) -> TimelineScores:
    """All measures of motions, each with the spans of its prompts in frames at the evaluator's frame rate.

    Transitions: every begin and end of a prompt within a motion, of joints relative to the pelvis in its heading frame;
    a motion without any is measured at its quarters, as real ones are. FID+ takes five crops of each motion, drawn with
    `seed` over its whole length. Raises `ImplausibleMotion` for joints that no measure can be meant for.
    """
    motions = _at(motions, evaluator.fps)
    features = [evaluator.features(motion) for motion in motions]
    crop = int(CROP_SECONDS * evaluator.fps)
    starts = crop_starts([len(rows) for rows in features], crop, seed)
    poses = [local_joints(motion) for motion in motions]
    points = [measured_points(each, len(pose)) for each, pose in zip(spans, poses, strict=True)]
    distance = transition_distance(poses, points)
    return _scores(features, spans, starts, crop, evaluator, truth, distance)


def published_timeline_scores(
    motions: Sequence[Motion],
    spans: Sequence[Sequence[Span]],
    evaluator: MotionEvaluator,
    truth: GroundTruth,
    seed: int = 0,
) -> TimelineScores:
    """What the published code prints for the same motions, to compare with the paper's tables. Its evaluator must know
    HumanML3D's 263 features.

    It differs in FID+ (`published_crop_starts`, the same whatever the `seed`) and in the transition distance
    (`published_transition_distance`, at `published_transition_points`).
    """
    features = _published_features(motions, evaluator)
    crop = int(CROP_SECONDS * evaluator.fps)
    starts = [published_crop_starts(rows.shape[1], crop) for rows in features]
    for number, rows in enumerate(features):
        if len(rows) <= max(starts[number]):
            raise ValueError(
                f"motion {number}: {len(rows)} frames; the published crops begin at up to {max(starts[0])}"
            )
    points = [
        published_transition_points(_edges(each), len(rows))
        if transition_points(_edges(each), len(rows))
        else quarter_points(len(rows))
        for each, rows in zip(spans, features, strict=True)
    ]
    poses = [z_up(features_to_local_joints(rows)) for rows in features]
    distance = published_transition_distance(poses, points)
    return _scores(features, spans, starts, crop, evaluator, truth, distance)


def real_transition(motions: Sequence[Motion], evaluator: MotionEvaluator) -> float:
    """The distance in centimetres from frame to frame in real motions, at their quarters: what `timeline_scores`'
    transitions compare with."""
    poses = [local_joints(motion) for motion in _at(motions, evaluator.fps)]
    return _at_quarters(poses)


def published_real_transition(motions: Sequence[Motion], evaluator: MotionEvaluator) -> float:
    """What the published code prints in the ground truth's row: of the joints of HumanML3D's features (22, one frame
    less, on its skeleton), relative to the pelvis."""
    return _at_quarters([z_up(features_to_local_joints(rows)) for rows in _published_features(motions, evaluator)])


@dataclass(frozen=True)
class Formulas:
    """How all of a table is computed: `scores` of motions made from timelines, `real_transition` of the ground truth's
    (its other measures have one formula)."""

    scores: Callable[..., TimelineScores]
    real_transition: Callable[[Sequence[Motion], MotionEvaluator], float]


DEFINED = Formulas(timeline_scores, real_transition)
"""By the definitions of the paper."""

PUBLISHED = Formulas(published_timeline_scores, published_real_transition)
"""By the published code, to compare with the paper's tables."""


def _published_features(motions: Sequence[Motion], evaluator: MotionEvaluator) -> list[Float[Tensor, "_ features"]]:
    features = [evaluator.features(motion) for motion in _at(motions, evaluator.fps)]
    if (width := features[0].shape[1]) != HUMANML3D_LAYOUT.width:
        raise ValueError(
            f"the evaluator knows {width} features; the published formulas need one of HumanML3D's "
            f"{HUMANML3D_LAYOUT.width}, such as the published TMR (stmc import)"
        )
    return features


def _at_quarters(poses: Sequence[Float[Tensor, "_ joints 3"]]) -> float:
    return 100 * transition_distance(poses, [quarter_points(len(pose)) for pose in poses])


def _at(motions: Sequence[Motion], fps: float | int) -> list[Motion]:
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
    pairs = [(rows, span) for rows, each in zip(features, spans, strict=True) for span in each]
    own = evaluator.motions([rows[start:end] for rows, (start, end, _) in pairs])
    anywhere = evaluator.motions(
        [rows[start : start + crop] for rows, each in zip(features, starts, strict=True) for start in each]
    )
    matched = semantics(own, [number for _, (_, _, number) in pairs], truth)
    return TimelineScores(matched, fid(own, truth.real), fid(anywhere, truth.real), 100 * distance)
