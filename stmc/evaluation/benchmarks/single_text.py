"""HumanML3D's benchmark of single texts: one motion per clip of the test split, with the evaluator of Guo et al.

See Guo et al. (2022) and STMC, appendix D. Motions are as long as their clips. Depends on clips with captions and an
evaluator of tagged captions; independent of models and networks.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from stmc.data.sources.humanml3d.humanml3d_clips import CaptionedClip
from stmc.data.sources.humanml3d.humanml3d_texts import Caption
from stmc.evaluation.benchmarks.benchmark_protocol import Scores, TextEvaluator
from stmc.evaluation.metrics.matching_metrics import (
    POOL_SIZE,
    TOP,
    embedding_diversity,
    matching_score,
    multimodality,
    r_precision,
)
from stmc.evaluation.metrics.plausibility import check_joints
from stmc.evaluation.metrics.realism import frechet_distance
from stmc.motion.motion import Motion
from stmc.motion.representation import JointsFrom
from stmc.timeline import Prompt, Timeline

UNIT = 4
"""Number of frames of a movement; motions are whole numbers of movements."""
SHORTER = 1 / 3
"""Fraction of the motions that are one movement shorter than their clips."""
REQUESTED, REFERENCE, REAL = range(3)
"""Uses of a seed; each has its own random stream."""


@dataclass(frozen=True, eq=False)
class Request:
    """A caption of a clip, and some of the clip's frames, whose number is the requested length."""

    caption: Caption
    features: Float[Tensor, "frames 263"]


class SingleText:
    """A `Benchmark` of captions, compared by Euclidean distance of embeddings.

    For each clip one of its captions is drawn, and its length: the whole movements of four frames in the clip or, in a
    third of the cases, one less. The benchmark follows the published one with one exception: captions and lengths are
    drawn once, not for each repetition.

    Args:
        clips: Clips with captions.
        evaluator: Embeds features and tagged captions, as `evaluators.MatchingEvaluator` does.
        first: Number of clips, drawn with `seed`; None uses all.
        texts: Number of texts for multimodality; 0 omits it.
        samples: Number of motions of each of these texts.
        pairs: Number of pairs for multimodality.
        diversity_pairs: Number of pairs for diversity.
        seed: Seed of the draw.
        joints_from: Source of the measured joints; see `Model.decode`.

    Raises:
        ValueError: If there are fewer clips than a pool, or too few to compare.
    """

    def __init__(
        self,
        clips: Sequence[CaptionedClip],
        evaluator: TextEvaluator,
        first: int | None = None,
        texts: int = 100,
        samples: int = 30,
        pairs: int = 10,
        diversity_pairs: int = 300,
        seed: int = 0,
        joints_from: JointsFrom = "features",
    ) -> None:
        self.evaluator, self.joints_from, self._clips = evaluator, joints_from, clips
        rng = np.random.default_rng([seed, REQUESTED])
        indices = rng.permutation(len(clips))[:first].tolist()
        self.requests = [_request(clips[index], rng) for index in indices]
        self._texts, self._samples, self._pairs, self._compared = texts, samples, pairs, diversity_pairs
        too_few = _whole_pools(self.requests) < max(POOL_SIZE, diversity_pairs)
        if too_few or texts > len(self.requests) or (texts and samples < pairs):
            raise ValueError(
                f"{len(self.requests)} clips are too few for a pool of {POOL_SIZE}, {diversity_pairs} pairs, and "
                f"{texts} texts with {samples} samples and {pairs} pairs each"
            )

    def timelines(self, method: str) -> list[Timeline]:
        """Return the timelines, the same for every method: one prompt per clip, then the repeated ones."""
        repeated = self.requests[: self._texts] * (self._samples - 1)
        return [
            Timeline((Prompt(request.caption.text, 0.0, len(request.features) / self.evaluator.fps),))
            for request in [*self.requests, *repeated]
        ]

    def measured(self, method: str, motions: Sequence[Motion], seed: int) -> Scores:
        """Compute the scores of the usual tables.

        R-precision is among 32 motions in an order drawn with `seed`; an incomplete last batch is ignored. FID compares
        with the clips' real motion, drawn again with `seed`.

        Args:
            method: Ignored.
            motions: One motion per timeline.
            seed: Seed of the draws.

        Raises:
            ValueError: Unless there is one motion per timeline.
        """
        count = len(self.requests)
        if len(motions) != len(self.timelines(method)):
            raise ValueError(
                f"{len(motions)} motions for {len(self.timelines(method))} timelines; pass one motion per timeline"
            )
        check_joints([motion.joints for motion in motions])
        embedded = self.evaluator.motions([self.evaluator.features(motion) for motion in motions])
        metrics = self._scores(self.requests, embedded[:count], seed)
        if self._texts:
            repeated = embedded[count:].unflatten(0, (self._samples - 1, self._texts))
            samples = torch.cat([embedded[None, : self._texts], repeated]).transpose(0, 1)
            metrics["multimodality"] = multimodality(samples, self._pairs, seed)
        return Scores(metrics)

    def real(self, seed: int) -> Scores:
        """Compute the scores of the clips themselves, with other captions and frames than FID uses."""
        requests = self._real(seed, REAL)
        return Scores(self._scores(requests, self.evaluator.motions([request.features for request in requests]), seed))

    def _real(self, seed: int, use: int) -> list[Request]:
        rng = np.random.default_rng([seed, use])
        return [_request(clip, rng) for clip in self._clips]

    def _scores(self, requests: Sequence[Request], motions: Float[Tensor, "_ width"], seed: int) -> dict[str, float]:
        order = np.random.default_rng(seed).permutation(len(requests))[: _whole_pools(requests)].tolist()
        motions = motions[order]
        texts = self.evaluator.texts([requests[index].caption.tagged for index in order])
        real = self.evaluator.motions([request.features for request in self._real(seed, REFERENCE)])
        recalls = {f"r_precision_{top}": recall for top, recall in zip(TOP, r_precision(texts, motions), strict=True)}
        return recalls | {
            "motion_fid": frechet_distance(motions, real),
            "mm_dist": matching_score(texts, motions),
            "diversity": embedding_diversity(motions, self._compared, seed),
        }


def _request(clip: CaptionedClip, rng: np.random.Generator) -> Request:
    caption = clip.captions[int(rng.integers(len(clip.captions)))]
    movements = len(clip.features) // UNIT - int(rng.random() < SHORTER)
    start = int(rng.integers(len(clip.features) - movements * UNIT + 1))
    return Request(caption, clip.features[start : start + movements * UNIT])


def _whole_pools(requests: Sequence[Request]) -> int:
    return len(requests) // POOL_SIZE * POOL_SIZE
