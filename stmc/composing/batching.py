"""Batching of one denoising step: rows of different lengths, with and without their texts, in few calls.

The inputs of a call are padded once for all steps. Implements classifier-free guidance; independent of plans, and of
whether a row is a crop or a whole sequence.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from stmc.diffusion import Prediction, Schedule, guide
from stmc.diffusion.tensors import PerDevice, mask, pad


@dataclass(frozen=True, eq=False)
class Request:
    """A unit of denoising: a crop with one text, or a sequence of segments with one text each."""

    frames: int
    padded_frames: int
    """Number of frames that the denoiser sees: `frames`, and those after them."""
    null: Float[Tensor, "_ width"]
    """Replacement of the text in the unconditional pass, with the same number of words."""
    text: Float[Tensor, "_ width"] | None
    """Text embedding; None for a request without a text, which needs the unconditional pass only."""
    segment: Int[Tensor, " _"] | None = None
    """Index of the word that applies to each frame; given for all requests, or for none."""
    needed: bool = True
    """Whether the prediction is used; otherwise it is zero and costs nothing."""


class Guided:
    """A `Predict` function of rows, [rows, frames, features], with classifier-free guidance.

    Rows with a text are denoised with and without it, other rows once; a `guidance` of 1 or 0 needs one pass. Passes
    are grouped by length into as few calls as possible. Frames beyond a row's `padded_frames` are zero.
    `frames_denoised` counts the frames of all calls, with and without text, excluding padding: the pose-wise denoising
    steps of FlowMDM (section 4.2).

    Args:
        denoiser: Denoiser, called with noisy rows, steps, texts, masks and segments.
        schedule: Noise schedule.
        requests: Rows to denoise.
        guidance: Guidance scale.
        prediction: The quantity that the denoiser predicts.
        padding: Maximum fraction of padding in a step.
        budget: Maximum number of frames of one call, unless a single row is longer.
        supports_padding: Whether texts with different numbers of words may share a call.
    """

    def __init__(
        self,
        denoiser: Callable[..., Tensor],
        schedule: Schedule,
        requests: Sequence[Request],
        guidance: float | int,
        prediction: Prediction,
        padding: float,
        budget: int,
        supports_padding: bool,
    ) -> None:
        self._denoiser, self._schedule, self._prediction, self._guidance = (
            denoiser, schedule, prediction, guidance
        )  # fmt: skip
        self._shape = (len(requests), max(request.padded_frames for request in requests))
        passes = _passes(requests, guidance)
        groups = [passes] if supports_padding else _by_words(passes)
        batches = [_Batch.of(call) for group in groups for call in _calls(group, padding, budget)]
        conditional = torch.tensor([request.text is not None for request in requests])
        self.frames_denoised = 0
        self._needed = sum(requests[row_pass.row].frames for row_pass in passes)
        self._denoised = sum(len(batch.rows) * batch.frames for batch in batches)
        self._batches = PerDevice(lambda x: ([batch.to(x) for batch in batches], conditional.to(x.device)))

    def __repr__(self) -> str:
        rows, frames = self._shape
        return f"Guided({rows} rows of up to {frames} frames, guidance {self._guidance}, {self.padding:.1%} padding)"

    @property
    def padding(self) -> float:
        """The fraction of the denoised frames of a step that lies after the ends of the rows."""
        return 1 - self._needed / self._denoised if self._denoised else 0.0

    def __call__(self, x: Float[Tensor, "rows frames features"], t: int) -> Float[Tensor, "rows frames features"]:
        assert x.shape[:2] == self._shape, f"rows of shape {tuple(x.shape[:2])}, but the plans have {self._shape}"
        batches, conditional = self._batches.at(x)
        self.frames_denoised += self._needed
        predictions = x.new_zeros(2, *x.shape)
        for batch in batches:
            noisy = x[batch.rows, : batch.frames]
            step = torch.full((len(noisy),), t, device=x.device)
            output = self._denoiser(noisy, step, batch.text, batch.text_mask, batch.mask, *batch.segment).to(x)
            x0 = self._schedule.to_x0(output, noisy, t, self._prediction)
            x0 = x0 if batch.mask is None else x0.masked_fill(~batch.mask[..., None], 0)
            predictions[batch.conditional, batch.rows, : batch.frames] = x0
        null, text = predictions
        return torch.where(conditional[:, None, None], guide(text, null, self._guidance), null)


class _ForwardPass(NamedTuple):
    """A pass of one row, with its text (conditional) or without it."""

    row: int
    conditional: bool
    frames: int
    text: Tensor
    segment: Tensor | None


def _passes(requests: Sequence[Request], guidance: float | int) -> list[_ForwardPass]:
    """List the passes of one step, without passes that would have no text or that the guidance ignores."""
    passes = []
    for row, request in ((row, request) for row, request in enumerate(requests) if request.needed):
        if request.text is not None and guidance != 0:
            passes.append(_ForwardPass(row, True, request.padded_frames, request.text, request.segment))
        if request.text is None or guidance != 1:
            passes.append(_ForwardPass(row, False, request.padded_frames, request.null, request.segment))
    return passes


def _by_words(passes: Sequence[_ForwardPass]) -> list[list[_ForwardPass]]:
    groups: dict[int, list[_ForwardPass]] = {}
    for row_pass in passes:
        groups.setdefault(len(row_pass.text), []).append(row_pass)
    return list(groups.values())


def _calls(passes: Sequence[_ForwardPass], padding: float, budget: int) -> list[list[_ForwardPass]]:
    """Group passes into few calls, longest first; see `Guided`."""
    passes = sorted(passes, key=lambda row_pass: row_pass.frames)
    calls = []
    for first, last in _runs([row_pass.frames for row_pass in passes], padding):
        rows_per_call = max(1, budget // passes[last - 1].frames)
        count = -(-(last - first) // rows_per_call)
        calls += [[passes[i] for i in chunk] for chunk in np.array_split(range(first, last), count)]
    return calls[::-1]


def _runs(lengths: Sequence[int], padding: float) -> list[tuple[int, int]]:
    """Cut sorted `lengths` into the fewest runs [first, last) whose fraction of padding is at most `padding`.

    Among all cuts into that many runs, dynamic programming finds the one with the least padding.
    """
    values, counts = np.unique(lengths, return_counts=True)
    rows = np.concatenate([[0], np.cumsum(counts)])
    frames = np.concatenate([[0], np.cumsum(counts * values)])
    # waste[i, j]: padded frames if the distinct lengths i to j form one run
    waste = values * (rows[1:] - rows[:-1, None]) - (frames[1:] - frames[:-1, None])
    waste = np.where(np.tri(len(values), dtype=bool).T, waste, np.inf)
    least, starts = waste[0], []
    while least[-1] > frames[-1] * padding / (1 - padding):
        options = np.concatenate([[np.inf], least[:-1]])[:, None] + waste
        starts.append(options.argmin(axis=0))
        least = options.min(axis=0)
    edges = [len(values)]
    for start in reversed(starts):
        edges.append(int(start[edges[-1] - 1]))
    return [(int(rows[a]), int(rows[b])) for a, b in pairwise([0, *reversed(edges)])]


@dataclass(frozen=True)
class _Batch:
    """One call of the denoiser as tensors; masks are None without padding, and `segment` holds at most one tensor."""

    rows: Tensor
    conditional: Tensor
    frames: int
    text: Tensor
    text_mask: Tensor | None
    mask: Tensor | None
    segment: tuple[Tensor, ...]

    @classmethod
    def of(cls, passes: Sequence[_ForwardPass]) -> _Batch:
        text, words = pad([row_pass.text for row_pass in passes])
        segments = [row_pass.segment for row_pass in passes if row_pass.segment is not None]
        return cls(
            rows=torch.tensor([row_pass.row for row_pass in passes]),
            conditional=torch.tensor([row_pass.conditional for row_pass in passes]).long(),
            frames=max(row_pass.frames for row_pass in passes),
            text=text,
            text_mask=_none_if_full(mask(words)),
            mask=_none_if_full(mask(torch.tensor([row_pass.frames for row_pass in passes]))),
            segment=(pad(segments)[0],) if segments else (),
        )

    def to(self, x: Tensor) -> _Batch:
        """Move the batch to the device of `x`, and the text to its dtype."""
        rows, conditional, *segment = (tensor.to(x.device) for tensor in (self.rows, self.conditional, *self.segment))
        words, frames = (None if tensor is None else tensor.to(x.device) for tensor in (self.text_mask, self.mask))
        return _Batch(rows, conditional, self.frames, self.text.to(x), words, frames, tuple(segment))


def _none_if_full(mask: Tensor) -> Tensor | None:
    return None if bool(mask.all()) else mask
