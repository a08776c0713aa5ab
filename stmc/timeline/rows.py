"""The tracks of a timeline: in which row each prompt is drawn, such that the prompts of a row follow each other."""

from __future__ import annotations

from bisect import bisect
from collections.abc import Sequence

import numpy as np

Span = tuple[float, float]
"""Seconds [start, end)."""


def first_fit(spans: Sequence[Span]) -> tuple[int, ...]:
    """For each span in turn, the first row that is free while it lasts."""
    starts, ends = np.array(spans, dtype=np.float64).T
    rows = np.zeros(len(spans), dtype=np.int64)
    for index, (start, end) in enumerate(spans):
        taken = rows[:index][(starts[:index] < end) & (start < ends[:index])]
        free = np.ones(index + 1, dtype=bool)
        free[taken] = False
        rows[index] = free.argmax()
    return tuple(rows.tolist())


def renumbered(rows: Sequence[int]) -> tuple[int, ...]:
    """The same rows counted from 0, without holes."""
    numbers = {row: number for number, row in enumerate(sorted(set(rows)))}
    return tuple(numbers[row] for row in rows)


def crowded(spans: Sequence[Span], rows: Sequence[int]) -> tuple[int, int] | None:
    """The first span that shares its row and some of its time with an earlier one: its index, and that one's."""
    tracks: dict[int, list[Span]] = {}
    for later, (row, span) in enumerate(zip(rows, spans, strict=True)):
        track = tracks.setdefault(row, [])  # sorted, each of its spans apart from the others
        place = bisect(track, span)
        if any(_together(span, other) for other in track[max(0, place - 1) : place + 1]):
            return later, next(n for n in range(later) if rows[n] == row and _together(span, spans[n]))
        track.insert(place, span)
    return None


def _together(one: Span, other: Span) -> bool:
    return one[0] < other[1] and other[0] < one[1]
