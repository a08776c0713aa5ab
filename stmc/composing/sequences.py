"""Body parts as seamless sequences: from a predictor of such sequences to a predictor of timelines
(Barquero et al. 2024, here with several tracks).

What a body part obeys from the first frame to the last, prompt after prompt, is one sequence, denoised whole; there are
no crops and no transitions. Parts that obey the same share one. At every step all sequences see the same composite
motion, and each part is taken from its own. The plans are those without overlap. Knows no text encoders, no samplers
and no meaning of the features beyond each part's columns.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from stmc.composing.stitching import Columns
from stmc.diffusion import Predict
from stmc.diffusion.tensors import PerDevice
from stmc.motion.body import BodyPart
from stmc.timeline.planning import Plan


class Segment(NamedTuple):
    """Frames [start, end) of a sequence, which belong to a plan's `crop`."""

    crop: int
    start: int
    end: int


def body_sequences(plan: Plan) -> dict[tuple[Segment, ...], tuple[BodyPart, ...]]:
    """The distinct sequences of segments that the body parts of a plan obey, each with the parts that obey it.

    Segments cover every frame of the plan once, in order. Raises `ValueError` for a plan with overlap.
    """
    sequences: dict[tuple[Segment, ...], tuple[BodyPart, ...]] = {}
    for part in BodyPart:
        tiles = sorted((tile for tile in plan.tiles if tile.part == part), key=lambda tile: tile.start)
        if sum(tile.end - tile.start for tile in tiles) != plan.frames:
            raise ValueError(f"the tiles of the {part} overlap: sequences are made of plans with overlap=0")
        sequence = tuple(Segment(tile.crop, tile.start, tile.end) for tile in tiles)
        sequences[sequence] = (*sequences.get(sequence, ()), part)
    return sequences


def compose_tracks(predict: Predict, plans: Sequence[Plan], columns: Columns) -> Predict:
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
    indexes = PerDevice(
        lambda x: (
            torch.tensor(timelines, device=x.device),
            [(torch.tensor(own, dtype=torch.int64, device=x.device), row.to(x.device)) for own, row in owners],
        )
    )

    def composed(x: Float[Tensor, "batch frames features"], t: int) -> Float[Tensor, "batch frames features"]:
        timeline, parts = indexes.at(x)
        sequences, x0 = predict(x[timeline], t), torch.empty_like(x)
        for own, row in parts:
            x0[..., own] = sequences[row][..., own]
        return x0

    return composed
