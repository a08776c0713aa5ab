"""Segments of recordings and their actions: `assets/segments.json`, found by rules and checked by eye.

The file is our own work, so that open motion has texts without a third party's licence. Depends on the names of
recordings and actions; independent of motions.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from types import MappingProxyType
from typing import Any


@dataclass(frozen=True)
class Segment:
    """Seconds `[start, end)` of a recording, and the name of their action."""

    recording: str
    start: float
    end: float
    content: str


@cache
def table() -> Mapping[str, Any]:
    """Read the whole file."""
    return json.loads((files("stmc") / "assets" / "segments.json").read_text("utf-8"))


@cache
def read_segments(dataset: str) -> Mapping[str, tuple[Segment, ...]]:
    """Read all segments of "cmu" or "bandai", by recording, in time order."""
    segments: dict[str, list[Segment]] = {}
    for recording, start, end, content in table()[dataset]:
        segments.setdefault(recording, []).append(Segment(recording, float(start), float(end), content))
    return MappingProxyType({name: tuple(rows) for name, rows in segments.items()})


@cache
def splits() -> Mapping[str, str]:
    """Read the splits ("val" or "test") of CMU's held-out recordings; actions with few recordings have none."""
    return MappingProxyType({name: split for split, names in table()["held_out"].items() for name in names})
