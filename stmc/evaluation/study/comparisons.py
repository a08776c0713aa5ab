"""Motions of the same timelines by two methods, read from two folders of `stmc sample`."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from stmc.evaluation.study.key import StudyError
from stmc.formats import read
from stmc.motion.motion import Motion
from stmc.timeline import Timeline

Content = tuple[tuple[str, float, float, tuple[str, ...]], ...]
"""A timeline in the form of records: text, start, end and parts of each prompt."""


@dataclass(frozen=True, eq=False)
class Pair:
    """A timeline and one motion of it by each method; `name` is unique in a study."""

    name: str
    timeline: Timeline
    first: Motion
    second: Motion


def read_pairs(first: str | Path, second: str | Path, timelines: Sequence[Timeline]) -> list[Pair]:
    """Read the motions of every timeline that both folders have, with the lowest seed, in the timelines' order.

    The record beside a motion tells its timeline. Raises `StudyError` for a motion without a record, for a timeline
    that only one folder has, and if the folders have none of the timelines.
    """
    folders = [Path(first), Path(second)]
    found = [_motions(folder) for folder in folders]
    pairs = []
    for timeline in {_content(timeline): timeline for timeline in timelines}.values():
        one, other = (motions.get(_content(timeline)) for motions in found)
        if one is None and other is None:
            continue
        if one is None or other is None:
            has, lacks = (folders[0], folders[1]) if other is None else (folders[1], folders[0])
            texts = ", ".join(repr(prompt.text) for prompt in timeline.prompts)
            raise StudyError(f"timeline {timeline.name!r} ({texts}): {has} has a motion of it, {lacks} has none")
        pairs.append(Pair(one.stem, timeline, read(one), read(other)))
    if not pairs:
        raise StudyError(f"neither {folders[0]} nor {folders[1]} has a motion of any of the {len(timelines)} timelines")
    return pairs


def _motions(folder: Path) -> dict[Content, Path]:
    """Map each timeline of a folder to the path of its motion with the lowest seed."""
    chosen: dict[Content, tuple[int, Path]] = {}
    for path in sorted(folder.glob("*.npz")):
        seed, content = _record(path.with_suffix(".json"))
        if content not in chosen or seed < chosen[content][0]:
            chosen[content] = (seed, path)
    if not chosen:
        raise StudyError(f"{folder} has no motions (.npz)")
    return {content: path for content, (_, path) in chosen.items()}


def _record(path: Path) -> tuple[int, Content]:
    if not path.is_file():
        raise StudyError(f"{path} is missing; `stmc sample` writes it beside each motion")
    try:
        data: Any = json.loads(path.read_text(encoding="utf-8"))
        content = tuple((str(text), float(a), float(b), tuple(sorted(parts))) for text, a, b, parts in data["prompts"])
        return int(data["seed"]), content
    except (ValueError, TypeError, KeyError, RecursionError) as error:
        raise StudyError(f"{path} is not a record of `stmc sample` ({error!r})") from None


def _content(timeline: Timeline) -> Content:
    return tuple((prompt.text, prompt.start, prompt.end, tuple(sorted(prompt.parts))) for prompt in timeline.prompts)
