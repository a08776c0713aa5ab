"""Compositions for FlowMDM's evaluation: the published lists of texts with lengths in frames, and similar draws.

See Barquero et al. (2024), section 4.1. Depends on that format; independent of features and frame rates.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from stmc.data.preparation import LayoutError
from stmc.data.sources.humanml3d.humanml3d_clips import CaptionedClip
from stmc.io.untrusted import UnreadableError, load_json, quote, read_text

MOST_BYTES = 16 * 2**20
"""Maximum size of a list; published lists have some 100 kB."""
MOST_FRAMES = 10_000
"""Maximum length of one text in frames."""


@dataclass(frozen=True)
class Composition:
    """Consecutive texts with their lengths in frames.

    `scenario` is the kind of composition according to the list, such as "short" or "in-distribution".
    """

    name: str
    texts: tuple[str, ...]
    lengths: tuple[int, ...]
    scenario: str = ""


def read_compositions(path: str | Path, scenario: str | None = None) -> list[Composition]:
    """Read the compositions of a file such as `humanml_test_set.json`.

    The file holds a list of `{"id": 0, "text": ["walk", …], "lengths": [64, …], "scenario": "short"}`, where id and
    scenario are optional, or one such object. With `scenario`, only entries of that kind, and entries without one, are
    returned. Raises `LayoutError`, with the entry, if the file is invalid or no entry has the scenario.
    """
    path = Path(path).expanduser()
    try:
        data = load_json(read_text(path, MOST_BYTES))
        entries = data if isinstance(data, list) else [data]
        compositions = [_composition(entry, number) for number, entry in enumerate(entries)]
    except FileNotFoundError as error:
        raise LayoutError(f"{path} does not exist") from error
    except (UnreadableError, ValueError) as error:
        raise LayoutError(f"{path}: {error}") from error
    matches = [
        composition for composition in compositions if scenario is None or composition.scenario in ("", scenario)
    ]
    if not matches:
        kinds = ", ".join(sorted({composition.scenario for composition in compositions})) or "none"
        raise LayoutError(f"{path}: no composition of scenario {quote(scenario)}; it has {kinds}")
    return matches


def sample_compositions(
    clips: Sequence[CaptionedClip], count: int = 32, texts: int = 32, seed: int = 0
) -> list[Composition]:
    """Draw compositions like those of the published lists, as the paper describes.

    Each text is one of the captions of a clip, with the length of the clip; all clips have the same probability. The
    details of the authors' own draw are not published.

    Args:
        clips: Clips of the test split.
        count: Number of compositions.
        texts: Number of texts per composition.
        seed: Seed of the draw.
    """
    rng, compositions = np.random.default_rng(seed), []
    for number in range(count):
        drawn = [clips[index] for index in rng.integers(len(clips), size=texts).tolist()]
        captions = tuple(clip.captions[int(rng.integers(len(clip.captions)))].text for clip in drawn)
        compositions.append(Composition(f"{number:04d}", captions, tuple(len(clip.features) for clip in drawn)))
    return compositions


def _composition(entry: Any, number: int) -> Composition:
    if not isinstance(entry, dict):
        raise ValueError(f"entry {number} must be an object with text and lengths, not {quote(entry)}")
    texts, lengths = entry.get("text"), entry.get("lengths")
    if not isinstance(texts, list) or not isinstance(lengths, list) or not len(texts) == len(lengths) > 0:
        raise ValueError(f"entry {number}: text and lengths must be nonempty lists of equal length")
    for text in texts:
        if not isinstance(text, str) or not text.strip():
            raise ValueError(f"entry {number}: text holds {quote(text)}, which is not a text")
    for length in lengths:
        if not isinstance(length, int) or isinstance(length, bool) or not 0 < length <= MOST_FRAMES:
            raise ValueError(f"entry {number}: lengths holds {quote(length)}; lengths are 1 to {MOST_FRAMES} frames")
    scenario, name = entry.get("scenario") or "", entry.get("id", number)
    if not isinstance(scenario, str) or not isinstance(name, (str, int)):
        raise ValueError(f"entry {number}: scenario {quote(scenario)} and id {quote(name)} must be texts")
    return Composition(str(name), tuple(texts), tuple(lengths), scenario)
