"""Other rules of composing crops in time, expressed as transformations of plans.

`plan` itself lays out DiffCollage (Zhang et al. 2023): overlapping crops are added up and a crop without text, over the
overlap alone, is subtracted. This module adds the same with cross-faded edges, MultiDiffusion and DoubleTake. The rules
mix predictions of x0. All weights of a frame sum to one and every reverse step is affine in the predictions, so this
equals mixing the results of the steps with one noise per frame of the timeline. Pure data: independent of features and
denoisers.

A custom rule is any function `Plan → Plan`. If it only changes the weights of the plan's crops, write down the weights
and call `reweighted`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np
from jaxtyping import Float64

from stmc.motion.body import BodyPart
from stmc.timeline.planning.plans import Crop, Plan, Span, Tile

Weights = Float64[np.ndarray, "_ frames"]
"""The weight of each crop, or each tile, at each frame of the timeline, for one body part."""

Weigh = Callable[[Weights, Weights], None]
"""A function that sets the weights of one body part's tiles in place.

Its arguments are the added tiles and the tiles of transitions, each in time order, with 1 where a tile is and 0
elsewhere. Afterwards all weights must sum to 1 at every frame.
"""


def cross_fade(plan: Plan) -> Plan:
    """Fade the crops of a plan in and out linearly instead of abruptly.

    Over the first half of a transition the weight of the next crop grows; over the second half the weight of the
    previous crop falls; the subtracted weight follows. This rule is ours: with the weights of DiffCollage a timeline
    jumps where a transition begins and where it ends.

    `plan` must come from `planning.plan` and have a transition between any two tiles of a part, or no overlap.
    """

    def weigh(added: Weights, transitions: Weights) -> None:
        for transition, before, after in zip(transitions, added, added[1:], strict=False):
            [frames] = transition.nonzero()
            progress = 2 * (np.arange(len(frames)) + 0.5) / len(frames)
            before[frames] *= np.minimum(1, 2 - progress)
            after[frames] *= np.minimum(1, progress)
        transitions *= (1 - added.sum(axis=0)) / np.maximum(1, transitions.sum(axis=0))

    return reweighted(plan, weigh)


def handshake(plan: Plan) -> Plan:
    """Fade each crop linearly into the next wherever they overlap, without the crops of transitions.

    This is DoubleTake's first take (Shafir et al. 2024), whose segments shake hands after every step. At frame k (from
    0) of h shared frames the weight of the next crop is k / h.
    """

    def weigh(added: Weights, transitions: Weights) -> None:
        transitions[:] = 0
        last = 0
        for row, tile in enumerate(added):
            [frames] = tile.nonzero()
            tile[frames] = np.minimum(1, (frames - frames[0]) / max(1, last - frames[0])) if frames[0] < last else 1
            added[:row] *= 1 - tile
            last = max(last, frames[-1] + 1)

    return reweighted(plan, weigh)


def multi_diffusion(plan: Plan) -> Plan:
    """Average the crops of a plan wherever they overlap, without those of transitions (Bar-Tal et al. 2023)."""
    weights = {}
    for part in BodyPart:
        covered = np.zeros((len(plan.crops), plan.frames))
        for tile in plan.tiles:
            if tile.part == part and tile.weight > 0:
                covered[tile.crop, tile.start : tile.end] = 1
        weights[part] = covered / covered.sum(axis=0)
    return weighted(plan, weights)


def reweighted(plan: Plan, weigh: Weigh) -> Plan:
    """Change the weights of a plan's tiles, part by part, with a `Weigh` function."""
    weights = {}
    for part in BodyPart:
        tiles = sorted((tile for tile in plan.tiles if tile.part == part), key=lambda tile: tile.start)
        added, transitions = ([tile for tile in tiles if (tile.weight > 0) == positive] for positive in (True, False))
        matrices = _present(added, plan.frames), _present(transitions, plan.frames)
        weigh(*matrices)
        weights[part] = np.zeros((len(plan.crops), plan.frames))
        np.add.at(weights[part], [tile.crop for tile in (*added, *transitions)], np.concatenate(matrices))
    return weighted(plan, weights)


def weighted(plan: Plan, weights: Mapping[BodyPart, Weights]) -> Plan:
    """Build a plan from the crops of a plan and new weights [crops, frames], dropping crops without weight.

    Raises `ValueError` if the weights do not sum to 1, or are nonzero at frames that a crop does not have.
    """
    used = np.flatnonzero(sum(np.abs(part_weights).sum(axis=1) for part_weights in weights.values())).tolist()
    tiles = [
        Tile(number, part, start, end, weight)
        for part in BodyPart
        for number, crop in enumerate(used)
        for start, end, weight in _runs(weights[part][crop])
    ]
    return Plan(plan.frames, tuple(plan.crops[crop] for crop in used), tuple(tiles))


def second_take(plan: Plan, longest: int | None = None) -> Plan:
    """Plan the crops of DoubleTake's second take: one crop without text around each transition.

    Each crop reaches to the neighbouring transitions. Where two crops overlap, each owns the half nearer to its
    transition. A crop of more than `longest` frames (None, as published, is unlimited) is cut to that many around its
    transition; frames that then belong to no crop become crops of their own. `plan` must have an overlap.
    """
    spans = transition_spans(plan)
    edges = [0, *((end + start) // 2 for (_, end), (start, _) in pairwise(spans)), plan.frames]
    ends, starts = [0, *(end for _, end in spans)], [*(start for start, _ in spans[1:]), plan.frames]
    crops: list[Crop] = []
    tiles: list[Tile] = []
    for transition, before, after, edge in zip(
        spans or [(0, plan.frames)], ends, starts, pairwise(edges), strict=False
    ):
        widest = min(before, edge[0], transition[0]), max(after, edge[1], transition[1])
        left, right = widest if longest is None else _centred(transition, widest, longest)
        for start, end in ((edge[0], left), (left, right), (right, edge[1])):
            if start < end:
                visible = max(start, edge[0]), min(end, edge[1])
                tiles += [Tile(len(crops), part, *visible, 1) for part in BodyPart]
                crops.append(Crop(None, start, end))
    return Plan(plan.frames, tuple(crops), tuple(tiles))


def look_back(plan: Plan, frames: int) -> Plan:
    """Start each crop up to `frames` earlier without moving its tiles, so that an action sees the previous ones.

    This is the context of TEACH (Athanasiou et al. 2022). `plan` must have no overlap.
    """
    crops = (replace(crop, start=max(0, crop.start - frames)) for crop in plan.crops)
    return Plan(plan.frames, tuple(crops), plan.tiles)


def transition_spans(plan: Plan, part: BodyPart | None = None) -> list[Span]:
    """Return the frames [start, end) of the plan's transitions, in order, for all parts or one part."""
    return sorted({(tile.start, tile.end) for tile in plan.tiles if tile.weight < 0 and part in (None, tile.part)})


def _centred(transition: Span, widest: Span, longest: int) -> Span:
    """Choose at most `longest` frames within `widest`, around `own`."""
    start = max(widest[0], min(sum(transition) - longest >> 1, widest[1] - longest))
    return start, min(widest[1], start + longest)


def _present(tiles: Sequence[Tile], frames: int) -> Weights:
    frame = np.arange(frames)
    spans = np.array([(tile.start, tile.end) for tile in tiles], dtype=int).reshape(-1, 2, 1)
    return ((spans[:, 0] <= frame) & (frame < spans[:, 1])).astype(float)


def _runs(weights: np.ndarray) -> list[tuple[int, int, float]]:
    """Return the runs [start, end) of consecutive frames with one nonzero weight."""
    edges = [0, *(np.flatnonzero(np.diff(weights)) + 1).tolist(), len(weights)]
    return [(start, end, float(weights[start])) for start, end in pairwise(edges) if weights[start]]
