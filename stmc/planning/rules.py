"""Other rules of composing crops in time, as plans made of plans: what `collage` follows is the rule.

`plan` itself lays out DiffCollage (Zhang et al. 2023): overlapping crops are added up and a crop without text, over the
overlap alone, is subtracted. Here are the same with soft edges, MultiDiffusion and DoubleTake. They mix predictions of
x0; since all weights of a frame sum to one, and every reverse step is affine in them, that is the same as mixing the
steps' results, with one noise for each frame of the timeline. Pure data: knows no features and no denoiser.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from itertools import groupby, pairwise

from stmc.body import BodyPart
from stmc.planning.plans import Crop, Plan, Span, Tile

Shares = Callable[[Sequence[Tile], int], Sequence[float]]
"""(tiles of one part that cover a frame, in order; the frame) → the weight of each; they sum to one."""


def soft(plan: Plan) -> Plan:
    """The plan's crops, which come and go along straight lines instead of all at once: over the first half of a
    transition the next crop is added more and more, over the second half the one before less and less, and what is
    subtracted follows. Ours: by DiffCollage's own weights a timeline jumps where a transition begins and where it ends.

    The plan is one of `planning.plan`, whose parts have a transition between any two of their tiles, or no overlap.
    """
    tiles: list[Tile] = []
    for part in BodyPart:
        own = [tile for tile in plan.tiles if tile.part == part]
        shown, lost = [tile for tile in own if tile.weight > 0], [tile for tile in own if tile.weight < 0]
        weights = [dict.fromkeys(range(tile.start, tile.end), 1.0) for tile in shown]
        for between, (before, after) in zip(lost, pairwise(weights), strict=False):
            half = (between.end - between.start) / 2
            for frame in range(between.start, between.end):
                way = (frame + 0.5 - between.start) / half
                before[frame] *= min(1.0, 2 - way)
                after[frame] *= min(1.0, way)
        covered = Counter(frame for tile in lost for frame in range(tile.start, tile.end))
        rest = {frame: (1 - sum(each.get(frame, 0.0) for each in weights)) / covered[frame] for frame in covered}
        weights += [{frame: rest[frame] for frame in range(tile.start, tile.end)} for tile in lost]
        for tile, by_frame in zip([*shown, *lost], weights, strict=True):
            tiles += [Tile(tile.crop, part, *span, weight) for span, weight in _spans(by_frame) if weight]
    return Plan(plan.frames, plan.crops, tuple(tiles))


def multi_diffusion(plan: Plan) -> Plan:
    """The plan's crops, without those of the transitions, averaged wherever they overlap (Bar-Tal et al. 2023)."""
    return _reweighted(plan, _average)


def handshake(plan: Plan) -> Plan:
    """The plan's crops, without those of the transitions, each fading into the next along a straight line wherever they
    overlap: DoubleTake's first take (Shafir et al. 2024), whose segments shake hands after every step.

    At the k-th of h shared frames, from 0, the next crop has the weight k / h.
    """
    return _reweighted(plan, _fade)


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


def transition_spans(plan: Plan, part: BodyPart | None = None) -> list[Span]:
    """The frames [start, end) of the plan's transitions, in order: all, or those of one part."""
    return sorted({(tile.start, tile.end) for tile in plan.tiles if tile.weight < 0 and part in (None, tile.part)})


def _centred(own: Span, widest: Span, longest: int) -> Span:
    """At most `longest` frames within `widest`, around `own`."""
    start = max(widest[0], min(sum(own) - longest >> 1, widest[1] - longest))
    return start, min(widest[1], start + longest)


def _average(tiles: Sequence[Tile], frame: int) -> list[float]:
    """Of the crops: one may have two tiles, around another that interrupts it."""
    counts = Counter(tile.crop for tile in tiles)
    return [1 / len(counts) / counts[tile.crop] for tile in tiles]


def _fade(tiles: Sequence[Tile], frame: int) -> list[float]:
    weights, last = [1.0], tiles[0].end
    for tile in tiles[1:]:
        share = (frame - tile.start) / (last - tile.start)
        weights = [*((1 - share) * weight for weight in weights), share]
        last = max(last, tile.end)
    return weights


def _reweighted(plan: Plan, shares: Shares) -> Plan:
    """The plan with the weights that `shares` gives where tiles overlap, and without the crops that it subtracts."""
    used = sorted({tile.crop for tile in plan.tiles if tile.weight > 0})
    number = {crop: new for new, crop in enumerate(used)}
    tiles = []
    for part in BodyPart:
        own = sorted(
            (tile for tile in plan.tiles if tile.part == part and tile.weight > 0), key=lambda tile: tile.start
        )
        edges = sorted({edge for tile in own for edge in (tile.start, tile.end)})
        weights: dict[int, dict[int, float]] = {tile.crop: {} for tile in own}
        for start, end in pairwise(edges):
            covering = [tile for tile in own if tile.start <= start and end <= tile.end]
            for frame in range(start, end):
                for tile, share in zip(covering, shares(covering, frame), strict=True):
                    weights[tile.crop][frame] = weights[tile.crop].get(frame, 0) + share
        for crop, by_frame in weights.items():
            tiles += [Tile(number[crop], part, *span, weight) for span, weight in _spans(by_frame) if weight]
    return Plan(plan.frames, tuple(plan.crops[crop] for crop in used), tuple(tiles))


def _spans(by_frame: dict[int, float]) -> list[tuple[Span, float]]:
    """Runs of consecutive frames with one weight."""
    frames = sorted(by_frame)
    runs = groupby(enumerate(frames), key=lambda pair: (pair[1] - pair[0], by_frame[pair[1]]))
    return [((run[0][1], run[-1][1] + 1), weight) for (_, weight), run in ((key, list(run)) for key, run in runs)]
