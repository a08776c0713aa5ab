"""One step's passes through a denoiser: rows of different lengths, each with its text and without, in few calls.

What a call needs is padded once for all steps. Knows classifier-free guidance; knows no plans, and not whether a row is
a crop or a whole sequence.
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
    """What is denoised as one: a crop with a text, or a sequence of segments with a text each."""

    frames: int
    padded_frames: int
    """Frames that the denoiser sees: `frames`, and what it sees behind them."""
    null: Float[Tensor, "_ width"]
    """What takes the text's place in the unconditional pass: as many words, of nothing."""
    text: Float[Tensor, "_ width"] | None
    """None: without a text, which needs the unconditional pass alone."""
    segment: Int[Tensor, " _"] | None = None
    """For every frame, which word of the text belongs to it; all requests have it, or none."""
    needed: bool = True
    """False: nobody looks at it; it comes out as zero, and costs nothing."""


class Guided:
    """A predictor of rows, [rows, frames, features], with classifier-free guidance: a `Predict`.

    Rows with a text are denoised with it and without it, the others once; a `guidance` of 1 or 0 needs one pass. Passes
    are grouped by length into as few calls as keep the share of padding within `padding` and the frames of one call
    within `budget`, but for a longer row alone. `supports_padding`: texts of different numbers of words share calls.
    What stands beyond a row's `padded_frames` comes out as zero. `frames_denoised` counts those of all calls, with a
    text and without, but no padding: pose-wise denoising steps (FlowMDM, section 4.2).
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
        self._shape = (len(requests), max(each.padded_frames for each in requests))
        passes = _passes(requests, guidance)
        alike = [passes] if supports_padding else _by_words(passes)
        batches = [_Batch.of(call) for group in alike for call in _calls(group, padding, budget)]
        conditional = torch.tensor([each.text is not None for each in requests])
        self.frames_denoised = 0
        self._needed = sum(requests[each.row].frames for each in passes)
        self._denoised = sum(len(batch.rows) * batch.frames for batch in batches)
        self._batches = PerDevice(lambda x: ([batch.to(x) for batch in batches], conditional.to(x.device)))

    def __repr__(self) -> str:
        rows, frames = self._shape
        return f"Guided({rows} rows of up to {frames} frames, guidance {self._guidance}, {self.padding:.1%} padding)"

    @property
    def padding(self) -> float:
        """Which share of the frames that a step denoises lies behind the ends of the rows."""
        return 1 - self._needed / self._denoised if self._denoised else 0.0

    def __call__(self, x: Float[Tensor, "rows frames features"], t: int) -> Float[Tensor, "rows frames features"]:
        assert x.shape[:2] == self._shape, f"rows of shape {tuple(x.shape[:2])}, but the plans have {self._shape}"
        batches, conditional = self._batches.at(x)
        self.frames_denoised += self._needed
        both = x.new_zeros(2, *x.shape)
        for batch in batches:
            noisy = x[batch.rows, : batch.frames]
            step = torch.full((len(noisy),), t, device=x.device)
            output = self._denoiser(noisy, step, batch.text, batch.text_mask, batch.mask, *batch.segment).to(x)
            x0 = self._schedule.to_x0(output, noisy, t, self._prediction)
            x0 = x0 if batch.mask is None else x0.masked_fill(~batch.mask[..., None], 0)
            both[batch.conditional, batch.rows, : batch.frames] = x0
        null, text = both
        return torch.where(conditional[:, None, None], guide(text, null, self._guidance), null)


class _ForwardPass(NamedTuple):
    """Of one row, with its text (conditional) or without."""

    row: int
    conditional: bool
    frames: int
    text: Tensor
    segment: Tensor | None


def _passes(requests: Sequence[Request], guidance: float | int) -> list[_ForwardPass]:
    """Everything that one step has to denoise: no second pass without a text, or where guidance ignores one of two."""
    passes = []
    for row, request in ((row, request) for row, request in enumerate(requests) if request.needed):
        if request.text is not None and guidance != 0:
            passes.append(_ForwardPass(row, True, request.padded_frames, request.text, request.segment))
        if request.text is None or guidance != 1:
            passes.append(_ForwardPass(row, False, request.padded_frames, request.null, request.segment))
    return passes


def _by_words(passes: Sequence[_ForwardPass]) -> list[list[_ForwardPass]]:
    groups: dict[int, list[_ForwardPass]] = {}
    for each in passes:
        groups.setdefault(len(each.text), []).append(each)
    return list(groups.values())


def _calls(passes: Sequence[_ForwardPass], padding: float, budget: int) -> list[list[_ForwardPass]]:
    """In few calls, the longest first: see `Guided`."""
    passes = sorted(passes, key=lambda each: each.frames)
    calls = []
    for first, last in _runs([each.frames for each in passes], padding):
        most = max(1, budget // passes[last - 1].frames)
        pieces = -(-(last - first) // most)
        calls += [[passes[i] for i in piece] for piece in np.array_split(range(first, last), pieces)]
    return calls[::-1]


def _runs(lengths: Sequence[int], padding: float) -> list[tuple[int, int]]:
    """The fewest runs [first, last) of sorted `lengths` with a share of padding of at most `padding`.

    Of the ways to cut that many runs it is the one with the least padding (dynamic programming).
    """
    values, counts = np.unique(lengths, return_counts=True)
    rows = np.concatenate([[0], np.cumsum(counts)])
    frames = np.concatenate([[0], np.cumsum(counts * values)])
    # waste[i, j]: padded frames if the distinct lengths i to j make one run
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
    """One call of the denoiser as tensors; a mask is None where nothing is padded. `segment`: one tensor, or none."""

    rows: Tensor
    conditional: Tensor
    frames: int
    text: Tensor
    text_mask: Tensor | None
    mask: Tensor | None
    segment: tuple[Tensor, ...]

    @classmethod
    def of(cls, passes: Sequence[_ForwardPass]) -> _Batch:
        text, words = pad([each.text for each in passes])
        segments = [each.segment for each in passes if each.segment is not None]
        return cls(
            rows=torch.tensor([each.row for each in passes]),
            conditional=torch.tensor([each.conditional for each in passes]).long(),
            frames=max(each.frames for each in passes),
            text=text,
            text_mask=_unless_full(mask(words)),
            mask=_unless_full(mask(torch.tensor([each.frames for each in passes]))),
            segment=(pad(segments)[0],) if segments else (),
        )

    def to(self, x: Tensor) -> _Batch:
        """On the device of `x`, with the text in its dtype."""
        rows, conditional, *segment = (each.to(x.device) for each in (self.rows, self.conditional, *self.segment))
        masks = [None if each is None else each.to(x.device) for each in (self.text_mask, self.mask)]
        return _Batch(rows, conditional, self.frames, self.text.to(x), *masks, tuple(segment))


def _unless_full(mask: Tensor) -> Tensor | None:
    return None if bool(mask.all()) else mask
