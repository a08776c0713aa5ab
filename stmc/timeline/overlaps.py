"""The prompts that hold at each time, and their precedence for each body part (STMC, Appendix B).

Time is swept from the first start to the last end, so that n prompts cost n log n, however many hold at once.
"""

from __future__ import annotations

from bisect import bisect_left, insort
from collections.abc import Iterable, Iterator, Sequence
from itertools import pairwise
from typing import TypeVar

from stmc.motion.body import BodyPart

Time = TypeVar("Time", int, float)
"""Frames or seconds."""

Interval = tuple[Time, Time, list[int], list[int]]
"""Start and end, in seconds or frames; the indices of the spans that end and that start at its start."""


def sweep(spans: Iterable[tuple[Time, Time]]) -> Iterator[Interval[Time]]:
    """Cut time at every start and end (Appendix B, Figure A.1 left), including gaps; empty spans are ignored."""
    events: dict[Time, tuple[list[int], list[int]]] = {}
    for index, (start, end) in enumerate(spans):
        if start < end:
            events.setdefault(start, ([], []))[1].append(index)
            events.setdefault(end, ([], []))[0].append(index)
    times: list[Time] = sorted(events)
    for left, right in pairwise(times):
        ended, started = events[left]
        yield left, right, ended, started


def elementary(spans: Iterable[tuple[Time, Time]]) -> Iterator[tuple[Time, Time, tuple[int, ...]]]:
    """Yield the intervals of `sweep`, each with the indices of all spans that hold throughout."""
    active: set[int] = set()
    for start, end, ended, started in sweep(spans):
        active = (active - set(ended)) | set(started)
        yield start, end, tuple(sorted(active))


class Precedence:
    """The prompts that hold at one time of a sweep, and SINC's order among them.

    The base is the prompt with most parts among those that claim the legs, or among all prompts if none claims the
    legs. It owns the whole body, and every other prompt overrides it at the parts it claims. Among several prompts that
    claim a part, the one with fewer parts owns it, then the later one in the file's order (Appendix B; R2); the base
    always yields.
    """

    def __init__(self, parts: Sequence[frozenset[BodyPart]]) -> None:
        """Start before the first interval.

        `parts` lists the body parts of each prompt; an empty set means that the prompt claims all parts.
        """
        self._parts = parts
        self._order = sorted(range(len(parts)), key=lambda index: (len(parts[index] or BodyPart), -index))
        self._ranks = {index: rank for rank, index in enumerate(self._order)}  # a lower rank overrides a higher one
        self._unlisted: list[int] = []  # sorted ranks of the prompts that list no part and so claim all parts
        self._listing: dict[BodyPart, list[int]] = {part: [] for part in BodyPart}
        self._base: int | None = None

    def update(self, ended: Iterable[int], started: Iterable[int]) -> None:
        """Advance to the next interval, given the indices of the prompts that end and that start."""
        for index in ended:
            for ranks in self._rank_lists(index):
                del ranks[bisect_left(ranks, self._ranks[index])]
        for index in started:
            for ranks in self._rank_lists(index):
                insort(ranks, self._ranks[index])
        with_legs = [ranks[-1] for ranks in (self._unlisted, self._listing[BodyPart.LEGS]) if ranks]
        self._base = max(with_legs or [ranks[-1] for ranks in self._listing.values() if ranks], default=None)

    def owner(self, part: BodyPart) -> int | None:
        """Return the index of the prompt that owns the part; None if no prompt holds."""
        rank = self._first(part)
        return None if rank is None else self._order[rank]

    def rivals(self, part: BodyPart) -> list[int]:
        """Return the indices of the other prompts that claim the part.

        A prompt that lists no part and a prompt that lists some are never rivals.
        """
        first = self._first(part)
        if first is None:
            return []
        ranks = self._listing[part] if self._parts[self._order[first]] else self._unlisted
        return [self._order[rank] for rank in reversed(ranks) if rank != first]

    def _first(self, part: BodyPart) -> int | None:
        ranks = sorted([*self._unlisted[:2], *self._listing[part][:2]])
        return next((rank for rank in ranks if rank != self._base), self._base)

    def _rank_lists(self, index: int) -> list[list[int]]:
        return [self._listing[part] for part in self._parts[index]] or [self._unlisted]
