"""The tracks of a timeline: the row of each prompt in a drawing, such that the prompts of a row do not overlap."""

from __future__ import annotations

from bisect import bisect
from collections.abc import Sequence

import numpy as np

Span = tuple[float, float]
"""A half-open span [start, end) in seconds."""


def first_fit(spans: Sequence[Span]) -> tuple[int, ...]:
    """Assign each span, in turn, to the first row that is free while it lasts."""
    starts, ends = np.array(spans, dtype=np.float64).T
    rows = np.zeros(len(spans), dtype=np.int64)
    for index, (start, end) in enumerate(spans):
        taken = rows[:index][(starts[:index] < end) & (start < ends[:index])]
        free = np.ones(index + 1, dtype=bool)
        free[taken] = False
        rows[index] = free.argmax()
    return tuple(rows.tolist())


def renumbered(rows: Sequence[int]) -> tuple[int, ...]:
    """Renumber rows from 0 without gaps, in the same order."""
    numbers = {row: number for number, row in enumerate(sorted(set(rows)))}
    return tuple(numbers[row] for row in rows)


def crowded(spans: Sequence[Span], rows: Sequence[int]) -> tuple[int, int] | None:
    """Find the first span that overlaps an earlier span of its row; return both indices, or None."""
    tracks: dict[int, list[Span]] = {}
    for later, (row, span) in enumerate(zip(rows, spans, strict=True)):
        track = tracks.setdefault(row, [])  # sorted; its spans do not overlap
        index = bisect(track, span)
        if any(_overlap(span, other) for other in track[max(0, index - 1) : index + 1]):
            return later, next(n for n in range(later) if rows[n] == row and _overlap(span, spans[n]))
        track.insert(index, span)
    return None


def _overlap(one: Span, other: Span) -> bool:
    return one[0] < other[1] and other[0] < one[1]
