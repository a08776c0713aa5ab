"""FlowMDM's own evaluation (Barquero et al. 2024, section 4.1): its published lists of compositions, judged by the
evaluator of Guo et al.

Knows lists of texts with their frames, real motion to compare with and an evaluator of tagged captions; knows no model,
and no network.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cached_property
from itertools import accumulate, pairwise
from typing import Protocol, runtime_checkable

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from stmc.data.sources.babel.composition_lists import Composition, sample_compositions
from stmc.data.sources.babel.composition_references import References
from stmc.evaluation.benchmarks.benchmark_protocol import Scores, TextEvaluator
from stmc.evaluation.benchmarks.pieces import pieces_of
from stmc.evaluation.metrics.matching_metrics import (
    POOL_SIZE,
    embedding_diversity,
    matching_score,
    r_precision_of_distinct,
)
from stmc.evaluation.metrics.realism import frechet_distance
from stmc.evaluation.metrics.smoothness import window_jerk
from stmc.motion.motion import Motion
from stmc.motion.representation import JointsFrom, Representation
from stmc.timeline import Prompt, Timeline
from stmc.timeline.timeline_files import moment


@runtime_checkable
class FeatureEvaluator(TextEvaluator, Protocol):
    """A `TextEvaluator` whose features are those of a representation, as `evaluators.MatchingEvaluator` is."""

    @property
    def representation(self) -> Representation: ...


class PublishedCompositions:
    """A `Benchmark` of `compositions`, whose frames are at the evaluator's rate (None: 32 of 32 texts, drawn from the
    clips of `references`). `evaluator` embeds features and captions that `tags` made of texts, compared by Euclidean
    distance.

    Transitions are as many frames as the windows of `references`. AUJ is measured from `average_jerk`, in m/frame³
    (None: the mean of these windows). Diversity is that of `diversity_pairs` pairs. Where every composition says one
    text again and again (the paper's extrapolation) no text could be told from others: neither R-precision nor MM-Dist
    is measured. Raises `ValueError` for too little to be compared, and for a text shorter than half of a window.
    """

    def __init__(
        self,
        references: References,
        evaluator: FeatureEvaluator,
        tags: Callable[[Sequence[str]], list[str]],
        compositions: Sequence[Composition] | None = None,
        average_jerk: float | None = None,
        diversity_pairs: int = 300,
        joints_from: JointsFrom = "features",
    ) -> None:
        self.evaluator, self.joints_from, self._references, self._tags = evaluator, joints_from, references, tags
        self.compositions = sample_compositions(references.clips) if compositions is None else list(compositions)
        self.window, self._compared = references.windows.shape[1], diversity_pairs
        self._average_jerk = average_jerk
        texts = sum(len(each.texts) for each in self.compositions)
        few = min(texts - len(self.compositions), len(references.clips), len(references.windows))
        if min(texts, len(references.clips)) < POOL_SIZE or few < diversity_pairs:
            raise ValueError(
                f"{texts} texts in {len(self.compositions)} compositions, {len(references.clips)} real clips and "
                f"{len(references.windows)} windows: {POOL_SIZE} make a pool, {diversity_pairs} pairs are compared"
            )
        shortest = min(length for each in self.compositions for length in each.lengths)
        if 2 * shortest < self.window:
            raise ValueError(f"a text of {shortest} frames is shorter than half of a window of {self.window}")

    def timelines(self, method: str) -> list[Timeline]:
        """The same for every method: one track of prompts that claim the whole body."""
        return list(self._timelines)

    def measured(self, method: str, motions: Sequence[Motion], seed: int) -> Scores:
        """The scores of FlowMDM's tables, and the curve "jerk". R-precision is among the texts of one composition after
        the other, 32 at a time, of which those that repeat an earlier one are left out, as published. `seed`: of the
        pairs of diversity. Raises `ValueError` unless there is a motion for each timeline, about as long."""
        subsequences, windows, jerks = pieces_of(self._timelines, motions, self.evaluator, self.window)
        texts = [text for each in self.compositions for text in each.texts]
        embedded = self.evaluator.motions(subsequences), self.evaluator.motions(windows)
        extrapolated = all(len(set(each.texts)) == 1 for each in self.compositions)
        return self._scores([] if extrapolated else texts, *embedded, torch.stack(jerks), seed)

    def real(self, seed: int) -> Scores:
        """Of the real clips themselves, in an order and with captions that are drawn with `seed`; they are what FID
        compares with, so that it is 0, as in the paper's tables."""
        rng, clips = np.random.default_rng(seed), self._references.clips
        order = rng.permutation(len(clips))
        texts = [clips[index].captions[int(rng.integers(len(clips[index].captions)))].text for index in order]
        motions, windows = self._real
        return self._scores(texts, motions[torch.from_numpy(order)], windows, self._real_jerks, seed)

    @cached_property
    def _timelines(self) -> list[Timeline]:
        timelines = []
        for each in self.compositions:
            edges = [moment(frame, self.evaluator.fps) for frame in accumulate(each.lengths, initial=0)]
            prompts = [Prompt(text, *span) for text, span in zip(each.texts, pairwise(edges), strict=True)]
            timelines.append(Timeline(prompts, each.name))
        return timelines

    @cached_property
    def _real(self) -> tuple[Float[Tensor, "clips width"], Float[Tensor, "windows width"]]:
        clips = self.evaluator.motions([clip.features for clip in self._references.clips])
        return clips, self.evaluator.motions(list(self._references.windows))

    @cached_property
    def _real_jerks(self) -> Float[Tensor, "windows frames"]:
        decode, fps = self.evaluator.representation.decode, self.evaluator.fps
        return torch.stack([window_jerk(decode(rows, fps), self.window).float() for rows in self._references.windows])

    def _scores(
        self,
        texts: Sequence[str],
        motions: Float[Tensor, "motions width"],
        windows: Float[Tensor, "windows width"],
        jerks: Float[Tensor, "windows frames"],
        seed: int,
    ) -> Scores:
        real, real_windows = self._real
        metrics = {} if not texts else self._matching(texts, motions)
        metrics |= {
            "subsequence_fid": frechet_distance(motions, real),
            "subsequence_diversity": embedding_diversity(motions, self._compared, seed),
            "transition_fid": frechet_distance(windows, real_windows),
            "transition_diversity": embedding_diversity(windows, self._compared, seed),
        }
        average = float(self._real_jerks.mean()) if self._average_jerk is None else self._average_jerk
        return Scores(metrics).with_jerk(jerks, average)

    def _matching(self, texts: Sequence[str], motions: Float[Tensor, "motions width"]) -> dict[str, float]:
        distinct = {text: row for row, text in enumerate(dict.fromkeys(texts))}
        embedded = self.evaluator.texts(self._tags(list(distinct)))[[distinct[text] for text in texts]]
        found = r_precision_of_distinct(embedded, motions, texts)
        return {"r_precision": found[-1], "mm_dist": matching_score(embedded, motions)}
