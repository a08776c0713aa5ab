"""Distillation: one pass of a network learns what two passes of its teacher, with a text and without, predict together
(Meng et al. 2023, first stage); and a network that knows a text for every frame learns it of one that does not.

Knows networks with a denoiser's signature; knows no data set and no schedule.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from stmc.denoisers.denoiser import Denoiser
from stmc.diffusion import guide, tensors
from stmc.training.loss import Batch

NEIGHBOURS = 5
"""Frames beyond either end of a segment that its teacher sees, too: there its prediction fades into the neighbour's."""

AT_ONCE = 4
"""Calls that a batch's segments are spread over, so that short ones are not padded to the longest."""


@dataclass(frozen=True, eq=False)
class GuidedTeacher:
    """What `denoiser` predicts with classifier-free `guidance`, for `Denoising` to learn; no gradient reaches it.

    `texts` are the batches' sentences as the teacher reads them (by `Batch.sentence`; the first is the empty one),
    normalised, each of so many `words`: another text encoder than the student's, perhaps. Rows without a text teach the
    prediction without a text. The denoiser must be in evaluation mode.

    Where rows have several texts, the teacher, who knows one text a row, sees each segment alone, and `NEIGHBOURS`
    frames of those beside it; the predictions are cross-faded, as STMC stitches its crops by default.

    Examples:
        >>> def sums(x, t, text, text_mask=None, mask=None):
        ...     return x + text.sum()
        >>> motion, walk = torch.zeros(1, 2, 3), torch.tensor([[1]])
        >>> piece = stmc.training.Batch(motion, None, torch.ones(1, 1, 8), None, frames=2, sentence=walk)
        >>> texts = torch.tensor([[[0.0]], [[1.0]]])  # "", "walk"
        >>> teacher = stmc.training.GuidedTeacher(sums, guidance=2.5, texts=texts, words=torch.tensor([1, 1]))
        >>> teacher(piece, motion, torch.tensor([5]))[0, 0]
        tensor([2.5000, 2.5000, 2.5000])
    """

    denoiser: Denoiser
    guidance: float | int
    texts: Float[Tensor, "sentences words width"]
    words: Int[Tensor, " sentences"]

    @torch.no_grad()
    def __call__(
        self, batch: Batch, noisy: Float[Tensor, "batch frames features"], t: Int[Tensor, " batch"]
    ) -> Float[Tensor, "batch frames features"]:
        """The guided prediction for the batch's noisy motion; zeros in the padding, where there are several texts."""
        assert batch.sentence is not None, "a teacher reads sentences, and the batch does not say which"
        if batch.segment is None:
            return self._guided(noisy, t, batch.sentence[:, 0], batch.mask)
        crops = _Crops.of(batch.segment, batch.mask)
        sentence = batch.sentence[crops.row, crops.word]
        total = torch.zeros_like(noisy)
        for some in crops.frames.argsort().tensor_split(AT_ONCE):
            if len(some):
                row, frame, share, mask = crops.cut(some)
                predicted = self._guided(noisy[row, frame], t[row[:, 0]], sentence[some], mask)
                total.index_put_((row, frame), predicted * share[..., None], accumulate=True)
        return total

    def _guided(
        self,
        noisy: Float[Tensor, "batch frames features"],
        t: Int[Tensor, " batch"],
        sentence: Int[Tensor, " batch"],
        mask: Bool[Tensor, "batch frames"] | None,
    ) -> Float[Tensor, "batch frames features"]:
        """Of rows of one text each."""
        text = self._predicted(noisy, t, sentence, mask)
        if self.guidance == 1:
            return text
        return guide(text, self._predicted(noisy, t, torch.zeros_like(sentence), mask), self.guidance)

    def _predicted(self, noisy: Tensor, t: Tensor, sentence: Tensor, mask: Tensor | None) -> Tensor:
        words = self.words[sentence]
        text = self.texts[sentence, : int(words.max())]
        text_mask = None if (words == words.max()).all() else tensors.mask(words)
        return self.denoiser(noisy, t, text, text_mask, mask).float()


@dataclass(frozen=True, eq=False)
class _Crops:
    """The segments of a batch's rows, each with `NEIGHBOURS` frames more at either end where the row has them: the
    `row` and the `word` of each, where in the row it begins, its `frames`, and whether the row goes on before and after
    it."""

    row: Int[Tensor, " crops"]
    word: Int[Tensor, " crops"]
    begin: Int[Tensor, " crops"]
    frames: Int[Tensor, " crops"]
    comes: Bool[Tensor, " crops"]
    goes: Bool[Tensor, " crops"]

    @classmethod
    def of(cls, segment: Int[Tensor, "batch frames"], mask: Bool[Tensor, "batch frames"] | None) -> _Crops:
        """Of rows whose segments are not interrupted."""
        real = torch.ones_like(segment, dtype=torch.bool) if mask is None else mask
        length = real.sum(dim=1)
        numbers = torch.arange(int(segment.max()) + 1, device=segment.device)
        inside = (segment[:, None] == numbers[:, None]) & real[:, None]  # (rows, words, frames)
        row, word = inside.any(dim=2).nonzero(as_tuple=True)
        begin, own = inside.int().argmax(dim=2)[row, word], inside.sum(dim=2)[row, word]
        start, end = (begin - NEIGHBOURS).clamp(min=0), torch.minimum(begin + own + NEIGHBOURS, length[row])
        return cls(row, word, start, end - start, begin > 0, begin + own < length[row])

    def cut(
        self, some: Int[Tensor, " some"]
    ) -> tuple[
        Int[Tensor, "some frames"],
        Int[Tensor, "some frames"],
        Float[Tensor, "some frames"],
        Bool[Tensor, "some frames"] | None,
    ]:
        """Of some of the crops, padded to the longest: rows and frames of the batch; how much each counts, which at
        every frame of a row sums to 1; and the mask."""
        frames, fade = self.frames[some, None], 2 * NEIGHBOURS + 1
        own = torch.arange(int(frames.max()), device=frames.device)[None]
        come = torch.where(self.comes[some, None], (own + 1) / fade, 1.0)
        go = torch.where(self.goes[some, None], (frames - own) / fade, 1.0)
        share = torch.minimum(come, go).clamp(0, 1) * (own < frames)
        inside = self.begin[some, None] + torch.minimum(own, frames - 1)
        mask = None if (frames == frames.max()).all() else own < frames
        return self.row[some, None].expand_as(inside), inside, share, mask
