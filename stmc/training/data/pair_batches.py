"""Batches for contrastive training, with the texts that are true of each motion."""

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
    """Function `batches(step, process)` that returns chunks of `Pairs`.

    A text is true of all clips that have it among their sentences. A text is true of a composition if it is true of
    either clip; half of the compositions get the text of the `other` clip, so that both are learned.

    Raises `ValueError` for a recipe whose rows may have no text or several.

    Args:
        batches: Batches to convert.
        sentences: Sentence encoder for the filter of TMR: texts more `similar` than `threshold` count as true of each
            other's motions. It helps if clips do not share sentences. None: no filter.
        threshold: Threshold of the filter.
    """

    def __init__(
        self, batches: ClipBatches, sentences: TextEncoder | None = None, threshold: float | int = 0.8
    ) -> None:
        batches.recipe.check_pairs()
        dataset = batches.dataset
        self.batches, self.threshold = batches, threshold
        keys = {key: column for column, key in enumerate(dataset.choices)}
        self._true = np.zeros(
            (len(dataset.sentences), len(keys) + 1), dtype=bool
        )  # the last column is for clips without sentences
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
            alike = self.match_texts(plan).to(batch.motion.device)
            pieces.append(Pairs(batch.motion, batch.mask, batch.text, batch.text_mask, batch.frames, alike))
        return pieces

    def match_texts(self, plan: BatchPlan) -> Bool[Tensor, "batch batch"]:
        """Return which row's text is true of which row's motion: see `Pairs`."""
        composed = plan.donor.frames > 0
        cut = composed & (plan.other == plan.sentence)  # the body's own action has been cut off
        alike = (self.belongs(plan.sentence, plan.body.clip) & torch.from_numpy(~cut)) | (
            self.belongs(plan.sentence, plan.donor.clip) & torch.from_numpy(composed)
        )
        if self._embedded is None:
            return alike
        return alike | similar(self._embedded[torch.from_numpy(plan.sentence)], self.threshold)

    def belongs(self, sentences: np.ndarray, clips: np.ndarray) -> Bool[Tensor, "texts motions"]:
        """Return whether each sentence belongs to each clip, both given by their indices in the dataset."""
        return torch.from_numpy(self._true[sentences][:, self._key[clips]])

    def draw(self, split: str, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
        """Return all clips of a split that have texts, and the index of a random sentence of each, for retrieval."""
        dataset, rng = self.batches.dataset, np.random.default_rng(seed)
        clips = np.flatnonzero([clip.split == split for clip in dataset.clips] & dataset.described)
        return clips, np.array([dataset.sentence(clip, rng.random()) for clip in clips.tolist()], dtype=int)


def similar(sentences: Float[Tensor, "batch width"], threshold: float | int = 0.8) -> Bool[Tensor, "batch batch"]:
    """Return which texts have similar embeddings, with (cosine / 2 + 1/2) above `threshold` (TMR, section 3.3)."""
    unit = F.normalize(sentences, dim=-1)
    return (unit @ unit.T) / 2 + 0.5 > threshold
