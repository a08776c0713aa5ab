"""A plan as lines of text: its crops to scale, and which of them each body part follows at each moment."""

from __future__ import annotations

import string
from collections.abc import Sequence
from typing import TYPE_CHECKING

from stmc.body import BodyPart

if TYPE_CHECKING:
    from stmc.planning.plans import Crop, Plan

COLUMNS = 64
MOST = 30
"""Crops that are listed; a longer plan says how many more it has."""


def draw(plan: Plan) -> str:
    """A bar for each crop, with its letter and its text, if it has one; below, for each body part, the letter of the
    crop that it follows, and ~ where several count."""
    letters = string.ascii_letters + "?" * len(plan.crops)
    title = f"plan: {plan.frames} frames, {len(plan.crops)} crops"
    more = [f"{'…':<10} and {len(plan.crops) - MOST} more"] if len(plan.crops) > MOST else []
    bars = [_bar(crop, letter, plan.frames) for crop, letter in zip(plan.crops[:MOST], letters, strict=False)]
    parts = [f"{part!s:<10} {_followed(plan, part, letters)}" for part in BodyPart]
    return "\n".join([title, *bars, *more, *parts])


def _bar(crop: Crop, letter: str, frames: int) -> str:
    left = min(crop.start * COLUMNS // frames, COLUMNS - 1)
    width = max(1, crop.end * COLUMNS // frames - left)
    label = (crop.text or "")[: max(0, width - 2)]
    bar = f"[{label:·<{width - 2}}]" if width > 2 else "|" * width
    return f"{letter:<10} {' ' * left}{bar:<{COLUMNS - left}}  {crop.start} to {crop.end}"


def _followed(plan: Plan, part: BodyPart, letters: str) -> str:
    """At the middle of each column."""
    tiles = [tile for tile in plan.tiles if tile.part == part]
    return "".join(
        _letter(tiles, (2 * column + 1) * plan.frames // (2 * COLUMNS), letters) for column in range(COLUMNS)
    )


def _letter(tiles: Sequence, frame: int, letters: str) -> str:
    crops = {tile.crop for tile in tiles if tile.start <= frame < tile.end}
    return letters[min(crops)] if len(crops) == 1 else "~"
