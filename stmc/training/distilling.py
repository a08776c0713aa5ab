"""Distillation of classifier-free guidance (Meng et al. 2023, first stage) and of steps (Salimans and Ho 2022).

One pass of a network learns the guided prediction of its teacher, which needs two passes, with a text and without. A
network with a text for every frame can learn from a teacher with one text per row. One step of a sampler learns where
several steps of a teacher arrive. This module knows networks with a denoiser's signature, and schedules; it knows no
data set.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, field

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from stmc.denoisers.denoiser import Denoiser
from stmc.diffusion import Prediction, Schedule, guide, tensors
from stmc.training.loss import Batch, Teacher

NEIGHBOURS = 5
"""Number of frames beyond either end of a segment that the teacher also sees, where predictions are cross-faded."""
AT_ONCE = 4
"""Number of teacher calls per batch; segments are sorted by length so that short ones need little padding."""


@dataclass(frozen=True, eq=False)
class GuidedTeacher:
    """Guided predictions of a teacher, for `Denoising` to learn; no gradient reaches the teacher.

    Rows without a text teach the unconditional prediction. If rows have several texts, the teacher, which accepts one
    text per row, sees each segment alone with `NEIGHBOURS` frames of its neighbours, and the predictions are
    cross-faded, as STMC stitches its crops by default.

    Args:
        denoiser: Denoiser of the teacher, in evaluation mode.
        guidance: Classifier-free guidance scale.
        texts: Normalised embeddings of the data set's sentences, by `Batch.sentence`; the first sentence is empty. The
            teacher may have another text encoder than the student.
        words: Number of words of each sentence.

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
        """Predict with guidance from the batch's noisy motion; padding is zero if rows have several texts."""
        assert batch.sentence is not None, "the teacher needs `Batch.sentence`"
        if batch.segment is None:
            return self._guided(noisy, t, batch.sentence[:, 0], batch.mask)
        crops = _Crops.of(batch.segment, batch.mask)
        sentence = batch.sentence[crops.row, crops.word]
        total = torch.zeros_like(noisy)
        for some in crops.frames.argsort().tensor_split(AT_ONCE):
            if len(some):
                row, frame, share, mask = crops.take(some)
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
        """Predict with guidance for rows of one text each."""
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
class MultistepTeacher:
    """The prediction whose one DDIM step arrives where several steps of a teacher do, for `Denoising` to learn.

    The schedule is divided into `steps` phases. From the beginning of its phase each row follows the teacher to the
    end, `teacher_steps / steps` DDIM steps, and the clean sample that leads there in one step is the target (Salimans
    and Ho 2022, algorithm 2, with any number of steps instead of two). A student of these targets, sampled by DDIM in
    `steps` steps, repeats `teacher_steps` steps of the teacher, and is deterministic as they are. If the teacher is a
    student itself, sampled in its own number of steps, this is a further stage of progressive distillation.

    Args:
        teacher: Teacher of single steps, such as `GuidedTeacher`.
        schedule: Noise schedule.
        steps: Number of the student's steps.
        teacher_steps: Number of the teacher's steps, a multiple of `steps`.
        prediction: Quantity that teacher and student predict.

    Raises:
        ValueError: If `teacher_steps` is no multiple of `steps`, or the spacing of the schedule does not let the
            teacher visit the student's steps.

    Examples:
        >>> schedule = stmc.Schedule.cosine(100, spacing="trailing")
        >>> rest = lambda batch, noisy, t: torch.full_like(noisy, 0.5)
        >>> teacher = stmc.training.MultistepTeacher(rest, schedule, steps=4, teacher_steps=20)
        >>> batch = stmc.training.Batch(torch.zeros(1, 2, 3), None, torch.ones(1, 1, 8), None, frames=2)
        >>> teacher(batch, torch.ones(1, 2, 3), torch.tensor([74]))[0, 0]
        tensor([0.5000, 0.5000, 0.5000])
    """

    teacher: Teacher
    schedule: Schedule
    steps: int
    teacher_steps: int
    prediction: Prediction = "x0"

    def __post_init__(self) -> None:
        ours, theirs = self.schedule.spaced(self.steps), self.schedule.spaced(self.teacher_steps)
        if self.teacher_steps % self.steps:
            raise ValueError(f"teacher_steps ({self.teacher_steps}) must be a multiple of steps ({self.steps})")
        if theirs[self.per_step - 1 :: self.per_step] != ours:
            raise ValueError(
                f"{self.teacher_steps} steps of the teacher do not pass through the {self.steps} steps {ours} with the "
                f"spacing {self.schedule.spacing}; use a schedule with spacing=trailing"
            )

    @property
    def per_step(self) -> int:
        """Number of the teacher's steps that one step of the student replaces."""
        return self.teacher_steps // self.steps

    @torch.no_grad()
    def __call__(
        self, batch: Batch, noisy: Float[Tensor, "batch frames features"], t: Int[Tensor, " batch"]
    ) -> Float[Tensor, "batch frames features"]:
        """Follow the teacher from the batch's noisy motion at steps `t`, each the beginning of a phase, to its end."""
        grid = torch.tensor(self.schedule.spaced(self.teacher_steps), device=t.device)
        short, place, x = self.schedule.respaced(tuple(grid.tolist())), torch.searchsorted(grid, t), noisy
        for _ in range(self.per_step):
            x0 = self.schedule.to_x0(self.teacher(batch, x, grid[place]), x, grid[place], self.prediction)
            x, _ = short.ddim(x0, x, place)
            place = place - 1
        x0 = self._leading_to(x, short.alpha_bar_before[(place + 1).cpu()], noisy, t)
        return self.schedule.from_x0(x0, noisy, t, self.prediction)

    def _leading_to(self, x: Tensor, alpha_bar: Tensor, noisy: Tensor, t: Tensor) -> Tensor:
        """Return the clean sample from which one DDIM step of `noisy` at `t` is `x`, whose noise is `alpha_bar`."""
        now = self.schedule.alpha_bar[t.cpu()]
        ratio = ((1 - alpha_bar) / (1 - now)).sqrt()
        ratio, signal = (each.to(noisy)[:, None, None] for each in (ratio, alpha_bar.sqrt() - ratio * now.sqrt()))
        return (x - ratio * noisy) / signal


@dataclass(frozen=True, eq=False)
class RememberingTeacher:
    """A teacher's predictions, computed once for batches that are learned several times (`training.Settings.rounds`).

    Args:
        teacher: Teacher to ask.
        batches: Number of batches whose predictions are kept, the newest.
    """

    teacher: Teacher
    batches: int
    _kept: dict[bytes, Tensor] = field(default_factory=dict, init=False, repr=False)

    def __call__(
        self, batch: Batch, noisy: Float[Tensor, "batch frames features"], t: Int[Tensor, " batch"]
    ) -> Float[Tensor, "batch frames features"]:
        """Return the kept prediction for this noisy motion, these steps and these sentences, or ask for it."""
        parts = (noisy, t) if batch.sentence is None else (noisy, t, batch.sentence)
        key = hashlib.blake2b(b"".join(part.cpu().numpy().tobytes() for part in parts)).digest()
        if key not in self._kept:
            if len(self._kept) == self.batches:
                del self._kept[next(iter(self._kept))]
            self._kept[key] = self.teacher(batch, noisy, t)
        return self._kept[key]


@dataclass(frozen=True, eq=False)
class _Crops:
    """Segments of a batch's rows, each extended by up to `NEIGHBOURS` frames of the row at either end.

    For each crop: its `row` and `word`, its first frame `begin` in the row, its number of `frames`, and whether the row
    continues before (`has_previous`) and after it (`has_next`).
    """

    row: Int[Tensor, " crops"]
    word: Int[Tensor, " crops"]
    begin: Int[Tensor, " crops"]
    frames: Int[Tensor, " crops"]
    has_previous: Bool[Tensor, " crops"]
    has_next: Bool[Tensor, " crops"]

    @classmethod
    def of(cls, segment: Int[Tensor, "batch frames"], mask: Bool[Tensor, "batch frames"] | None) -> _Crops:
        """Return the crops of rows whose segments are contiguous."""
        real = torch.ones_like(segment, dtype=torch.bool) if mask is None else mask
        length = real.sum(dim=1)
        numbers = torch.arange(int(segment.max()) + 1, device=segment.device)
        inside = (segment[:, None] == numbers[:, None]) & real[:, None]  # (rows, words, frames)
        row, word = inside.any(dim=2).nonzero(as_tuple=True)
        begin, own = inside.int().argmax(dim=2)[row, word], inside.sum(dim=2)[row, word]
        start, end = (begin - NEIGHBOURS).clamp(min=0), torch.minimum(begin + own + NEIGHBOURS, length[row])
        return cls(row, word, start, end - start, begin > 0, begin + own < length[row])

    def take(
        self, some: Int[Tensor, " some"]
    ) -> tuple[
        Int[Tensor, "some frames"],
        Int[Tensor, "some frames"],
        Float[Tensor, "some frames"],
        Bool[Tensor, "some frames"] | None,
    ]:
        """Return rows, frames, weights and mask of some of the crops, padded to the longest of them.

        The weights of all crops sum to 1 at every frame of a row. The mask is None if nothing is padded.
        """
        frames, fade = self.frames[some, None], 2 * NEIGHBOURS + 1
        own = torch.arange(int(frames.max()), device=frames.device)[None]
        come = torch.where(self.has_previous[some, None], (own + 1) / fade, 1.0)
        go = torch.where(self.has_next[some, None], (frames - own) / fade, 1.0)
        share = torch.minimum(come, go).clamp(0, 1) * (own < frames)
        inside = self.begin[some, None] + torch.minimum(own, frames - 1)
        mask = None if (frames == frames.max()).all() else own < frames
        return self.row[some, None].expand_as(inside), inside, share, mask
