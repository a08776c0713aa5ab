"""Batches for what tells pairs of motion and text from non-pairs: which texts are true of which motions of a batch.

Knows plans of batches and the sentences of its clips; knows no network and no loss.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor

from stmc.text import TextEncoder
from stmc.training import Pairs
from stmc.training.data.batches import ClipBatches
from stmc.training.data.dataset import BatchPlan


class PairBatches:
    """`batches(step, process)`: those of a `ClipBatches`, every row with a text, and what else each text is true of.

    A text is true of all clips that have it among their sentences; of a composition's motion, what is true of either
    clip, and half of the compositions have the text of the `other` clip: both are to be heard. With an encoder of whole
    `sentences`, texts that it finds `similar` by more than `threshold` are taken to be true of each other's motions,
    too: the filter of TMR, for data where one clip's sentences are not another's.

    Raises `ValueError` for a recipe that leaves rows without a text, or with several.
    """

    def __init__(
        self, batches: ClipBatches, sentences: TextEncoder | None = None, threshold: float | int = 0.8
    ) -> None:
        batches.recipe.check_pairs()
        dataset = batches.dataset
        self.batches, self.threshold = batches, threshold
        keys = {key: column for column, key in enumerate(dataset.choices)}
        self._true = np.zeros((len(dataset.sentences), len(keys) + 1), dtype=bool)  # the last column: of no sentence
        for key, (places, _) in dataset.choices.items():
            self._true[places, keys[key]] = True
        self._key = np.array([keys.get(clip.texts, len(keys)) for clip in dataset.clips])
        self._embedded = None if sentences is None else sentences.encode(dataset.sentences)[0][:, 0].float()

    def __call__(self, step: int, process: int = 0) -> list[Pairs]:
        dataset, pieces = self.batches.dataset, []
        rng = np.random.default_rng([self.batches.seed, step, process])
        for plan in self.batches.plans(step, process):
            swapped = rng.random(len(plan.sentence)) < 0.5
            texts = plan.sentence, plan.other
            plan = replace(plan, sentence=np.where(swapped, *texts[::-1]), other=np.where(swapped, *texts))
            batch = dataset.batch(plan)
            alike = self.alike(plan).to(batch.motion.device)
            pieces.append(Pairs(batch.motion, batch.mask, batch.text, batch.text_mask, batch.frames, alike))
        return pieces

    def alike(self, plan: BatchPlan) -> Bool[Tensor, "batch batch"]:
        """Which row's text is true of which row's motion: see `Pairs`."""
        composed = plan.donor.frames > 0
        cut = composed & (plan.other == plan.sentence)  # what the body would show has been cut off
        alike = (self.true_of(plan.sentence, plan.body.clip) & torch.from_numpy(~cut)) | (
            self.true_of(plan.sentence, plan.donor.clip) & torch.from_numpy(composed)
        )
        if self._embedded is None:
            return alike
        return alike | similar(self._embedded[torch.from_numpy(plan.sentence)], self.threshold)

    def true_of(self, sentences: np.ndarray, clips: np.ndarray) -> Bool[Tensor, "texts motions"]:
        """Which of the dataset's sentences, by their places, are among those of which of its clips."""
        return torch.from_numpy(self._true[sentences][:, self._key[clips]])

    def drawn(self, split: str, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
        """All clips of a split that have texts, and the place of one sentence of each: whom to retrieve from whom."""
        dataset, rng = self.batches.dataset, np.random.default_rng(seed)
        clips = np.flatnonzero([clip.split == split for clip in dataset.clips] & dataset.described)
        return clips, np.array([dataset.sentence(clip, rng.random()) for clip in clips.tolist()], dtype=int)


def similar(sentences: Float[Tensor, "batch width"], threshold: float | int = 0.8) -> Bool[Tensor, "batch batch"]:
    """Which texts say almost the same, by the scores (cosine / 2 + 1/2) of their sentence embeddings: those above
    `threshold` (TMR, section 3.3)."""
    unit = F.normalize(sentences, dim=-1)
    return (unit @ unit.T) / 2 + 0.5 > threshold
