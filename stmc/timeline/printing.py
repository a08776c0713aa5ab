"""A timeline as lines of text: its tracks to scale under a ruler of seconds, then a list of its prompts."""

from __future__ import annotations

from collections.abc import Sequence

from stmc.timeline.timeline_files import Draft, Entry

COLUMNS = 76


def draw(draft: Draft) -> str:
    """Draw one timeline whose entries all have a track. The bar of a prompt shows its number in the list."""
    duration = max(entry.end for entry in draft.entries)
    count = len(draft.entries)
    title = f"{draft.name or 'timeline'}: {duration:g} s, {count} prompt{'s' if count > 1 else ''}"
    tracks: dict[int, list[tuple[int, Entry]]] = {}
    for number, entry in enumerate(draft.entries, start=1):
        assert entry.track is not None
        tracks.setdefault(entry.track, []).append((number, entry))
    rows = [_row(tracks[track], duration) for track in sorted(tracks)]
    return "\n".join([title, _ruler(duration), *rows, *_list(draft.entries)])


def _row(numbered: Sequence[tuple[int, Entry]], duration: float) -> str:
    cells = [" "] * COLUMNS
    for number, entry in numbered:
        left = min(int(entry.start / duration * COLUMNS), COLUMNS - 1)
        width = max(int(entry.end / duration * COLUMNS) - left, 1)
        cells[left : left + width] = _bar(f"{number} {entry.text}", width)
    return "".join(cells).rstrip()


def _bar(label: str, width: int) -> str:
    if width < 3:
        return "|" * width
    room = width - 2
    return f"[{label if len(label) <= room else label[: room - 1] + '…':·<{room}}]"


def _ruler(duration: float) -> str:
    """Draw seconds at round distances, far enough apart to stay legible."""
    steps = (base * 10.0**power for power in range(-3, 9) for base in (1, 2, 5))
    step = next((step for step in steps if step / duration * COLUMNS >= 8), duration)
    cells = [" "] * (COLUMNS + 12)
    for tick in range(int(duration / step) + 1):
        label = f"{tick * step:g}" + (" s" if tick == 0 else "")
        left = int(tick * step / duration * COLUMNS)
        cells[left : left + len(label)] = label
    return "".join(cells).rstrip()


def _list(entries: Sequence[Entry]) -> list[str]:
    texts = [f"{number}  {entry.text}" for number, entry in enumerate(entries, start=1)]
    times = [f"{entry.start:g} to {entry.end:g} s" for entry in entries]
    wide, wide_times = max(map(len, texts)), max(map(len, times))
    parts = [", ".join(entry.parts) or "whole body" for entry in entries]
    return [f"{t:<{wide}}  {s:<{wide_times}}  {p}" for t, s, p in zip(texts, times, parts, strict=True)]


def typed(text: str, start: float, end: float, parts: list[str]) -> str:
    """Format a prompt as a user would type it in Python: 4 instead of 4.0."""
    seconds = [str(int(time)) if time.is_integer() else repr(time) for time in (start, end)]
    return f"Prompt({', '.join([repr(text), *seconds, *([repr(parts)] if parts else [])])})"
