"""Other rules of composing crops in time, as plans made of plans: what `collage` follows is the rule.

`plan` itself lays out DiffCollage (Zhang et al. 2023): overlapping crops are added up and a crop without text, over the
overlap alone, is subtracted. Here are the same with cross-faded edges, MultiDiffusion and DoubleTake. They mix
predictions of x0; since all weights of a frame sum to one, and every reverse step is affine in them, that is the same
as mixing the steps' results, with one noise for each frame of the timeline. Pure data: knows no features and no
denoiser.

A rule of your own is any function `Plan → Plan`. Where it only weighs the plan's crops anew, write down the weights and
let `reweighted` do the rest.
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
"""How much each crop, or each tile, counts at each frame of the timeline, for one body part."""

Weigh = Callable[[Weights, Weights], None]
"""Weighs, in place, one body part's tiles: those that are added and those of transitions, each in order of time, and 1
where a tile is, else 0. At every frame, all weights are to sum to 1."""


def cross_fade(plan: Plan) -> Plan:
    """The plan's crops, which come and go along straight lines instead of all at once: over the first half of a
    transition the next crop is added more and more, over the second half the one before less and less, and what is
    subtracted follows. Ours: by DiffCollage's own weights a timeline jumps where a transition begins and where it ends.

    The plan is one of `planning.plan`, whose parts have a transition between any two of their tiles, or no overlap.
    """

    def weigh(shown: Weights, transitions: Weights) -> None:
        for transition, before, after in zip(transitions, shown, shown[1:], strict=False):
            [frames] = transition.nonzero()
            way = 2 * (np.arange(len(frames)) + 0.5) / len(frames)
            before[frames] *= np.minimum(1, 2 - way)
            after[frames] *= np.minimum(1, way)
        transitions *= (1 - shown.sum(axis=0)) / np.maximum(1, transitions.sum(axis=0))

    return reweighted(plan, weigh)


def handshake(plan: Plan) -> Plan:
    """The plan's crops, without those of the transitions, each fading into the next along a straight line wherever they
    overlap: DoubleTake's first take (Shafir et al. 2024), whose segments shake hands after every step.

    At the k-th of h shared frames, from 0, the next crop has the weight k / h.
    """

    def weigh(shown: Weights, transitions: Weights) -> None:
        transitions[:] = 0
        last = 0
        for row, tile in enumerate(shown):
            [frames] = tile.nonzero()
            tile[frames] = np.minimum(1, (frames - frames[0]) / max(1, last - frames[0])) if frames[0] < last else 1
            shown[:row] *= 1 - tile
            last = max(last, frames[-1] + 1)

    return reweighted(plan, weigh)


def multi_diffusion(plan: Plan) -> Plan:
    """The plan's crops, without those of the transitions, averaged wherever they overlap (Bar-Tal et al. 2023)."""
    weights = {}
    for part in BodyPart:
        there = np.zeros((len(plan.crops), plan.frames))
        for tile in plan.tiles:
            if tile.part == part and tile.weight > 0:
                there[tile.crop, tile.start : tile.end] = 1
        weights[part] = there / there.sum(axis=0)
    return weighted(plan, weights)


def reweighted(plan: Plan, weigh: Weigh) -> Plan:
    """The plan with its tiles weighed anew, part by part: see `Weigh`."""
    weights = {}
    for part in BodyPart:
        tiles = sorted((tile for tile in plan.tiles if tile.part == part), key=lambda tile: tile.start)
        shown, transitions = ([tile for tile in tiles if (tile.weight > 0) == added] for added in (True, False))
        rows = _present(shown, plan.frames), _present(transitions, plan.frames)
        weigh(*rows)
        weights[part] = np.zeros((len(plan.crops), plan.frames))
        np.add.at(weights[part], [tile.crop for tile in (*shown, *transitions)], np.concatenate(rows))
    return weighted(plan, weights)


def weighted(plan: Plan, weights: Mapping[BodyPart, Weights]) -> Plan:
    """The plan's crops with these weights [crops, frames], without the crops that count nowhere. Raises `ValueError`
    where they do not sum to 1, or are of frames that a crop does not have."""
    used = np.flatnonzero(sum(np.abs(each).sum(axis=1) for each in weights.values())).tolist()
    tiles = [
        Tile(number, part, start, end, weight)
        for part in BodyPart
        for number, crop in enumerate(used)
        for start, end, weight in _runs(weights[part][crop])
    ]
    return Plan(plan.frames, tuple(plan.crops[crop] for crop in used), tuple(tiles))


def second_take(plan: Plan, longest: int | None = None) -> Plan:
    """Crops without text, each around one transition, up to the transitions beside it: what DoubleTake's second take
    denoises again. Where two overlap, each has the half that is nearer to its transition.

    A crop of more than `longest` frames (None: as published, any number) is cut to as many around its transition; what
    then belongs to none becomes crops of its own. The plan is one with overlap.
    """
    spans = transition_spans(plan)
    edges = [0, *((end + start) // 2 for (_, end), (start, _) in pairwise(spans)), plan.frames]
    ends, starts = [0, *(end for _, end in spans)], [*(start for start, _ in spans[1:]), plan.frames]
    crops, tiles = [], []
    for own, before, after, edge in zip(spans or [(0, plan.frames)], ends, starts, pairwise(edges), strict=False):
        widest = min(before, edge[0], own[0]), max(after, edge[1], own[1])
        left, right = widest if longest is None else _centred(own, widest, longest)
        for start, end in ((edge[0], left), (left, right), (right, edge[1])):
            if start < end:
                shown = max(start, edge[0]), min(end, edge[1])
                tiles += [Tile(len(crops), part, *shown, 1) for part in BodyPart]
                crops.append(Crop(None, start, end))
    return Plan(plan.frames, tuple(crops), tuple(tiles))


def look_back(plan: Plan, frames: int) -> Plan:
    """The plan with crops that begin up to `frames` earlier and count where they did: what an action sees of the ones
    before it (TEACH, Athanasiou et al. 2022). The plan is one without overlap."""
    crops = (replace(crop, start=max(0, crop.start - frames)) for crop in plan.crops)
    return Plan(plan.frames, tuple(crops), plan.tiles)


def transition_spans(plan: Plan, part: BodyPart | None = None) -> list[Span]:
    """The frames [start, end) of the plan's transitions, in order: all, or those of one part."""
    return sorted({(tile.start, tile.end) for tile in plan.tiles if tile.weight < 0 and part in (None, tile.part)})


def _centred(own: Span, widest: Span, longest: int) -> Span:
    """At most `longest` frames within `widest`, around `own`."""
    start = max(widest[0], min(sum(own) - longest >> 1, widest[1] - longest))
    return start, min(widest[1], start + longest)


def _present(tiles: Sequence[Tile], frames: int) -> Weights:
    frame = np.arange(frames)
    spans = np.array([(tile.start, tile.end) for tile in tiles], dtype=int).reshape(-1, 2, 1)
    return ((spans[:, 0] <= frame) & (frame < spans[:, 1])).astype(float)


def _runs(weights: np.ndarray) -> list[tuple[int, int, float]]:
    """Runs [start, end) of consecutive frames with one weight, but for 0."""
    edges = [0, *(np.flatnonzero(np.diff(weights)) + 1).tolist(), len(weights)]
    return [(start, end, float(weights[start])) for start, end in pairwise(edges) if weights[start]]
