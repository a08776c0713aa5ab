"""The benchmark of compositions in time (Barquero et al. 2024, section 4.1): many actions one after the other, of which
every subsequence and every transition is measured by itself.

Knows a prepared data set's test clips, their sentences and an evaluator; what is asked is drawn from them, and what
comes is compared with them. Knows no model.
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
from stmc.evaluation.benchmarks.resampling import Rows, Units, resampled
from stmc.evaluation.metrics.matching_metrics import POOL_SIZE, embedding_diversity, matching_score, r_precision
from stmc.evaluation.metrics.plausibility import check_joints
from stmc.evaluation.metrics.realism import fid
from stmc.evaluation.metrics.smoothness import HUMANML3D_WINDOW, window_jerk
from stmc.motion.motion import Motion
from stmc.motion.representation import JointsFrom, Representation
from stmc.timeline import Prompt, Timeline

ASKED, REFERENCE, REAL = range(3)
"""What a seed is used for; each has a random stream of its own."""


@dataclass(frozen=True)
class Segment:
    """A sentence, and a real clip that it is true of; asked for during `seconds`."""

    text: str
    clip: Clip
    seconds: float


@dataclass(frozen=True, eq=False)
class Measurements:
    """What is measured of motions, made or real: the latents, of length 1, of the segments' texts and of their
    subsequences; and of windows of transitions the latents and the jerk of each frame."""

    segments: tuple[Segment, ...]
    texts: Float[Tensor, "segments width"]
    subsequences: Float[Tensor, "segments width"]
    windows: Float[Tensor, "windows width"]
    jerks: Float[Tensor, "windows frames"]


class Compositions:
    """A `Benchmark`: `count` compositions of `segments` pairs of a sentence and a duration, drawn with `seed` from the
    test clips of `cache`, those that are not mirrored.

    Each content that has `min_clips` such clips is drawn as often as any other, however many there are; a segment lasts
    as long as its clip, but `shortest` to `longest` seconds. Each action that is drawn stays for `repeats` segments;
    where that is more than one, only cyclic contents are drawn: `repeats=segments` is FlowMDM's extrapolation. A
    transition is a `window` of frames, at the evaluator's frame rate, around the first frame of each segment but the
    first.

    `representation` is that of the cache's features. Latents are compared at length 1, as TMR does.

    Raises `CacheError` for a test split that holds too little, `ImplausibleMotion` where its motions are not people's,
    and `ValueError` for numbers that are invalid.
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
        self._said = {key: dict(rows) for key, rows in cache.texts.items()}
        self._contents = _contents(cache, min_clips, cyclic=repeats > 1)
        self._reference_motions = _reference_motions(cache, representation, evaluator.fps, self._contents)
        self._long = self._long_enough()
        chance = np.random.default_rng([seed, ASKED])
        self.compositions = [self._composition(segments, chance) for _ in range(count)]

    def timelines(self, method: str) -> list[Timeline]:
        """The same for every method: one track of prompts that claim the whole body."""
        return list(self._timelines)

    def measured(self, method: str, motions: Sequence[Motion], seed: int) -> Scores:
        """The scores of FlowMDM's tables, and the curve "jerk": its mean over the transitions in each frame.

        R-precision looks for each text's own motion, in batches of 32 drawn with `seed`, among those of other texts;
        motions of clips that the text is true of, too, are left out (contents repeat, and it is no mistake to find
        them; that one of them is found is no merit of the motion either). FID compares subsequences with the very clips
        that were drawn, and each transition has a window of a real clip of its second content to be compared with. The
        mean jerk of these windows is what the area under the jerk is measured from; each window is turned to begin with
        heading zero. Raises `ValueError` unless there is a motion for each timeline, about as long.
        """
        return self._scores(self._of_motions(motions), seed)

    def real(self, seed: int) -> Scores:
        """Of other clips that the same sentences are true of, and of other windows: the least FID that can be hoped
        for. Of a sentence that few clips show, some are the same."""
        chance = np.random.default_rng([seed, REAL])
        drawn = [
            tuple(replace(segment, clip=_choice(self._shown_by(segment.text), chance)) for segment in composition)
            for composition in self.compositions
        ]
        return self._scores(self._of_clips(drawn, chance), seed)

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
        return self._of_clips(self.compositions, np.random.default_rng([self._seed, REFERENCE]))

    def _composition(self, segments: int, chance: np.random.Generator) -> tuple[Segment, ...]:
        """For each action a content, one of its clips and one of the clip's sentences; the other segments of the action
        have clips of their own, of those that the sentence is true of."""
        drawn: list[Segment] = []
        while len(drawn) < segments:
            clip = _choice(_choice(list(self._contents.values()), chance), chance)
            shares = np.array(list(self._said[clip.texts].values()))
            text = list(self._said[clip.texts])[int(chance.choice(len(shares), p=shares / shares.sum()))]
            shown = [clip, *(_choice(self._shown_by(text), chance) for _ in range(self._repeats - 1))]
            drawn += [Segment(text, each, self._lasting(each)) for each in shown[: segments - len(drawn)]]
        return tuple(drawn)

    def _shown_by(self, text: str) -> list[Clip]:
        return [clip for clips in self._contents.values() for clip in clips if text in self._said[clip.texts]]

    def _lasting(self, clip: Clip) -> float:
        duration = self._reference_motions[clip].frames / self.evaluator.fps
        return round(float(min(max(duration, self._shortest), self.longest)), 2)

    def _long_enough(self) -> dict[str, list[Clip]]:
        """For each content the clips that hold a window, of all contents where it has none."""
        long = [clip for clip, motion in self._reference_motions.items() if len(motion) >= self.window]
        if not long:
            longest = max(len(motion) for motion in self._reference_motions.values())
            raise CacheError(f"no test clip is as long as a window of {self.window} frames; the longest has {longest}")
        return {content: [clip for clip in long if clip.content == content] or long for content in self._contents}

    def _of_motions(self, motions: Sequence[Motion]) -> Measurements:
        pieces = pieces_of(self._timelines, motions, self.evaluator, self.window)
        segments = tuple(segment for composition in self.compositions for segment in composition)
        return self._measurements(segments, *pieces)

    def _of_clips(self, compositions: Sequence[Sequence[Segment]], chance: np.random.Generator) -> Measurements:
        """The clips of the segments as subsequences, and for each transition a window from anywhere in a clip of the
        content that it leads to."""
        segments = tuple(segment for composition in compositions for segment in composition)
        longest = int(self.longest * self.evaluator.fps)
        features = {clip: self.evaluator.features(motion) for clip, motion in self._reference_motions.items()}
        crops = [features[segment.clip][:longest] for segment in segments]
        windows, jerks = [], []
        for segment in (segment for composition in compositions for segment in composition[1:]):
            clip = _choice(self._long[segment.clip.content], chance)
            start = int(chance.integers(len(self._reference_motions[clip]) - self.window + 1))
            end = start + self.window
            windows.append(features[clip][start:end])
            jerks.append(window_jerk(self._reference_motions[clip].trimmed(start, end), self.window))
        return self._measurements(segments, crops, windows, jerks)

    def _measurements(
        self,
        segments: tuple[Segment, ...],
        crops: Sequence[Tensor],
        windows: Sequence[Tensor],
        jerks: Sequence[Tensor],
    ) -> Measurements:
        distinct = {text: row for row, text in enumerate(dict.fromkeys(segment.text for segment in segments))}
        texts = self.evaluator.texts(list(distinct))[[distinct[segment.text] for segment in segments]]
        latents = (
            F.normalize(each, dim=-1)
            for each in (texts, self.evaluator.motions(crops), self.evaluator.motions(windows))
        )
        return Measurements(segments, *latents, torch.stack(list(jerks)))

    def _scores(self, measurements: Measurements, seed: int) -> Scores:
        true, everything = self._true(measurements.segments), np.arange(len(self.compositions))
        again = resampled(len(everything), lambda units: self._of_some(measurements, true, units, seed).metrics)
        return self._of_some(measurements, true, everything, seed)._replace(resampled=again)

    def _of_some(
        self, measurements: Measurements, true: Bool[Tensor, "segments segments"], units: Units, seed: int
    ) -> Scores:
        """The scores of some of the compositions. `true`: see `_true`."""
        real, segments = self._reference, len(self.compositions[0])
        owners, changes = (np.repeat(np.arange(len(self.compositions)), each) for each in (segments, segments - 1))
        chosen = Rows(measurements.texts, owners.tolist()).numbers(units)
        windows, jerks = (Rows(each, changes.tolist()).of(units) for each in (measurements.windows, measurements.jerks))
        order = chosen[torch.from_numpy(np.random.default_rng(seed).permutation(len(chosen)))]
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

    def _true(self, segments: Sequence[Segment]) -> Bool[Tensor, "segments segments"]:
        """Of which segments' clips the text of each segment is true."""
        return torch.tensor([[one.text in self._said[other.clip.texts] for other in segments] for one in segments])


def _contents(cache: Cache, min_clips: int, cyclic: bool) -> dict[str, list[Clip]]:
    """The test clips of each content that has enough, in order of their names."""
    test = [clip for clip in cache.clips if clip.split == "test" and not clip.mirrored and any(cache.texts[clip.texts])]
    found: dict[str, list[Clip]] = {}
    for clip in sorted(test, key=lambda clip: (clip.content, clip.name)):
        if clip.cyclic or not cyclic:
            found.setdefault(clip.content, []).append(clip)
    enough = {content: clips for content, clips in found.items() if len(clips) >= min_clips}
    if len(enough) < 2:
        kind = "cyclic " if cyclic else ""
        counts = ", ".join(f"{content} ({len(clips)})" for content, clips in found.items()) or "none"
        raise CacheError(
            f"the test split needs two {kind}contents of at least {min_clips} clips with texts, not mirrored; it has "
            f"{counts}: prepare more data, or lower `min_clips`"
        )
    return enough


def _reference_motions(
    cache: Cache, representation: Representation, fps: float | int, contents: dict[str, list[Clip]]
) -> dict[Clip, Motion]:
    if cache.features.shape[1] != representation.width:
        raise CacheError(f"the cache has {cache.features.shape[1]} features, the representation {representation.width}")
    reference_motions = {}
    for clip in (clip for clips in contents.values() for clip in clips):
        motion = representation.decode(cache.features[clip.start : clip.end], cache.fps, cache.skeleton)
        reference_motions[clip] = motion.resampled(fps)
    check_joints([motion.joints for motion in reference_motions.values()])
    return reference_motions


def _choice(items: Sequence, chance: np.random.Generator):
    return items[int(chance.integers(len(items)))]
