"""Annotations of AMASS's recordings: texts with seconds, as published with TMR and STMC, HumanML3D, and BABEL.

Depends on these file formats; independent of recordings and features. An annotation that cannot be used is skipped and
named; a file in another format is an error.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath
from typing import Any

from stmc.data.preparation import LayoutError
from stmc.data.sources.amass.amass_recordings import strip_mirror_prefix
from stmc.data.sources.contents import mirrored
from stmc.data.sources.humanml3d.humanml3d_texts import WHOLE, Caption, Cut, read_captions, read_index
from stmc.io.untrusted import UnreadableError, read_lines

SPLITS = ("train", "val", "test")

NO_POSES = "humanact12"
"""HumanML3D's recordings that are not in AMASS: they have joints, but no SMPL poses (STMC, section 4.1)."""


@dataclass(frozen=True)
class Segment:
    """A text that describes `start` to `end`, in seconds of the recording; None is the end of the recording."""

    text: str
    start: float
    end: float | None


@dataclass(frozen=True)
class Annotated:
    """Segments of one recording, or of its mirror image. `path` is AMASS's, without `M/` and suffix."""

    name: str
    path: str
    mirrored: bool
    split: str
    segments: tuple[Segment, ...]


@dataclass(frozen=True)
class Annotations:
    """All entries, and the name and reason of every skipped one."""

    entries: tuple[Annotated, ...]
    skipped: tuple[tuple[str, str], ...]


def read_annotations(folder: Path) -> Annotations:
    """Read the annotations in `folder`, in one of three formats.

    These are `annotations.json` with `splits/` (TMR's and STMC's, for HumanML3D and KIT-ML), HumanML3D's own `texts/`
    and lists with `index.csv`, and BABEL's `train.json` and `val.json`. Raises `LayoutError` if the folder has none of
    them, or a file has another format.
    """
    folder = Path(folder)
    if (folder / "annotations.json").is_file():
        return _read_published(folder)
    if (folder / "train.json").is_file() and (folder / "val.json").is_file():
        return _read_babel(folder)
    for inner in (folder, folder / "HumanML3D"):
        if (inner / "texts").is_dir() and (inner / "train.txt").is_file():
            return _read_humanml3d(inner)
    names = sorted(path.name for path in folder.iterdir())[:8] if folder.is_dir() else "no such folder"
    hint = "; texts.zip must be unpacked" if any(folder.glob("**/texts.zip")) else ""
    raise LayoutError(
        f"annotations={folder}: expected annotations.json with splits/train.txt and splits/val.txt (as in TMR's and "
        f"STMC's datasets/annotations/humanml3d), HumanML3D's index.csv, texts/ and lists, or BABEL's train.json and "
        f"val.json; found {names}{hint}"
    )


def with_mirror_images(annotations: Annotations) -> Annotations:
    """Add the mirror image of every training entry, with left and right exchanged in its texts.

    Annotations with their own mirror images, such as HumanML3D's, are unchanged.
    """
    if any(entry.mirrored for entry in annotations.entries):
        return annotations
    images = [_image(entry) for entry in annotations.entries if entry.split == "train"]
    return replace(annotations, entries=(*annotations.entries, *images))


def _image(entry: Annotated) -> Annotated:
    segments = tuple(replace(segment, text=mirrored(segment.text)) for segment in entry.segments)
    return replace(entry, name=f"M{entry.name}", mirrored=not entry.mirrored, segments=segments)


def _read_published(folder: Path) -> Annotations:
    """Read the entries that the splits list.

    An id `M…` is the mirror image of the id without its M, as in HumanML3D, whether it is annotated or only listed.
    """
    table, entries, skipped = _read_object(folder / "annotations.json"), [], []
    lists = {split: _read_list(folder / "splits" / f"{split}.txt", split) for split in SPLITS}
    for split, names in lists.items():
        for name in names:
            original = name[1:] if name[:1] == "M" and name[1:] in table else None
            try:
                if name in table:
                    entry = _entry(name, table[name], split)
                    entries.append(replace(entry, mirrored=entry.mirrored or original is not None))
                elif original is not None:
                    entries.append(_image(_entry(original, table[original], split)))
                else:
                    raise ValueError(f"listed but not annotated: in splits/{split}.txt alone")
            except ValueError as error:
                skipped.append((name, str(error)))
    unlisted = set(table) - {name for names in lists.values() for name in names}
    skipped += [(name, "in no split") for name in sorted(unlisted)]
    return Annotations(tuple(entries), tuple(skipped))


def _read_humanml3d(folder: Path) -> Annotations:
    """Read HumanML3D as its authors distribute it.

    `texts/`, `train.txt`, `val.txt` and `test.txt` are in `folder`, `index.csv` there or above. A name `M…` is the
    mirror image of the clip without its M, with its own captions.
    """
    index = next((path for path in (folder / "index.csv", folder.parent / "index.csv") if path.is_file()), None)
    if index is None:
        raise LayoutError(f"annotations={folder}: index.csv is missing, there and above; it maps clips to recordings")
    try:
        cuts = read_index(index)
    except ValueError as error:
        raise LayoutError(f"not HumanML3D's index: {error}") from error
    entries, skipped = [], []
    for split in SPLITS:
        for name in _read_list(folder / f"{split}.txt", split):
            try:
                image = name not in cuts and name[:1] == "M"
                entry, wrong = _captioned_entry(
                    name, cuts.get(name[1:] if image else name), image, split, folder / "texts"
                )
                skipped += [(name, reason) for reason in wrong]
                entries.append(entry)
            except ValueError as error:
                skipped.append((name, str(error)))
    return Annotations(tuple(entries), tuple(skipped))


def _captioned_entry(
    name: str, cut: Cut | str | None, image: bool, split: str, texts: Path
) -> tuple[Annotated, list[str]]:
    """Return the entry of a clip and the problems of unusable captions; raise `ValueError` if none is usable."""
    if not isinstance(cut, Cut):
        raise ValueError(cut or "listed but not in index.csv")
    path, _ = _path(cut.path)
    try:
        captions = read_captions(texts / f"{PurePosixPath(name).name}.txt")
    except FileNotFoundError as error:
        raise ValueError(f"no file: texts/{name}.txt") from error
    except UnreadableError as error:
        raise ValueError(f"damaged: {error}") from error
    segments = tuple(_to_segment(caption, cut) for caption in captions if isinstance(caption, Caption))
    wrong = [caption for caption in captions if isinstance(caption, str)]
    if not segments:
        raise ValueError(wrong[0] if wrong else "no caption: the file is empty")
    return Annotated(name, path, image, split, segments), wrong


def _to_segment(caption: Caption, cut: Cut) -> Segment:
    if (caption.start, caption.end) == WHOLE:
        return Segment(caption.text, cut.start, cut.end)
    end = cut.start + caption.end
    return Segment(caption.text, cut.start + caption.start, end if cut.end is None else min(end, cut.end))


def _entry(name: str, value: Any, split: str) -> Annotated:
    if not isinstance(value, dict) or not isinstance(value.get("annotations"), list) or not value["annotations"]:
        raise ValueError("malformed annotation: it must have a path and a list of annotations")
    path, image = _path(value.get("path"))
    segments = tuple(_segment(row, "text", ("start", "end")) for row in value["annotations"])
    return Annotated(name, path, image, split, segments)


def _path(value: Any) -> tuple[str, bool]:
    """Return AMASS's path without `M/` and suffix, and whether it is that of a mirror image."""
    if not isinstance(value, str) or not value:
        raise ValueError(f"malformed annotation: path is {value!r}")
    bare, image = strip_mirror_prefix(value)
    path, parts = PurePosixPath(bare), PurePosixPath(bare).parts
    if path.is_absolute() or ".." in path.parts or ":" in value:
        raise ValueError(f"path outside of AMASS: {value!r}")
    if parts and parts[0].lower() == NO_POSES:
        raise ValueError("HumanAct12: it has no SMPL poses")
    if len(parts) < 2:
        raise ValueError(f"malformed annotation: path is {value!r}, not data set/subject/recording")
    name = parts[-1].removesuffix(".npz").removesuffix(".npy")
    return "/".join((*parts[:-1], name)), image


def _segment(value: Any, text: str, times: tuple[str, str]) -> Segment:
    if not isinstance(value, dict) or not isinstance(value.get(text), str) or not value[text].strip():
        raise ValueError(f"malformed annotation: no {text} in {value!r}")
    start, end = list[Any](map(value.get, times))
    for moment in (start, end):
        if not isinstance(moment, (int, float)) or isinstance(moment, bool) or not math.isfinite(moment):
            raise ValueError(f"malformed annotation: {times[0]} {start!r} and {times[1]} {end!r} must be seconds")
    if not 0 <= start < end:
        raise ValueError(f"malformed annotation: from {start} to {end} s")
    return Segment(" ".join(value[text].split()), float(start), float(end))


def _read_babel(folder: Path) -> Annotations:
    """Read sequences with their frame labels or, without frame labels, their sequence labels.

    Test labels are not published; `val` replaces them. Transitions have no text of their own and are omitted.
    """
    entries, skipped = [], list[tuple[str, str]]()
    for name, path, split, value in babel_entries(folder, skipped):
        try:
            segments = tuple(_labels(value))
            if not segments:
                raise ValueError("no label but transitions")
            entries.append(Annotated(name, path, False, split, segments))
        except ValueError as error:
            skipped.append((name, str(error)))
    return Annotations(tuple(entries), tuple(skipped))


def babel_entries(folder: Path, skipped: list[tuple[str, str]]) -> Iterator[tuple[str, str, str, Mapping[str, Any]]]:
    """Yield every sequence of BABEL's `train.json` and `val.json`: name, AMASS's path, split and annotations.

    Sequences without a path are added to `skipped` with the reason. Raises `LayoutError` if a file has another format.
    """
    for split in ("train", "val"):
        for name, value in _read_object(folder / f"{split}.json").items():
            try:
                path, _ = _path(_without_release(value))
            except ValueError as error:
                skipped.append((name, str(error)))
                continue
            yield name, path, split, value


def _without_release(value: Any) -> Any:
    """Return BABEL's `feat_p` without its first part, the name of the release: `KIT/KIT/3/kick_poses.npz`."""
    path = value.get("feat_p") if isinstance(value, dict) else None
    return path.partition("/")[2] if isinstance(path, str) else path


def _labels(value: Mapping[str, Any]) -> Iterator[Segment]:
    frames, whole = value.get("frame_ann"), value.get("seq_ann")
    labelled = frames or whole
    if not isinstance(labelled, dict) or not isinstance(labelled.get("labels"), list):
        raise ValueError("malformed annotation: neither frame_ann nor seq_ann has labels")
    for label in labelled["labels"]:
        if isinstance(label, dict) and "transition" in (label.get("proc_label"), label.get("raw_label")):
            continue
        if frames:
            yield _segment(label, "raw_label", ("start_t", "end_t"))
        else:
            yield replace(_segment(label | {"start_t": 0, "end_t": 1}, "raw_label", ("start_t", "end_t")), end=None)


def _read_object(path: Path) -> dict[str, Any]:
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
    except (ValueError, RecursionError) as error:
        raise LayoutError(f"{path} is not JSON: {error}") from error
    if not isinstance(data, dict) or not data:
        raise LayoutError(f"{path} must be a JSON object with an entry for every sequence")
    return data


def _read_list(path: Path, split: str) -> list[str]:
    """Read the distinct names in a split's file; an absent test split is empty."""
    if not path.is_file():
        if split == "test":
            return []
        raise LayoutError(f"{path} is missing; it should list the names of split {split!r}, one a line")
    try:
        names = " ".join(read_lines(path)).split()
    except UnreadableError as error:
        raise LayoutError(str(error)) from error
    if not names and split != "test":
        raise LayoutError(f"{path} lists nothing")
    return list(dict.fromkeys(names))
