"""Who does what, when, in AMASS's recordings: texts with seconds, as TMR and STMC publish them, as HumanML3D does, and
as BABEL does.

Knows these formats of files; knows no recording and no features. An annotation that cannot be used is named and
left out; a file that is not in the format at all is an error.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath
from typing import Any

from stmc.data.preparation import LayoutError
from stmc.data.sources.amass.amass_recordings import unmirrored
from stmc.data.sources.contents import mirrored
from stmc.data.sources.humanml3d.humanml3d_texts import WHOLE, Caption, Cut, read_captions, read_index
from stmc.io.untrusted import UnreadableError, read_lines

SPLITS = ("train", "val", "test")

NO_POSES = "humanact12"
"""HumanML3D's recordings that are not AMASS's: they have joints, but no SMPL poses (STMC, section 4.1)."""


@dataclass(frozen=True)
class Segment:
    """A text that says what happens from `start` to `end`, in seconds of the recording; `end` None: to its end."""

    text: str
    start: float
    end: float | None


@dataclass(frozen=True)
class Annotated:
    """An entry: segments of one recording, or of its mirror image. `path` is AMASS's, without `M/` and suffix."""

    name: str
    path: str
    mirrored: bool
    split: str
    segments: tuple[Segment, ...]


@dataclass(frozen=True)
class Annotations:
    """All entries, and (name, reason) of every one that had to be left out."""

    entries: tuple[Annotated, ...]
    skipped: tuple[tuple[str, str], ...]


def read_annotations(folder: Path) -> Annotations:
    """The annotations in `folder`: `annotations.json` with `splits/` (TMR's and STMC's, for HumanML3D and KIT-ML),
    HumanML3D's own `texts/` and lists with `index.csv`, or BABEL's `train.json` and `val.json`.

    Raises `LayoutError` for a folder that holds neither, and for files in another format.
    """
    folder = Path(folder)
    if (folder / "annotations.json").is_file():
        return _published(folder)
    if (folder / "train.json").is_file() and (folder / "val.json").is_file():
        return _babel(folder)
    for inner in (folder, folder / "HumanML3D"):
        if (inner / "texts").is_dir() and (inner / "train.txt").is_file():
            return _humanml3d(inner)
    found = sorted(path.name for path in folder.iterdir())[:8] if folder.is_dir() else "no such folder"
    hint = "; texts.zip must be unpacked" if any(folder.glob("**/texts.zip")) else ""
    raise LayoutError(
        f"annotations={folder}: expected annotations.json with splits/train.txt and splits/val.txt (as in TMR's and "
        f"STMC's datasets/annotations/humanml3d), HumanML3D's index.csv, texts/ and lists, or BABEL's train.json and "
        f"val.json; found {found}{hint}"
    )


def with_mirror_images(annotations: Annotations) -> Annotations:
    """Also the mirror image of every entry for training, left and right exchanged in its texts too.

    Unchanged where the annotations bring mirror images of their own, as HumanML3D's do.
    """
    if any(entry.mirrored for entry in annotations.entries):
        return annotations
    images = [_image(entry) for entry in annotations.entries if entry.split == "train"]
    return replace(annotations, entries=(*annotations.entries, *images))


def _image(entry: Annotated) -> Annotated:
    segments = tuple(replace(segment, text=mirrored(segment.text)) for segment in entry.segments)
    return replace(entry, name=f"M{entry.name}", mirrored=not entry.mirrored, segments=segments)


def _published(folder: Path) -> Annotations:
    """Entries as the splits list them. An id `M…` is the mirror image of the id without its M, as HumanML3D names them,
    whether it is annotated or only listed."""
    table, entries, skipped = _object(folder / "annotations.json"), [], []
    lists = {split: _listed(folder / "splits" / f"{split}.txt", split) for split in SPLITS}
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


def _humanml3d(folder: Path) -> Annotations:
    """HumanML3D as its authors share it: `texts/` and `train.txt`, `val.txt`, `test.txt` in `folder`, `index.csv` there
    or above. A name `M…` is the mirror image of the clip without its M, with captions of its own."""
    index = next((path for path in (folder / "index.csv", folder.parent / "index.csv") if path.is_file()), None)
    if index is None:
        raise LayoutError(
            f"annotations={folder}: index.csv is missing, there and above; it says what a clip is cut from"
        )
    try:
        cuts = read_index(index)
    except ValueError as error:
        raise LayoutError(f"not HumanML3D's index: {error}") from error
    entries, skipped = [], []
    for split in SPLITS:
        for name in _listed(folder / f"{split}.txt", split):
            try:
                image = name not in cuts and name[:1] == "M"
                entry, wrong = _captioned(name, cuts.get(name[1:] if image else name), image, split, folder / "texts")
                skipped += [(name, reason) for reason in wrong]
                entries.append(entry)
            except ValueError as error:
                skipped.append((name, str(error)))
    return Annotations(tuple(entries), tuple(skipped))


def _captioned(name: str, cut: Cut | str | None, image: bool, split: str, texts: Path) -> tuple[Annotated, list[str]]:
    """The entry of a clip, and what is wrong with captions that cannot be used; `ValueError` where none can."""
    if not isinstance(cut, Cut):
        raise ValueError(cut or "listed but not in index.csv")
    path, _ = _path(cut.path)
    try:
        captions = read_captions(texts / f"{PurePosixPath(name).name}.txt")
    except FileNotFoundError as error:
        raise ValueError(f"no file: texts/{name}.txt") from error
    except UnreadableError as error:
        raise ValueError(f"damaged: {error}") from error
    segments = tuple(_said(caption, cut) for caption in captions if isinstance(caption, Caption))
    wrong = [caption for caption in captions if isinstance(caption, str)]
    if not segments:
        raise ValueError(wrong[0] if wrong else "no caption: the file is empty")
    return Annotated(name, path, image, split, segments), wrong


def _said(caption: Caption, cut: Cut) -> Segment:
    if (caption.start, caption.end) == WHOLE:
        return Segment(caption.text, cut.start, cut.end)
    end = cut.start + caption.end
    return Segment(caption.text, cut.start + caption.start, end if cut.end is None else min(end, cut.end))


def _entry(name: str, value: Any, split: str) -> Annotated:
    if not isinstance(value, dict) or not isinstance(value.get("annotations"), list) or not value["annotations"]:
        raise ValueError("malformed annotation: it must have a path and a list of annotations")
    path, image = _path(value.get("path"))
    segments = tuple(_segment(each, "text", ("start", "end")) for each in value["annotations"])
    return Annotated(name, path, image, split, segments)


def _path(value: Any) -> tuple[str, bool]:
    """AMASS's path without `M/` and suffix, and whether it is a mirror image's."""
    if not isinstance(value, str) or not value:
        raise ValueError(f"malformed annotation: path is {value!r}")
    bare, image = unmirrored(value)
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
    start, end = (value.get(name) for name in times)
    for moment in (start, end):
        if not isinstance(moment, (int, float)) or isinstance(moment, bool) or not math.isfinite(moment):
            raise ValueError(f"malformed annotation: {times[0]} {start!r} and {times[1]} {end!r} must be seconds")
    if not 0 <= start < end:
        raise ValueError(f"malformed annotation: from {start} to {end} s")
    return Segment(" ".join(value[text].split()), float(start), float(end))


def _babel(folder: Path) -> Annotations:
    """Sequences with what happens in their frames, or as a whole where nobody labelled frames. Test labels are not
    published: `val` serves as such. Transitions have no text of their own and are left out."""
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
    """Every sequence of BABEL's `train.json` and `val.json`: its name, AMASS's path, its split and all that is said of
    it; those without a path are added to the `skipped`, with the reason. Raises `LayoutError` for other files."""
    for split in ("train", "val"):
        for name, value in _object(folder / f"{split}.json").items():
            try:
                path, _ = _path(_without_release(value))
            except ValueError as error:
                skipped.append((name, str(error)))
                continue
            yield name, path, split, value


def _without_release(value: Any) -> Any:
    """BABEL's `feat_p` without its first part, the name of the release: `KIT/KIT/3/kick_poses.npz`."""
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


def _object(path: Path) -> dict[str, Any]:
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (ValueError, RecursionError) as error:
        raise LayoutError(f"{path} is not JSON: {error}") from error
    if not isinstance(content, dict) or not content:
        raise LayoutError(f"{path} must be a JSON object with an entry for every sequence")
    return content


def _listed(path: Path, split: str) -> list[str]:
    """The names in a split's file, each once; none where there is no test split."""
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
