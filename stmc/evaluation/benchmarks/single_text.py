"""HumanML3D's benchmark of single texts (Guo et al. 2022; STMC, appendix D): one motion for each clip of the test
split, as long as the clip, judged by the evaluator of Guo et al.

Knows clips with captions and an evaluator of tagged captions; knows no model, and no network.
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
"""Frames of a movement: motions are whole numbers of them."""

SHORTER = 1 / 3
"""The share of the motions that are one movement shorter than their clips."""

ASKED, REFERENCE, REAL = range(3)
"""What a seed is used for; each has a random stream of its own."""


@dataclass(frozen=True, eq=False)
class Request:
    """A clip's caption, and some of the clip's frames, as many as are asked for."""

    caption: Caption
    features: Float[Tensor, "frames 263"]


class SingleText:
    """A `Benchmark` of the captions of `clips`. `evaluator` embeds features and tagged captions, and compares them by
    Euclidean distance, as `evaluators.MatchingEvaluator` does.

    Of each clip (`first`: of so many, drawn with `seed`; None: all) one of its captions is drawn, and its length: the
    whole movements of four frames in it, or in a third of the cases one less. The first `texts` of them are asked for
    `samples` times in all, for multimodality (0: it is not measured). `joints_from` as of `Model.decode`.

    As published but for one thing: captions and lengths of what is asked are drawn once, not for each repetition anew.
    Raises `ValueError` for less clips than a pool, or less than are to be compared.
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
        rng = np.random.default_rng([seed, ASKED])
        chosen = rng.permutation(len(clips))[:first].tolist()
        self.requests = [_request(clips[index], rng) for index in chosen]
        self._texts, self._samples, self._pairs, self._compared = texts, samples, pairs, diversity_pairs
        few = _whole_pools(self.requests) < max(POOL_SIZE, diversity_pairs)
        if few or texts > len(self.requests) or (texts and samples < pairs):
            raise ValueError(
                f"{len(self.requests)} clips: {POOL_SIZE} make a pool, {diversity_pairs} pairs are compared, and "
                f"{texts} texts are asked for {samples} times, of which {pairs} pairs are compared"
            )

    def timelines(self, method: str) -> list[Timeline]:
        """The same for every method: a prompt each for the whole body; then those that are asked for again."""
        again = self.requests[: self._texts] * (self._samples - 1)
        return [
            Timeline((Prompt(each.caption.text, 0.0, len(each.features) / self.evaluator.fps),))
            for each in [*self.requests, *again]
        ]

    def measured(self, method: str, motions: Sequence[Motion], seed: int) -> Scores:
        """The scores of the field's tables. R-precision is among 32 motions in an order drawn with `seed`; what is left
        over is not looked at. FID compares with the clips' real motion, drawn anew with `seed`.

        Raises `ValueError` unless there is a motion for each timeline.
        """
        count = len(self.requests)
        if len(motions) != len(self.timelines(method)):
            raise ValueError(f"{len(motions)} motions for {len(self.timelines(method))} timelines")
        check_joints([motion.joints for motion in motions])
        embedded = self.evaluator.motions([self.evaluator.features(motion) for motion in motions])
        metrics = self._scores(self.requests, embedded[:count], seed)
        if self._texts:
            again = embedded[count:].unflatten(0, (self._samples - 1, self._texts))
            samples = torch.cat([embedded[None, : self._texts], again]).transpose(0, 1)
            metrics["multimodality"] = multimodality(samples, self._pairs, seed)
        return Scores(metrics)

    def real(self, seed: int) -> Scores:
        """Of the clips themselves, other captions and frames of them than those that FID compares with."""
        requests = self._real(seed, REAL)
        return Scores(self._scores(requests, self.evaluator.motions([each.features for each in requests]), seed))

    def _real(self, seed: int, use: int) -> list[Request]:
        rng = np.random.default_rng([seed, use])
        return [_request(clip, rng) for clip in self._clips]

    def _scores(self, requests: Sequence[Request], motions: Float[Tensor, "_ width"], seed: int) -> dict[str, float]:
        order = np.random.default_rng(seed).permutation(len(requests))[: _whole_pools(requests)].tolist()
        motions = motions[order]
        texts = self.evaluator.texts([requests[index].caption.tagged for index in order])
        real = self.evaluator.motions([each.features for each in self._real(seed, REFERENCE)])
        found = {f"r_precision_{top}": share for top, share in zip(TOP, r_precision(texts, motions), strict=True)}
        return found | {
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
