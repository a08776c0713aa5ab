"""The benchmark of compositions in time: many consecutive actions, whose subsequences and transitions are measured.

See Barquero et al. (2024), section 4.1. Requests are drawn from the test clips of a prepared data set and their
sentences, and results are compared with the clips by an evaluator. Independent of models.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor

from stmc.data.cache import Cache, CacheError, Clip
from stmc.evaluation.benchmarks.benchmark_protocol import Scores, TextEvaluator
from stmc.evaluation.benchmarks.pieces import pieces_of
from stmc.evaluation.benchmarks.resampling import Rows, Units, draw_metrics
from stmc.evaluation.metrics.matching_metrics import POOL_SIZE, embedding_diversity, matching_score, r_precision
from stmc.evaluation.metrics.plausibility import check_joints
from stmc.evaluation.metrics.realism import fid
from stmc.evaluation.metrics.smoothness import HUMANML3D_WINDOW, window_jerk
from stmc.motion.motion import Motion
from stmc.motion.representation import JointsFrom, Representation
from stmc.timeline import Prompt, Timeline

REQUESTED, REFERENCE, REAL = range(3)
"""Uses of a seed; each has its own random stream."""


@dataclass(frozen=True)
class Segment:
    """A sentence and a real clip that it describes, requested for `seconds`."""

    text: str
    clip: Clip
    seconds: float


@dataclass(frozen=True, eq=False)
class Measurements:
    """Measurements of generated or real motions.

    Args:
        segments: The segments.
        texts: Latents of the segments' texts, of length 1.
        subsequences: Latents of the subsequences, of length 1.
        windows: Latents of windows around transitions, of length 1.
        jerks: Jerk of each frame of the windows.
    """

    segments: tuple[Segment, ...]
    texts: Float[Tensor, "segments width"]
    subsequences: Float[Tensor, "segments width"]
    windows: Float[Tensor, "windows width"]
    jerks: Float[Tensor, "windows frames"]


class Compositions:
    """A `Benchmark` of compositions drawn from the unmirrored test clips of a prepared data set.

    Every action with enough clips is drawn with the same probability, however many clips it has; a segment lasts as
    long as its clip, clipped to `shortest` and `longest`. A transition is a window around the first frame of each
    segment but the first. Latents are compared at length 1, as in TMR.

    Args:
        cache: Prepared data set.
        representation: Representation of the features in the cache.
        evaluator: Evaluator of texts and motions.
        count: Number of compositions.
        segments: Number of pairs of a sentence and a duration per composition.
        repeats: Number of consecutive segments of each drawn action. Above 1, only cyclic actions are drawn;
            `repeats=segments` is FlowMDM's extrapolation.
        shortest: Minimum duration of a segment in seconds.
        longest: Maximum duration of a segment in seconds.
        min_clips: Minimum number of clips of an action.
        window: Length of a transition in frames, at the evaluator's frame rate.
        seed: Seed of the draw.

    Raises:
        CacheError: If the test split holds too little.
        ImplausibleMotion: If its motions cannot be people's.
        ValueError: If a number is invalid.
    """

    joints_from: JointsFrom = "skeleton"

    def __init__(
        self,
        cache: Cache,
        representation: Representation,
        evaluator: TextEvaluator,
        count: int = 32,
        segments: int = 32,
        repeats: int = 1,
        shortest: float | int = 2.0,
        longest: float | int = 8.0,
        min_clips: int = 5,
        window: int = HUMANML3D_WINDOW,
        seed: int = 0,
    ) -> None:
        if min(count, segments - 1, repeats, min_clips, window - 7) < 1 or count * segments < POOL_SIZE:
            raise ValueError(
                f"count {count}, repeats {repeats} and min_clips {min_clips} must be at least 1, segments {segments} "
                f"2, window {window} 8, and there must be {POOL_SIZE} segments in all, not {count * segments}"
            )
        if not window / 2 <= int(shortest * evaluator.fps) <= longest * evaluator.fps:
            raise ValueError(
                f"shortest {shortest} s must be half of the window ({window} frames at {evaluator.fps} a second) or "
                f"more, and at most longest, {longest} s"
            )
        self.evaluator, self.window, self.longest, self._shortest = evaluator, window, longest, shortest
        self._repeats, self._seed = repeats, seed
        self._sentences = {key: dict(rows) for key, rows in cache.texts.items()}
        self._contents = _contents(cache, min_clips, cyclic=repeats > 1)
        self._reference_motions = _reference_motions(cache, representation, evaluator.fps, self._contents)
        self._long = self._long_enough()
        rng = np.random.default_rng([seed, REQUESTED])
        self.compositions = [self._composition(segments, rng) for _ in range(count)]

    def timelines(self, method: str) -> list[Timeline]:
        """Return the timelines, the same for every method: one track of prompts that claim the whole body."""
        return list(self._timelines)

    def measured(self, method: str, motions: Sequence[Motion], seed: int) -> Scores:
        """Compute the scores of FlowMDM's tables, and the curve "jerk", its mean over the transitions in each frame.

        R-precision looks for each text's own motion, in batches of 32 drawn with `seed`, among the motions of other
        texts. Other motions of clips that the text describes are no candidates: actions repeat, so that finding one of
        them is neither an error nor a merit. FID compares subsequences with the drawn clips, and each transition with a
        window of a real clip of its second action. The area under the jerk is measured from the mean jerk of these
        windows, each rotated to begin with heading zero.

        Args:
            method: Ignored.
            motions: One motion per timeline.
            seed: Seed of the batches.

        Raises:
            ValueError: Unless there is one motion of about the right length per timeline.
        """
        return self._scores(self._measure_motions(motions), seed)

    def real(self, seed: int) -> Scores:
        """Compute the scores of other clips with the same sentences, and of other windows: the lowest possible FID.

        If few clips show a sentence, some of them are the same.
        """
        rng = np.random.default_rng([seed, REAL])
        drawn = [
            tuple(replace(segment, clip=_choice(self._clips_of(segment.text), rng)) for segment in composition)
            for composition in self.compositions
        ]
        return self._scores(self._measure_clips(drawn, rng), seed)

    @cached_property
    def _timelines(self) -> list[Timeline]:
        timelines = []
        for number, composition in enumerate(self.compositions):
            prompts, start = [], 0.0
            for segment in composition:
                end = round(start + segment.seconds, 2)
                prompts.append(Prompt(segment.text, start, end))
                start = end
            timelines.append(Timeline(prompts, f"{number:04d}"))
        return timelines

    @cached_property
    def _reference(self) -> Measurements:
        return self._measure_clips(self.compositions, np.random.default_rng([self._seed, REFERENCE]))

    def _composition(self, segments: int, rng: np.random.Generator) -> tuple[Segment, ...]:
        """Draw an action, one of its clips and one of the clip's sentences, until there are enough segments.

        The other segments of an action have their own clips among those that the sentence describes.
        """
        drawn: list[Segment] = []
        while len(drawn) < segments:
            clip = _choice(_choice(list(self._contents.values()), rng), rng)
            weights = np.array(list(self._sentences[clip.texts].values()))
            text = list(self._sentences[clip.texts])[int(rng.choice(len(weights), p=weights / weights.sum()))]
            clips = [clip, *(_choice(self._clips_of(text), rng) for _ in range(self._repeats - 1))]
            drawn += [Segment(text, shown, self._duration(shown)) for shown in clips[: segments - len(drawn)]]
        return tuple(drawn)

    def _clips_of(self, text: str) -> list[Clip]:
        return [clip for clips in self._contents.values() for clip in clips if text in self._sentences[clip.texts]]

    def _duration(self, clip: Clip) -> float:
        duration = self._reference_motions[clip].frames / self.evaluator.fps
        return round(float(min(max(duration, self._shortest), self.longest)), 2)

    def _long_enough(self) -> dict[str, list[Clip]]:
        """Return, for each action, the clips that contain a window, or those of all actions if it has none."""
        long = [clip for clip, motion in self._reference_motions.items() if len(motion) >= self.window]
        if not long:
            longest = max(len(motion) for motion in self._reference_motions.values())
            raise CacheError(f"no test clip is as long as a window of {self.window} frames; the longest has {longest}")
        return {content: [clip for clip in long if clip.content == content] or long for content in self._contents}

    def _measure_motions(self, motions: Sequence[Motion]) -> Measurements:
        pieces = pieces_of(self._timelines, motions, self.evaluator, self.window)
        segments = tuple(segment for composition in self.compositions for segment in composition)
        return self._measurements(segments, *pieces)

    def _measure_clips(self, compositions: Sequence[Sequence[Segment]], rng: np.random.Generator) -> Measurements:
        """Measure the clips of the segments, and for each transition a random window in a clip of its second action."""
        segments = tuple(segment for composition in compositions for segment in composition)
        longest = int(self.longest * self.evaluator.fps)
        features = {clip: self.evaluator.features(motion) for clip, motion in self._reference_motions.items()}
        crops = [features[segment.clip][:longest] for segment in segments]
        windows, jerks = [], []
        for segment in (segment for composition in compositions for segment in composition[1:]):
            clip = _choice(self._long[segment.clip.content], rng)
            start = int(rng.integers(len(self._reference_motions[clip]) - self.window + 1))
            end = start + self.window
            windows.append(features[clip][start:end])
            jerks.append(window_jerk(self._reference_motions[clip].trimmed(start, end), self.window))
        return self._measurements(segments, crops, windows, jerks)

    def _measurements(
        self, segments: tuple[Segment, ...], crops: Sequence[Tensor], windows: Sequence[Tensor], jerks: Sequence[Tensor]
    ) -> Measurements:
        distinct = {text: row for row, text in enumerate(dict.fromkeys(segment.text for segment in segments))}
        texts = self.evaluator.texts(list(distinct))[[distinct[segment.text] for segment in segments]]
        of_texts, of_crops, of_windows = (
            F.normalize(embeddings, dim=-1)
            for embeddings in (texts, self.evaluator.motions(crops), self.evaluator.motions(windows))
        )
        return Measurements(segments, of_texts, of_crops, of_windows, torch.stack(list(jerks)))

    def _scores(self, measurements: Measurements, seed: int) -> Scores:
        true, everything = self._describes(measurements.segments), np.arange(len(self.compositions))
        draws = draw_metrics(len(everything), lambda units: self._score_some(measurements, true, units, seed).metrics)
        return self._score_some(measurements, true, everything, seed)._replace(resampled=draws)

    def _score_some(
        self, measurements: Measurements, true: Bool[Tensor, "segments segments"], units: Units, seed: int
    ) -> Scores:
        """Compute the scores of some of the compositions. `true` is the result of `_describes`."""
        real, segments = self._reference, len(self.compositions[0])
        owners, changes = (np.repeat(np.arange(len(self.compositions)), rows) for rows in (segments, segments - 1))
        rows = Rows(measurements.texts, owners.tolist()).numbers(units)
        windows, jerks = (
            Rows(values, changes.tolist()).of(units) for values in (measurements.windows, measurements.jerks)
        )
        order = rows[torch.from_numpy(np.random.default_rng(seed).permutation(len(rows)))]
        texts, motions = measurements.texts[order], measurements.subsequences[order]
        metrics = {
            "r_precision": r_precision(texts, motions, true[order][:, order])[2],
            "subsequence_fid": fid(motions, real.subsequences),
            "subsequence_diversity": embedding_diversity(motions, len(motions), seed),
            "mm_dist": matching_score(texts, motions),
            "transition_fid": fid(windows, real.windows),
            "transition_diversity": embedding_diversity(windows, len(windows), seed),
        }
        return Scores(metrics).with_jerk(jerks, float(real.jerks.mean()))

    def _describes(self, segments: Sequence[Segment]) -> Bool[Tensor, "segments segments"]:
        """Return whether each segment's text describes each segment's clip."""
        return torch.tensor([[one.text in self._sentences[other.clip.texts] for other in segments] for one in segments])


def _contents(cache: Cache, min_clips: int, cyclic: bool) -> dict[str, list[Clip]]:
    """Return the test clips of each action with enough clips, sorted by name."""
    test = [clip for clip in cache.clips if clip.split == "test" and not clip.mirrored and any(cache.texts[clip.texts])]
    clips_of: dict[str, list[Clip]] = {}
    for clip in sorted(test, key=lambda clip: (clip.content, clip.name)):
        if clip.cyclic or not cyclic:
            clips_of.setdefault(clip.content, []).append(clip)
    enough = {content: clips for content, clips in clips_of.items() if len(clips) >= min_clips}
    if len(enough) < 2:
        kind = "cyclic " if cyclic else ""
        counts = ", ".join(f"{content} ({len(clips)})" for content, clips in clips_of.items()) or "none"
        raise CacheError(
            f"the test split needs two {kind}actions with at least {min_clips} unmirrored clips with texts; it has "
            f"{counts}; prepare more data or lower `min_clips`"
        )
    return enough


def _reference_motions(
    cache: Cache, representation: Representation, fps: float | int, contents: dict[str, list[Clip]]
) -> dict[Clip, Motion]:
    if cache.features.shape[1] != representation.width:
        raise CacheError(
            f"the cache has {cache.features.shape[1]} features, but the representation has {representation.width}"
        )
    reference_motions = {}
    for clip in (clip for clips in contents.values() for clip in clips):
        motion = representation.decode(cache.features[clip.start : clip.end], cache.fps, cache.skeleton)
        reference_motions[clip] = motion.resampled(fps)
    check_joints([motion.joints for motion in reference_motions.values()])
    return reference_motions


def _choice(items: Sequence, rng: np.random.Generator):
    return items[int(rng.integers(len(items)))]
