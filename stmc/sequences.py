"""Body parts as seamless sequences: from a denoiser that knows a text for every frame to a predictor of timelines
(Barquero et al. 2024, here with several tracks).

What a body part obeys from the first frame to the last, prompt after prompt, is one sequence, denoised whole; there are
no crops and no transitions. Parts that obey the same share one. At every step all sequences see the same composite
motion, and each part is taken from its own. The plans are those without overlap. Knows no text encoders, no samplers
and no meaning of the features beyond each part's columns.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple, Protocol, runtime_checkable

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from stmc.body import BodyPart
from stmc.compose import NULL, Columns, distinct_texts
from stmc.diffusion import Predict, Prediction, Schedule, guide
from stmc.planning import Plan
from stmc.tensors import Moved, mask, pad

PADDING = 0.1
"""How much shorter a sequence may be than the longest of its call."""


@runtime_checkable
class SequenceDenoiser(Protocol):
    """A denoiser that knows a text for every frame, such as `FlowMdm.denoise`."""

    def __call__(
        self,
        x: Float[Tensor, "batch frames features"],
        t: Int[Tensor, " batch"],
        text: Float[Tensor, "batch words width"],
        text_mask: Bool[Tensor, "batch words"] | None,
        mask: Bool[Tensor, "batch frames"] | None,
        segment: Int[Tensor, "batch frames"] | None,
    ) -> Float[Tensor, "batch frames features"]:
        """As `Denoiser`, but a text has a word for each segment, and `segment` says which one a frame belongs to."""
        ...


class Stretch(NamedTuple):
    """Frames [start, end) of a sequence, which belong to a plan's `crop`."""

    crop: int
    start: int
    end: int


def body_sequences(plan: Plan) -> dict[tuple[Stretch, ...], tuple[BodyPart, ...]]:
    """The distinct sequences of stretches that the body parts of a plan obey, each with the parts that obey it.

    Stretches cover every frame of the plan once, in order. Raises `ValueError` for a plan with overlap.
    """
    sequences: dict[tuple[Stretch, ...], tuple[BodyPart, ...]] = {}
    for part in BodyPart:
        tiles = sorted((tile for tile in plan.tiles if tile.part == part), key=lambda tile: tile.start)
        if sum(tile.end - tile.start for tile in tiles) != plan.frames:
            raise ValueError(f"the tiles of the {part} overlap: sequences are made of plans with overlap=0")
        sequence = tuple(Stretch(tile.crop, tile.start, tile.end) for tile in tiles)
        sequences[sequence] = (*sequences.get(sequence, ()), part)
    return sequences


def weave(predict: Predict, plans: Sequence[Plan], columns: Columns) -> Predict:
    """A predictor of timelines [batch, frames, features] from a predictor of their sequences.

    `predict` is given every timeline once for each of its `body_sequences`, plan 0's first; each body part's columns
    are then taken from its own sequence.
    """
    timelines, rows = [], {}
    for i, plan in enumerate(plans):
        for parts in body_sequences(plan).values():
            rows |= {(i, part): len(timelines) for part in parts}
            timelines.append(i)
    owners = [(list(columns[part]), torch.tensor([rows[i, part] for i in range(len(plans))])) for part in columns]
    indexes = Moved(
        lambda x: (
            torch.tensor(timelines, device=x.device),
            [(torch.tensor(own, dtype=torch.int64, device=x.device), row.to(x.device)) for own, row in owners],
        )
    )

    def woven(x: Float[Tensor, "batch frames features"], t: int) -> Float[Tensor, "batch frames features"]:
        timeline, parts = indexes.at(x)
        sequences, x0 = predict(x[timeline], t), torch.empty_like(x)
        for own, row in parts:
            x0[..., own] = sequences[row][..., own]
        return x0

    return woven


def guided_sequences(
    denoiser: SequenceDenoiser,
    schedule: Schedule,
    plans: Sequence[Plan],
    embeddings: Mapping[str, Float[Tensor, "_ width"]],
    weight: float | int = 2.5,
    prediction: Prediction = "x0",
    budget: int = 65536,
) -> Predict:
    """A predictor of the sequences of all plans, [sequences, frames, features], with classifier-free guidance.

    `embeddings` gives the normalised embedding, one word, of every text in `distinct_texts(plans)`. A sequence with any
    text is denoised with its texts, and in a second pass with the same segments but no text; a `weight` of 1 or 0 needs
    one pass. A call holds at most `budget` frames, but for a longer sequence alone. Raises `ValueError` for a text
    without an embedding, or with more words than one, and for plans with overlap.
    """
    if missing := [text for text in distinct_texts(plans) if text not in embeddings]:
        raise ValueError(f"no embedding for {missing}; every text of the plans needs one, and the empty text too")
    if long := [text for text in distinct_texts(plans) if len(embeddings[text]) != 1]:
        raise ValueError(f"a segment's text is one word, but {long[0]!r} has {len(embeddings[long[0]])}")
    rows = [_Row.of(plan, sequence) for plan in plans for sequence in body_sequences(plan)]
    passes = [
        _Pass(number, row if told else row.silent(), told)
        for number, row in enumerate(rows)
        for told in ([False] if weight == 0 or not row.told else [True] if weight == 1 else [True, False])
    ]
    calls = [_Call.of(some, embeddings) for some in _calls(passes, budget)]
    shape = (len(rows), max(row.frames for row in rows))
    guided = torch.tensor([row.told and weight != 0 for row in rows])
    moved = Moved(lambda x: ([call.to(x) for call in calls], guided.to(x.device)[:, None, None]))

    def predict(x: Float[Tensor, "sequences frames features"], t: int) -> Float[Tensor, "sequences frames features"]:
        assert x.shape[:2] == shape, f"sequences of shape {tuple(x.shape[:2])}, but the plans have {shape}"
        calls, guided = moved.at(x)
        both = x.new_zeros(2, *x.shape)
        for call in calls:
            noisy = x[call.rows, : call.frames]
            step = torch.full((len(noisy),), t, device=x.device)
            output = denoiser(noisy, step, call.text, None, call.mask, call.segment).to(x)
            x0 = schedule.to_x0(output, noisy, t, prediction)
            x0 = x0 if call.mask is None else x0.masked_fill(~call.mask[..., None], 0)
            both[call.told, call.rows, : call.frames] = x0
        null, text = both
        return torch.where(guided, guide(text, null, weight), null)

    return predict


@dataclass(frozen=True)
class _Row:
    """A sequence: its texts, and of every stretch which of them it belongs to and how many frames it has."""

    texts: tuple[str, ...]
    stretches: tuple[tuple[int, int], ...]

    @classmethod
    def of(cls, plan: Plan, sequence: Sequence[Stretch]) -> _Row:
        crops = list(dict.fromkeys(stretch.crop for stretch in sequence))
        texts = tuple(plan.crops[crop].text or NULL for crop in crops)
        return cls(texts, tuple((crops.index(crop), end - start) for crop, start, end in sequence))

    @property
    def frames(self) -> int:
        return sum(frames for _, frames in self.stretches)

    @property
    def told(self) -> bool:
        return any(text != NULL for text in self.texts)

    def silent(self) -> _Row:
        return _Row((NULL,) * len(self.texts), self.stretches)


class _Pass(NamedTuple):
    number: int
    row: _Row
    told: bool


def _calls(passes: Sequence[_Pass], budget: int) -> list[list[_Pass]]:
    """The longest first, so that what shares a call is about as long."""
    calls: list[list[_Pass]] = []
    for each in sorted(passes, key=lambda each: -each.row.frames):
        longest = calls[-1][0].row.frames if calls else 0
        alike = each.row.frames >= (1 - PADDING) * longest
        if calls and alike and (len(calls[-1]) + 1) * longest <= budget:
            calls[-1].append(each)
        else:
            calls.append([each])
    return calls


@dataclass(frozen=True)
class _Call:
    """One call of the denoiser as tensors; the mask is None where nothing is padded."""

    rows: Tensor
    told: Tensor
    frames: int
    text: Tensor
    segment: Tensor
    mask: Tensor | None

    @classmethod
    def of(cls, passes: Sequence[_Pass], embeddings: Mapping[str, Tensor]) -> _Call:
        segment, frames = pad([_segments(each.row) for each in passes])
        text, _ = pad([torch.cat([embeddings[text] for text in each.row.texts]) for each in passes])
        present = mask(frames)
        return cls(
            rows=torch.tensor([each.number for each in passes]),
            told=torch.tensor([each.told for each in passes]).long(),
            frames=int(frames.max()),
            text=text,
            segment=segment,
            mask=None if bool(present.all()) else present,
        )

    def to(self, x: Tensor) -> _Call:
        """On the device of `x`, with the text in its dtype."""
        rows, told, segment = (each.to(x.device) for each in (self.rows, self.told, self.segment))
        present = None if self.mask is None else self.mask.to(x.device)
        return _Call(rows, told, self.frames, self.text.to(x), segment, present)


def _segments(row: _Row) -> Int[Tensor, " frames"]:
    return torch.cat([torch.full((frames,), segment) for segment, frames in row.stretches])
