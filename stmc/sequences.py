"""Body parts as seamless sequences: from a denoiser that knows a text for every frame to a predictor of timelines
(Barquero et al. 2024, here with several tracks).

What a body part obeys from the first frame to the last, prompt after prompt, is one sequence, denoised whole; there are
no crops and no transitions. Parts that obey the same share one. At every step all sequences see the same composite
motion, and each part is taken from its own. The plans are those without overlap. Knows no text encoders, no samplers
and no meaning of the features beyond each part's columns.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple, Protocol, runtime_checkable

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from stmc.body import BodyPart
from stmc.compose import NULL, Columns, check_embeddings, distinct_texts
from stmc.diffusion import Predict, Prediction, Schedule
from stmc.passes import Guided, Row
from stmc.planning import Plan
from stmc.tensors import Moved

PADDING = 0.1
"""Which share of the frames that a step denoises may be padding."""


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
) -> Guided:
    """A predictor of the sequences of all plans, [sequences, frames, features], with classifier-free guidance.

    `embeddings` gives the normalised embedding, one word, of every text in `distinct_texts(plans)`. A sequence with any
    text is denoised with its texts, and in a second pass with the same segments but no text: see `Guided`. Raises
    `ValueError` for a text without an embedding, or with more words than one, and for plans with overlap.
    """
    check_embeddings(plans, embeddings)
    if long := [text for text in distinct_texts(plans) if len(embeddings[text]) != 1]:
        raise ValueError(f"a segment's text is one word, but {long[0]!r} has {len(embeddings[long[0]])}")
    rows = [_row(plan, sequence, embeddings) for plan in plans for sequence in body_sequences(plan)]
    return Guided(denoiser, schedule, rows, weight, prediction, PADDING, budget, mixed=True)


def _row(plan: Plan, sequence: Sequence[Stretch], embeddings: Mapping[str, Tensor]) -> Row:
    """A word and a segment for each crop, also for one that comes back behind another."""
    crops = list(dict.fromkeys(stretch.crop for stretch in sequence))
    texts = [plan.crops[crop].text or NULL for crop in crops]
    told, null = (torch.cat([embeddings[text] for text in each]) for each in (texts, [NULL] * len(texts)))
    segment = torch.cat([torch.full((end - start,), crops.index(crop)) for crop, start, end in sequence])
    return Row(plan.frames, plan.frames, null, told if any(text != NULL for text in texts) else None, segment)
