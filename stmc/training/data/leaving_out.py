"""Recordings and sentences that a training leaves out, so that a judge has seen neither."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from fnmatch import fnmatchcase

from stmc.data.cache import Cache


def leave_out(cache: Cache, recordings: Sequence[str], texts: Sequence[str]) -> Cache:
    """Move training clips of some recordings to the test split, and remove some sentences.

    Raises `ValueError` for a pattern that matches no recording: a judge would see the clips that it was meant to miss.

    Args:
        cache: Prepared data.
        recordings: Patterns of names of recordings: "13_*" are those of CMU's actor 13, also in edited clips.
        texts: Sentences to remove; the others of a clip keep their proportions.
    """
    names = {part for clip in cache.clips for part in clip.name.split("/")}
    matched = {pattern: {name for name in names if fnmatchcase(name, pattern)} for pattern in recordings}
    if missing := [pattern for pattern, found in matched.items() if not found]:
        first = cache.clips[0].name
        raise ValueError(
            f"no recording matches {', '.join(missing)}; a pattern matches a part of a name such as {first}"
        )
    held_out = set().union(*matched.values())
    clips = tuple(
        replace(clip, split="test") if clip.split == "train" and held_out & set(clip.name.split("/")) else clip
        for clip in cache.clips
    )
    kept = {key: [row for row in rows if row[0] not in texts] for key, rows in cache.texts.items()}
    shares = {key: sum(share for _, share in rows) for key, rows in kept.items()}
    left = {key: tuple((text, share / shares[key]) for text, share in rows) for key, rows in kept.items()}
    return replace(cache, clips=clips, texts=left)
