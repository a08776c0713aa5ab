"""Motions of several texts one after the other, cut into what is measured: subsequences, and windows around transitions
(Barquero et al. 2024, section 4.1).

Knows timelines of one track and an evaluator's features; knows no metric but the jerk, and nothing to compare with.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from jaxtyping import Float
from torch import Tensor

from stmc.evaluation.metrics.plausibility import check_joints
from stmc.evaluation.metrics.smoothness import transition_window, window_jerk
from stmc.evaluation.metrics.timeline_metrics import MotionEvaluator
from stmc.motion.motion import Motion
from stmc.timeline import Timeline


class Pieces(NamedTuple):
    """Features of every subsequence and of every window, and the jerk in each frame of the windows."""

    subsequences: list[Float[Tensor, "_ features"]]
    windows: list[Float[Tensor, "_ features"]]
    jerks: list[Float[Tensor, " _"]]


def pieces_of(
    timelines: Sequence[Timeline], motions: Sequence[Motion], evaluator: MotionEvaluator, window: int
) -> Pieces:
    """The pieces of all motions, in order: of each a subsequence for every prompt, and a window of so many frames, at
    the evaluator's frame rate, around the first frame of each prompt but the first. The features of a motion are made
    of it as a whole, then cut.

    Raises `ValueError` unless there is a motion for each timeline, about as long.
    """
    fps, pieces = evaluator.fps, Pieces([], [], [])
    if len(motions) != len(timelines):
        raise ValueError(f"{len(motions)} motions for {len(timelines)} timelines")
    check_joints([motion.joints for motion in motions])
    for timeline, motion in zip(timelines, motions, strict=True):
        lost = 1 + fps / motion.fps  # at most, by rounding to frames of either rate
        motion = motion.resampled(fps)
        spans = timeline.spans(fps)
        if len(motion) < spans[-1][1] - lost:
            raise ValueError(f"the motion of timeline {timeline.name} has {len(motion)} frames, not {spans[-1][1]}")
        features = evaluator.features(motion)
        pieces.subsequences.extend(features[start:end] for start, end in spans)
        for start, end in (transition_window(start, window) for start, _ in spans[1:]):
            pieces.windows.append(features[start:end])
            pieces.jerks.append(window_jerk(motion.trimmed(start, min(end, len(motion))), window))
    return pieces
