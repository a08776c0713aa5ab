"""FlowMDM's own evaluation: its published lists of compositions, with the evaluator of Guo et al.

See Barquero et al. (2024), section 4.1. Depends on lists of texts with their frames, real motion for comparison and an
evaluator of tagged captions; independent of models and networks.
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
    """A `Benchmark` of published compositions, compared by Euclidean distance of embeddings.

    Transitions have the length of the windows of `references`. If every composition repeats one text (the paper's
    extrapolation), texts cannot be distinguished, and neither R-precision nor MM-Dist is measured.

    Args:
        references: Real clips and windows.
        evaluator: Embeds features and tagged captions.
        tags: Converts texts to tagged captions.
        compositions: Compositions with lengths in frames at the evaluator's frame rate; None draws 32 of 32 texts from
            the clips of `references`.
        average_jerk: Jerk in m/frame³ from which AUJ is measured; None uses the mean of the windows of `references`.
        diversity_pairs: Number of pairs for diversity.
        joints_from: Source of the measured joints.

    Raises:
        ValueError: If there is too little to compare, or a text is shorter than half a window.
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
        texts = sum(len(composition.texts) for composition in self.compositions)
        fewest = min(texts - len(self.compositions), len(references.clips), len(references.windows))
        if min(texts, len(references.clips)) < POOL_SIZE or fewest < diversity_pairs:
            raise ValueError(
                f"{texts} texts in {len(self.compositions)} compositions, {len(references.clips)} real clips and "
                f"{len(references.windows)} windows are too few for a pool of {POOL_SIZE} and {diversity_pairs} pairs"
            )
        shortest = min(length for composition in self.compositions for length in composition.lengths)
        if 2 * shortest < self.window:
            raise ValueError(f"a text of {shortest} frames is shorter than half of a window of {self.window}")

    def timelines(self, method: str) -> list[Timeline]:
        """Return the timelines, the same for every method: one track of prompts that claim the whole body."""
        return list(self._timelines)

    def measured(self, method: str, motions: Sequence[Motion], seed: int) -> Scores:
        """Compute the scores of FlowMDM's tables, and the curve "jerk".

        R-precision compares the texts of consecutive compositions, 32 at a time, without those that repeat an earlier
        one, as published.

        Args:
            method: Ignored.
            motions: One motion per timeline.
            seed: Seed of the pairs of diversity.

        Raises:
            ValueError: Unless there is one motion of about the right length per timeline.
        """
        subsequences, windows, jerks = pieces_of(self._timelines, motions, self.evaluator, self.window)
        texts = [text for composition in self.compositions for text in composition.texts]
        embedded = self.evaluator.motions(subsequences), self.evaluator.motions(windows)
        extrapolated = all(len(set(composition.texts)) == 1 for composition in self.compositions)
        return self._scores([] if extrapolated else texts, *embedded, torch.stack(jerks), seed)

    def real(self, seed: int) -> Scores:
        """Compute the scores of the real clips, in an order and with captions drawn with `seed`.

        FID compares with the same clips, and is 0, as in the paper's tables.
        """
        rng, clips = np.random.default_rng(seed), self._references.clips
        order = rng.permutation(len(clips))
        texts = [clips[index].captions[int(rng.integers(len(clips[index].captions)))].text for index in order]
        motions, windows = self._real
        return self._scores(texts, motions[torch.from_numpy(order)], windows, self._real_jerks, seed)

    @cached_property
    def _timelines(self) -> list[Timeline]:
        timelines = []
        for composition in self.compositions:
            edges = [moment(frame, self.evaluator.fps) for frame in accumulate(composition.lengths, initial=0)]
            prompts = [Prompt(text, *span) for text, span in zip(composition.texts, pairwise(edges), strict=True)]
            timelines.append(Timeline(prompts, composition.name))
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
        recalls = r_precision_of_distinct(embedded, motions, texts)
        return {"r_precision": recalls[-1], "mm_dist": matching_score(embedded, motions)}
