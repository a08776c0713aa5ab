"""Batches for what tells pairs of motion and text from non-pairs: which texts are true of which motions of a batch.

Knows draws of a corpus and the sentences of its clips; knows no network and no loss.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor

from stmc.data.batches import ClipBatches
from stmc.data.dataset import Draws
from stmc.text import TextEncoder
from stmc.training import Pairs


class PairBatches:
    """`batches(step, process)`: those of a `ClipBatches`, every row with a text, and what else each text is true of.

    A text is true of all clips that have it among their sentences; of a composition's motion, what is true of either
    clip, and half of the compositions have the text of the `other` clip: both are to be heard. With an encoder of whole
    `sentences`, texts that it finds `similar` by more than `threshold` are taken to be true of each other's motions,
    too: the filter of TMR, for data where one clip's sentences are not another's.

    Raises `ValueError` for sampling that leaves rows without a text.
    """

    def __init__(
        self, batches: ClipBatches, sentences: TextEncoder | None = None, threshold: float | int = 0.8
    ) -> None:
        sampling, corpus = batches.sampling, batches.corpus
        if sampling.crops or sampling.silent:
            raise ValueError(f"pairs need texts: crops ({sampling.crops}) and silent ({sampling.silent}) must be 0")
        self.batches, self.threshold = batches, threshold
        keys = {key: column for column, key in enumerate(corpus.choices)}
        self._true = np.zeros((len(corpus.sentences), len(keys) + 1), dtype=bool)  # the last column: of no sentence
        for key, (places, _) in corpus.choices.items():
            self._true[places, keys[key]] = True
        self._key = np.array([keys.get(clip.texts, len(keys)) for clip in corpus.clips])
        self._embedded = None if sentences is None else sentences.encode(corpus.sentences)[0][:, 0].float()

    def __call__(self, step: int, process: int = 0) -> list[Pairs]:
        corpus, pieces = self.batches.corpus, []
        random = np.random.default_rng([self.batches.seed, step, process])
        for draws in self.batches.draws(step, process):
            swapped = random.random(len(draws.sentence)) < 0.5
            texts = draws.sentence, draws.other
            draws = replace(draws, sentence=np.where(swapped, *texts[::-1]), other=np.where(swapped, *texts))
            batch = corpus.batch(draws)
            alike = self.alike(draws).to(batch.motion.device)
            pieces.append(Pairs(batch.motion, batch.mask, batch.text, batch.text_mask, batch.frames, alike))
        return pieces

    def alike(self, draws: Draws) -> Bool[Tensor, "batch batch"]:
        """Which row's text is true of which row's motion: see `Pairs`."""
        composed = draws.guest.frames > 0
        cut = composed & (draws.other == draws.sentence)  # what the body would show has been cut off
        alike = (self.true_of(draws.sentence, draws.body.clip) & torch.from_numpy(~cut)) | (
            self.true_of(draws.sentence, draws.guest.clip) & torch.from_numpy(composed)
        )
        if self._embedded is None:
            return alike
        return alike | similar(self._embedded[torch.from_numpy(draws.sentence)], self.threshold)

    def true_of(self, sentences: np.ndarray, clips: np.ndarray) -> Bool[Tensor, "texts motions"]:
        """Which of the corpus' sentences, by their places, are among those of which of its clips."""
        return torch.from_numpy(self._true[sentences][:, self._key[clips]])

    def drawn(self, split: str, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
        """All clips of a split that have texts, and the place of one sentence of each: whom to retrieve from whom."""
        corpus, random = self.batches.corpus, np.random.default_rng(seed)
        clips = np.flatnonzero([clip.split == split for clip in corpus.clips] & corpus.described)
        return clips, np.array([corpus.sentence(clip, random.random()) for clip in clips.tolist()], dtype=int)


def similar(sentences: Float[Tensor, "batch width"], threshold: float | int = 0.8) -> Bool[Tensor, "batch batch"]:
    """Which texts say almost the same, by the scores (cosine / 2 + 1/2) of their sentence embeddings: those above
    `threshold` (TMR, section 3.3)."""
    unit = F.normalize(sentences, dim=-1)
    return (unit @ unit.T) / 2 + 0.5 > threshold
