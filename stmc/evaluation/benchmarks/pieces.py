"""Subsequences and windows around transitions of motions of several consecutive texts.

See Barquero et al. (2024), section 4.1. Depends on timelines of one track and the features of an evaluator; independent
of metrics other than jerk, and of reference data.
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
    """Cut motions into a subsequence per prompt, and a window around the first frame of each prompt but the first.

    Features are computed for a whole motion and then cut.

    Args:
        timelines: Timelines of one track.
        motions: One motion per timeline.
        evaluator: Evaluator that computes the features.
        window: Length of a window in frames, at the evaluator's frame rate.

    Raises:
        ValueError: Unless there is one motion of about the right length per timeline.
    """
    fps, pieces = evaluator.fps, Pieces([], [], [])
    if len(motions) != len(timelines):
        raise ValueError(f"{len(motions)} motions for {len(timelines)} timelines; pass one motion per timeline")
    check_joints([motion.joints for motion in motions])
    for timeline, motion in zip(timelines, motions, strict=True):
        tolerance = 1 + fps / motion.fps  # frames lost by rounding at either frame rate
        motion = motion.resampled(fps)
        spans = timeline.spans(fps)
        if len(motion) < spans[-1][1] - tolerance:
            raise ValueError(
                f"the motion of timeline {timeline.name} has {len(motion)} frames instead of {spans[-1][1]}"
            )
        features = evaluator.features(motion)
        pieces.subsequences.extend(features[start:end] for start, end in spans)
        for start, end in (transition_window(start, window) for start, _ in spans[1:]):
            pieces.windows.append(features[start:end])
            pieces.jerks.append(window_jerk(motion.trimmed(start, min(end, len(motion))), window))
    return pieces
