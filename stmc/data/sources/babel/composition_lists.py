"""What FlowMDM's evaluation asks for (Barquero et al. 2024, section 4.1): lists of texts, each with a number of frames,
as its authors publish them, and others drawn as theirs are from a test split.

Knows that format; knows no features and no frame rate.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from stmc.data.preparation import LayoutError
from stmc.data.sources.humanml3d.humanml3d_clips import CaptionedClip
from stmc.io.untrusted import UnreadableError, load_json, read_text, shown

MOST_BYTES = 16 * 2**20
"""Of a list; those that are published have some 100 kB."""

MOST_FRAMES = 10_000
"""Of one text."""


@dataclass(frozen=True)
class Composition:
    """Texts one after the other, each with its frames; `scenario`: what kind of composition the list says it is, such
    as "short" or "in-distribution"."""

    name: str
    texts: tuple[str, ...]
    lengths: tuple[int, ...]
    scenario: str = ""


def read_compositions(path: str | Path, scenario: str | None = None) -> list[Composition]:
    """The compositions of a file such as `humanml_test_set.json`: a list of `{"id": 0, "text": ["walk", …], "lengths":
    [64, …], "scenario": "short"}`, where id and scenario may be absent, or one such object. `scenario`: those of one
    kind, and those that name none.

    Raises `LayoutError`, naming the entry, for anything else, and for a scenario that no entry has.
    """
    path = Path(path).expanduser()
    try:
        content = load_json(read_text(path, MOST_BYTES))
        entries = content if isinstance(content, list) else [content]
        found = [_composition(entry, number) for number, entry in enumerate(entries)]
    except FileNotFoundError as error:
        raise LayoutError(f"{path} does not exist") from error
    except (UnreadableError, ValueError) as error:
        raise LayoutError(f"{path}: {error}") from error
    chosen = [each for each in found if scenario is None or each.scenario in ("", scenario)]
    if not chosen:
        kinds = ", ".join(sorted({each.scenario for each in found})) or "none"
        raise LayoutError(f"{path}: no composition of scenario {shown(scenario)}; it has {kinds}")
    return chosen


def sample_compositions(
    clips: Sequence[CaptionedClip], count: int = 32, texts: int = 32, seed: int = 0
) -> list[Composition]:
    """As many compositions as the published lists have, drawn as the paper tells of theirs: of a clip of the test
    split, any with the same probability, one of its captions, and as many frames as the clip has. How the authors drew
    theirs in detail is not published."""
    rng, found = np.random.default_rng(seed), []
    for number in range(count):
        chosen = [clips[index] for index in rng.integers(len(clips), size=texts).tolist()]
        said = tuple(clip.captions[int(rng.integers(len(clip.captions)))].text for clip in chosen)
        found.append(Composition(f"{number:04d}", said, tuple(len(clip.features) for clip in chosen)))
    return found


def _composition(entry: Any, number: int) -> Composition:
    if not isinstance(entry, dict):
        raise ValueError(f"entry {number} is not an object with text and lengths but {shown(entry)}")
    texts, lengths = entry.get("text"), entry.get("lengths")
    if not isinstance(texts, list) or not isinstance(lengths, list) or not len(texts) == len(lengths) > 0:
        raise ValueError(f"entry {number}: text and lengths must be lists of one length")
    for text in texts:
        if not isinstance(text, str) or not text.strip():
            raise ValueError(f"entry {number}: text holds {shown(text)}, not a text")
    for length in lengths:
        if not isinstance(length, int) or isinstance(length, bool) or not 0 < length <= MOST_FRAMES:
            raise ValueError(f"entry {number}: lengths holds {shown(length)}, not 1 to {MOST_FRAMES} frames")
    scenario, name = entry.get("scenario") or "", entry.get("id", number)
    if not isinstance(scenario, str) or not isinstance(name, (str, int)):
        raise ValueError(f"entry {number}: scenario is {shown(scenario)}, id {shown(name)}; texts needed")
    return Composition(str(name), tuple(texts), tuple(lengths), scenario)
