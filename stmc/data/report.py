"""A report on a prepared data set and its omissions: text for people, JSON for programs."""

from __future__ import annotations

import json
from collections import Counter
from pathlib import Path
from typing import Any

from stmc.data.cache import Cache
from stmc.io.files import write_whole

TEXT, NUMBERS = "report.txt", "report.json"


def summary(cache: Cache) -> dict[str, Any]:
    """Count clips per split and in total. `skipped` groups omissions by the words of the reason before the first colon.

    The contents of an annotated data set are its entries, so that an epoch of the published training has as many rows
    as the training split has contents.
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
    """Format a `summary` in a few lines, without the list of omissions."""
    report = [f"{counted['features']} features ({counted['representation']}) at {counted['fps']:g} fps"]
    for split, row in counted["splits"].items():
        images = f"{row['of_which_mirrored']} mirrored"
        report.append(
            f"{split}: {row['clips']} clips ({images}) of {row['contents']} contents, {row['hours']:.2f} hours"
        )
    report.append(f"{counted['texts']} different texts")
    report += [f"skipped, {reason}: {count}" for reason, count in counted["skipped"].items()]
    return report


def write_report(cache: Cache, folder: Path) -> dict[str, Any]:
    """Write `report.txt` and `report.json` to the cache's folder; return the `summary`."""
    counted = summary(cache)
    omissions = [f"{name}: {reason}" for name, reason in counted["each_skipped"]]
    text = "\n".join([*lines(counted), *(["", "All that was skipped:", *omissions] if omissions else [])]) + "\n"
    numbers = json.dumps(counted, indent=1) + "\n"
    write_whole(Path(folder) / TEXT, lambda path: path.write_text(text, encoding="utf-8"))
    write_whole(Path(folder) / NUMBERS, lambda path: path.write_text(numbers, encoding="utf-8"))
    return counted
