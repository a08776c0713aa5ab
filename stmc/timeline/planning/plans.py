"""From a timeline to a plan in frames: requests to a denoiser, and the destinations of its predictions.

See section 3.3 of STMC. Pure data: independent of features and denoisers. To follow a plan, add up the predictions of
the crops with the weights of the tiles, at every frame and body part.
"""

from __future__ import annotations

import math
from bisect import bisect_left, bisect_right
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from itertools import accumulate, chain, pairwise
from operator import itemgetter
from typing import NamedTuple

from stmc.motion.body import BodyPart
from stmc.timeline import Timeline
from stmc.timeline.planning.assignment import Run, assign
from stmc.timeline.planning.plan_printing import draw

Span = tuple[int, int]
"""Frames [start, end)."""


@dataclass(frozen=True)
class Crop:
    """One row of the denoiser's batch: frames [start, end) of the timeline, with a text or, for None, without one."""

    text: str | None
    start: int
    end: int

    @property
    def frames(self) -> int:
        """The length of the crop."""
        return self.end - self.start


@dataclass(frozen=True)
class Tile:
    """The destination of one body part of one crop: frames [start, end) of the timeline, added with `weight`.

    The weight is 1 or -1 in a `plan`, and any number between in plans that `rules` transform. Within the crop, the tile
    covers the frames from `start - crop.start` on.
    """

    crop: int
    part: BodyPart
    start: int
    end: int
    weight: int | float


@dataclass(frozen=True)
class Plan:
    r"""The layout of one timeline in frames.

    Args:
        frames: Length of the timeline.
        crops: Prompts in the file's order (a long one as several crops), then gaps, then transitions, in time order.
        tiles: Tiles by body part; `Tile.crop` is an index into `crops`.

    Raises:
        ValueError: Unless every tile lies within its crop and the timeline, and the weights sum to 1 at every (frame,
            body part). Combining predictions of x0, of the noise or of the score is then equivalent.

    Examples:
        >>> timeline = stmc.Timeline.parse("walk # 0 # 4 # legs\nwave # 1 # 3 # right arm")
        >>> print(stmc.plan(timeline, fps=20, overlap=10))
        plan: 80 frames, 4 crops
        a          [walk··························································]  0 to 80
        b                      [wave··································]              15 to 65
        c                      [······]                                              15 to 25
        d                                                      [······]              55 to 65
        left arm   aaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaa
        right arm  aaaaaaaaaaaa~~~~~~~~bbbbbbbbbbbbbbbbbbbbbbbb~~~~~~~~aaaaaaaaaaaa
        legs       aaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaa
        head       aaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaa
        spine      aaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaa
    """

    frames: int
    crops: tuple[Crop, ...]
    tiles: tuple[Tile, ...]

    def __post_init__(self) -> None:
        for crop in self.crops:
            if not 0 <= crop.start < crop.end <= self.frames:
                raise ValueError(f"{crop} is empty or not within the timeline's {self.frames} frames")
        changes: dict[BodyPart, dict[int, float]] = {part: {0: 0, self.frames: 0} for part in BodyPart}
        for tile in self.tiles:
            if not 0 <= tile.crop < len(self.crops):
                raise ValueError(f"{tile} refers to none of the {len(self.crops)} crops")
            crop = self.crops[tile.crop]
            if not crop.start <= tile.start < tile.end <= crop.end:
                raise ValueError(f"{tile} is empty or not within {crop}")
            change = changes[tile.part]
            change[tile.start] = change.get(tile.start, 0) + tile.weight
            change[tile.end] = change.get(tile.end, 0) - tile.weight
        for part, change in changes.items():
            times = sorted(change)
            sums = accumulate(change[time] for time in times[:-1])
            for time, total in zip(times, sums, strict=False):
                if not math.isclose(total, 1, abs_tol=1e-6):
                    raise ValueError(f"the weights of the {part} sum to {total} instead of 1 from frame {time} on")

    def __str__(self) -> str:
        """Draw the crops to scale, and the crop that each body part follows."""
        return draw(self.frames, self.crops, self.tiles)


def plan(
    timeline: Timeline,
    fps: int | float,
    overlap: int,
    longest: int | None = None,
    one_shot: Collection[str] = (),
    window: Span | None = None,
) -> Plan:
    r"""Lay out a timeline in crops and tiles.

    Every prompt, and every gap, becomes a crop, widened by half the overlap on both sides within the timeline. Around
    each frame where some body part changes its owner lies one crop without text, `overlap` frames long, which is
    subtracted from the parts that change there (Figure 3b; DiffCollage). The longer half of an odd overlap is on the
    right. A prompt that owns no body part anywhere is not planned (R12); an edge that moves no part is no transition
    (R3).

    Args:
        timeline: The timeline; its first frame is second 0.
        fps: Frames per second.
        overlap: Length of a transition in frames, 2 l in the paper. 0 widens nothing and plans no transitions: each
            body part is then selected from one crop, as in SINC (R11).
        longest: Maximum number of frames that the denoiser accepts. A prompt or gap whose widened crop would be longer
            is split into the fewest equal pieces that fit, with the same text, joined like any other transition.
        one_shot: Texts of one-shot actions, whatever their duration. Only the first piece of such a prompt has the
            text, the others have none: nobody sits down every ten seconds.
        window: Frames to plan; None plans all. Frame 0 of the plan is then the window's first frame. Pieces are those
            of the whole timeline, cut at the ends of the window, which may lie after the timeline's end, in a gap.

    Raises:
        TimelineError: If the timeline lasts no frame, or more than `stmc.timeline.prompts.MOST_FRAMES`.
        ValueError: If the overlap is negative, if `longest` leaves no room for a piece and its overlap, or if the
            window is empty or starts before frame 0.

    Examples:
        >>> timeline = stmc.Timeline.parse("walk # 0 # 2\njump # 2 # 4")
        >>> [(crop.text, crop.start, crop.end) for crop in stmc.plan(timeline, fps=20, overlap=10).crops]
        [('walk', 0, 45), ('jump', 35, 80), (None, 35, 45)]
    """
    first, last = window or (0, timeline.frames(fps))
    owners, spans = assign(timeline, fps, last), timeline.spans(fps)
    frames = max(timeline.frames(fps), last)
    _check(frames, overlap, longest, (first, last))
    split = cache(_Widening((0, frames), overlap, longest or frames).split)
    widening = _Widening((first, last), overlap, longest or frames)
    runs = {part: _cut_runs(owners[part], spans, split, (first, last)) for part in BodyPart}
    pieces = sorted({owned.piece for part in BodyPart for owned in runs[part]}, key=_row_order)
    changes = sorted({owned.start for part in BodyPart for owned in runs[part][1:]}) if overlap else []
    texts = [_text(timeline, piece, spans, one_shot) for piece in pieces]
    crops = [Crop(text, *widening.widen(piece.start, piece.end)) for text, piece in zip(texts, pieces, strict=True)]
    crops += [Crop(None, *widening.widen(frame, frame)) for frame in changes]
    keys: list[_Piece | int] = [*pieces, *changes]
    rows = {key: row for row, key in enumerate(keys)}
    tiles = []
    for part in BodyPart:
        tiles += [Tile(rows[run.piece], part, *widening.widen(run.start, run.end), 1) for run in runs[part]]
        inner = [run.start for run in runs[part][1:]] if overlap else []
        tiles += [Tile(rows[frame], part, *widening.widen(frame, frame), -1) for frame in inner]
    return Plan(last - first, tuple(crops), tuple(tiles))


class _Piece(NamedTuple):
    """A prompt or, for None, a gap; or one of the equal pieces of a long one."""

    prompt: int | None
    start: int
    end: int


class _Owned(NamedTuple):
    """The frames of a piece that one body part follows."""

    piece: _Piece
    start: int
    end: int


class _Widening(NamedTuple):
    """Widening of spans by half an overlap, within some frames; `widen` counts from the first of them on."""

    within: Span
    overlap: int
    longest: int

    def widen(self, start: int, end: int) -> Span:
        (first, last), left = self.within, self.overlap // 2
        return max(first, start - left) - first, min(last, end + self.overlap - left) - first

    def split(self, start: int, end: int) -> list[Span]:
        """Split a span into the fewest equal pieces that have at most `longest` frames when widened.

        Pieces of at most `longest - overlap` frames always fit. A longer piece fits only if the ends of the timeline
        clip its widening, which happens for at most `overlap + 2` pieces. Above that count, only numbers of pieces just
        below the always sufficient number can have so few longer pieces.
        """
        fewest, room = math.ceil((end - start) / self.longest), self.longest - self.overlap
        enough = math.ceil((end - start) / room) if room > 0 else fewest
        few = range(fewest, min(self.overlap + 3, enough))
        many = range(max(fewest, enough - self.overlap - 3), enough + 1)
        pieces = next(pieces for pieces in chain(few, many) if self._fits(start, end, pieces))
        return list(_pieces(start, end, pieces))

    def _fits(self, start: int, end: int, pieces: int) -> bool:
        widened = (self.widen(*span) for span in _pieces(start, end, pieces))
        return all(right - left <= self.longest for left, right in widened)


def _pieces(start: int, end: int, count: int) -> Iterator[Span]:
    return pairwise(start + (end - start) * piece // count for piece in range(count + 1))


def _cut_runs(
    runs: Sequence[Run], spans: Sequence[Span], split: Callable[[int, int], list[Span]], window: Span
) -> list[_Owned]:
    """Cut the runs of one body part within a window where the pieces of their prompts meet. A gap is its own span."""
    owned = []
    for prompt, start, end in runs:
        if start >= window[1] or end <= window[0]:
            continue
        pieces = split(*((start, end) if prompt is None else spans[prompt]))
        start, end = max(start, window[0]), min(end, window[1])
        first = bisect_right(pieces, start, key=itemgetter(1))
        for left, right in pieces[first : bisect_left(pieces, end, key=itemgetter(0))]:
            owned.append(_Owned(_Piece(prompt, left, right), max(left, start), min(right, end)))
    return owned


def _text(timeline: Timeline, piece: _Piece, spans: Sequence[Span], one_shot: Collection[str]) -> str | None:
    if piece.prompt is None:
        return None
    text = timeline.prompts[piece.prompt].text
    return None if text in one_shot and piece.start > spans[piece.prompt][0] else text


def _row_order(piece: _Piece) -> tuple[bool, int, int]:
    return piece.prompt is None, piece.prompt or 0, piece.start


def _check(frames: int, overlap: int, longest: int | None, window: Span) -> None:
    if not 0 <= window[0] < window[1]:
        raise ValueError(f"window {list(window)} must be frames [start, end) from 0 on")
    if overlap < 0:
        raise ValueError(f"overlap {overlap} must be 0 frames or more")
    if longest is not None and longest <= min(overlap, frames - 1):
        raise ValueError(
            f"longest {longest} must be more than the overlap of {overlap} frames (or hold all {frames} frames), "
            "so that each piece of a long prompt can be widened"
        )
