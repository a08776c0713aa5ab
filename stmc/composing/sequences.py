"""Body parts as sequences without crops: from a predictor of such sequences to a predictor of timelines.

See Barquero et al. (2024); here with several tracks. The prompts of a body part, from the first frame to the last, form
one sequence, which is denoised as a whole; there are no crops and no transitions. Body parts with the same prompts
share a sequence. At every step all sequences see the same composite motion, and each part is taken from its own
sequence. Plans have no overlap. Independent of text encoders, samplers and the meaning of the features beyond each
part's columns.
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
    """Frames [start, end) of a sequence that belong to a plan's `crop`."""

    crop: int
    start: int
    end: int


def body_sequences(plan: Plan) -> dict[tuple[Segment, ...], tuple[BodyPart, ...]]:
    """Return the distinct sequences of segments of a plan's body parts, each with its parts.

    Segments cover every frame of the plan once, in order. Raises `ValueError` if the plan has an overlap.
    """
    sequences: dict[tuple[Segment, ...], tuple[BodyPart, ...]] = {}
    for part in BodyPart:
        tiles = sorted((tile for tile in plan.tiles if tile.part == part), key=lambda tile: tile.start)
        if sum(tile.end - tile.start for tile in tiles) != plan.frames:
            raise ValueError(f"the tiles of the {part} overlap; sequences need plans with overlap=0")
        sequence = tuple(Segment(tile.crop, tile.start, tile.end) for tile in tiles)
        sequences[sequence] = (*sequences.get(sequence, ()), part)
    return sequences


def compose_tracks(predict: Predict, plans: Sequence[Plan], columns: Columns) -> Predict:
    """Build a predictor of timelines [batch, frames, features] from a predictor of their sequences.

    `predict` receives every timeline once for each of its `body_sequences`, those of plan 0 first; the columns of each
    body part are then taken from its own sequence.

    Args:
        predict: Predictor of sequences.
        plans: Plans without overlap.
        columns: Columns of each body part.
    """
    timelines: list[int] = []
    rows: dict[tuple[int, BodyPart], int] = {}
    for i, plan in enumerate(plans):
        for parts in body_sequences(plan).values():
            rows |= {(i, part): len(timelines) for part in parts}
            timelines.append(i)
    owners = [(list(columns[part]), torch.tensor([rows[i, part] for i in range(len(plans))])) for part in columns]
    indexes = PerDevice(
        lambda x: (
            torch.tensor(timelines, device=x.device),
            [(torch.tensor(owned, dtype=torch.int64, device=x.device), row.to(x.device)) for owned, row in owners],
        )
    )

    def predict_composed(x: Float[Tensor, "batch frames features"], t: int) -> Float[Tensor, "batch frames features"]:
        timeline, parts = indexes.at(x)
        sequences, x0 = predict(x[timeline], t), torch.empty_like(x)
        for owned, row in parts:
            x0[..., owned] = sequences[row][..., owned]
        return x0

    return predict_composed
