"""A plan as lines of text: its crops to scale, and the crop that each body part follows at each time."""

from __future__ import annotations

import string
from collections.abc import Sequence
from typing import Any

from stmc.motion.body import BodyPart

COLUMNS = 64
MOST = 30
"""Maximum number of listed crops; a longer plan only counts the rest."""


def draw(frames: int, crops: Sequence[Any], tiles: Sequence[Any]) -> str:
    """Draw a bar for each crop, with its letter and text, then a line for each body part.

    The line shows the letter of the crop that the part follows, and ~ where several crops count.

    Args:
        frames: Length of the plan.
        crops: Crops of a `Plan`; `plans` imports this module, not the reverse.
        tiles: Tiles of the same plan.
    """
    letters = string.ascii_letters + "?" * len(crops)
    title = f"plan: {frames} frames, {len(crops)} crops"
    more = [f"{'…':<10} and {len(crops) - MOST} more"] if len(crops) > MOST else []
    bars = [_bar(crop, letter, frames) for crop, letter in zip(crops[:MOST], letters, strict=False)]
    tiles_of = {part: [tile for tile in tiles if tile.part == part] for part in BodyPart}
    parts = [f"{part!s:<10} {_letters_by_column(part_tiles, frames, letters)}" for part, part_tiles in tiles_of.items()]
    return "\n".join([title, *bars, *more, *parts])


def _bar(crop: Any, letter: str, frames: int) -> str:
    left = min(crop.start * COLUMNS // frames, COLUMNS - 1)
    width = max(1, crop.end * COLUMNS // frames - left)
    label = (crop.text or "")[: max(0, width - 2)]
    bar = f"[{label:·<{width - 2}}]" if width > 2 else "|" * width
    return f"{letter:<10} {' ' * left}{bar:<{COLUMNS - left}}  {crop.start} to {crop.end}"


def _letters_by_column(tiles: Sequence[Any], frames: int, letters: str) -> str:
    """Return the letters at the middle of each column."""
    return "".join(_letter(tiles, (2 * column + 1) * frames // (2 * COLUMNS), letters) for column in range(COLUMNS))


def _letter(tiles: Sequence[Any], frame: int, letters: str) -> str:
    crops = {tile.crop for tile in tiles if tile.start <= frame < tile.end}
    return letters[min(crops)] if len(crops) == 1 else "~"
