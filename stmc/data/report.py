"""What a prepared data set holds and what had to be left out: for people as text, for programs as JSON.

Knows caches; knows no data set.
"""

from __future__ import annotations

import json
from collections import Counter
from pathlib import Path
from typing import Any

from stmc.data.cache import Cache
from stmc.io.files import write_whole

TEXT, NUMBERS = "report.txt", "report.json"


def summary(cache: Cache) -> dict[str, Any]:
    """Counts, per split and in all. `skipped` groups what was left out by the reason's words before the first colon.

    An annotated data set's contents are its entries, so an epoch of the published training is as many rows as the
    training split has contents.
    """
    splits = {}
    for split in dict.fromkeys(clip.split for clip in cache.clips):
        clips = [clip for clip in cache.clips if clip.split == split]
        splits[split] = {
            "clips": len(clips),
            "of_which_mirrored": sum(clip.mirrored for clip in clips),
            "contents": len({clip.content for clip in clips}),
            "hours": round(sum(clip.end - clip.start for clip in clips) / cache.fps / 3600, 4),
        }
    return {
        "representation": cache.representation,
        "fps": cache.fps,
        "features": cache.features.shape[1],
        "texts": len({text for rows in cache.texts.values() for text, _ in rows}),
        "splits": splits,
        "skipped": dict(Counter(reason.partition(":")[0] for _, reason in cache.skipped).most_common()),
        "each_skipped": [list(row) for row in cache.skipped],
    }


def lines(counted: dict[str, Any]) -> list[str]:
    """A `summary` in a few lines, without the list of all that was skipped."""
    told = [f"{counted['features']} features ({counted['representation']}) at {counted['fps']:g} fps"]
    for split, row in counted["splits"].items():
        images = f"{row['of_which_mirrored']} mirrored"
        told.append(f"{split}: {row['clips']} clips ({images}) of {row['contents']} contents, {row['hours']:.2f} hours")
    told.append(f"{counted['texts']} different texts")
    told += [f"skipped, {reason}: {count}" for reason, count in counted["skipped"].items()]
    return told


def write_report(cache: Cache, folder: Path) -> dict[str, Any]:
    """Writes `report.txt` and `report.json` to the cache's folder; returns the `summary`."""
    counted = summary(cache)
    each = [f"{name}: {reason}" for name, reason in counted["each_skipped"]]
    text = "\n".join([*lines(counted), *(["", "All that was skipped:", *each] if each else [])]) + "\n"
    numbers = json.dumps(counted, indent=1) + "\n"
    write_whole(Path(folder) / TEXT, lambda path: path.write_text(text, encoding="utf-8"))
    write_whole(Path(folder) / NUMBERS, lambda path: path.write_text(numbers, encoding="utf-8"))
    return counted
