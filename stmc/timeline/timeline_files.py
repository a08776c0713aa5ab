"""The two file formats of timelines, as plain entries: text (as MTT is published) and JSON (which keeps tracks).

This module handles syntax: lines, fields, keys, and the place of each prompt in a document. `prompts` checks the
meaning.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Sequence
from itertools import accumulate, pairwise
from pathlib import Path
from typing import Any, NamedTuple

from stmc.io.files import write_text
from stmc.io.untrusted import UnreadableError, load_json, quote, read_text, truncate
from stmc.motion.body import BodyPart

MOST_BYTES = 8 * 2**20
"""Maximum size of a timeline file; 500 timelines take 0.1 MB at a hundred bytes per prompt."""

MOST_PROMPTS_IN_FILE = 50_000
"""Maximum number of prompts in all timelines of a document together."""


class TimelineError(ValueError):
    """An invalid timeline. The message names the place, the value and the legal values."""


class Entry(NamedTuple):
    """One prompt of a document: its place, its track (None if the format has no tracks) and its fields."""

    place: str
    track: int | None
    text: str
    start: float
    end: float
    parts: tuple[str, ...]


class Draft(NamedTuple):
    """One timeline of a document, with its prompts in the document's order."""

    place: str
    name: str
    entries: list[Entry]


MOST_FIELDS = 32
"""Maximum number of separators of a line; the rest counts as one field, which is no body part."""

LINE = "text # start # end # part # part"
KEYS = {"text": str, "start": float, "end": float, "body_parts": list}

COMPOSITION, COMPOSITION_FPS = ("text", "lengths", "id", "scenario", "fps"), 20
"""Keys of FlowMDM's format, and the default frame rate of its lengths, that of HumanML3D."""


def parse_text(document: str) -> list[Draft]:
    """Parse the timelines of a text: one prompt per line, blank lines between timelines. Errors name the line."""
    drafts: list[Draft] = []
    after_blank, count = True, 0
    for number, line in enumerate(document.removeprefix("\ufeff").splitlines(), start=1):
        if line.strip():
            if after_blank:
                drafts.append(Draft(f"line {number}", "", []))
            count += 1
            _check_prompt_count(count, f"line {number}")
            drafts[-1].entries.append(_entry_of_line(line, f"line {number}"))
        after_blank = not line.strip()
    if not drafts:
        raise TimelineError(f"the timeline is empty; write one prompt a line: {LINE} (seconds)")
    return drafts


def _entry_of_line(line: str, place: str) -> Entry:
    text, *rest = (field.strip() for field in line.split("#", MOST_FIELDS))
    if len(rest) < 2:
        missing = "has no start and no end" if not rest else "has no end"
        raise TimelineError(f"{place}: {quote(line.strip())} {missing}; write {LINE} (parts: {', '.join(BodyPart)})")
    times = []
    for name, field in zip(("start", "end"), rest, strict=False):
        try:
            times.append(float(field))
        except ValueError:
            raise TimelineError(f"{place}: {name} {quote(field)} is not a number of seconds; write {LINE}") from None
    start, end = times
    return Entry(place, None, text, start, end, tuple(rest[2:]))


def _check_prompt_count(count: int, place: str) -> None:
    if count > MOST_PROMPTS_IN_FILE:
        raise TimelineError(f"{place}: more than {MOST_PROMPTS_IN_FILE:,} prompts in one document, the limit")


def parse_json(document: str) -> list[Draft]:
    """Parse the timelines of a JSON document: one object or a list. Errors name the path, such as "tracks[0][1]"."""
    try:
        data = load_json(document.removeprefix("\ufeff"))
    except UnreadableError as error:
        raise TimelineError(str(error)) from None
    if not isinstance(data, list):
        return [_draft(data, "")]
    if not data:
        raise TimelineError("the list of timelines is empty; it needs at least one")
    drafts, count = [], 0
    for index, item in enumerate(data):
        drafts.append(_draft(item, f"[{index}]"))
        count += len(drafts[-1].entries)
        _check_prompt_count(count, f"[{index}]")
    return drafts


def _draft(data: Any, path: str) -> Draft:
    inside = f"{path}." if path else ""
    _expect(data, dict, path or "the document", 'a timeline, {"name": "…", "tracks": [[…], …]}')
    if "lengths" in data:
        return _composition(data, path, inside)
    _check_keys(data, ("name", "tracks"), path or "the document")
    name = _expect(data.get("name", ""), str, f"{inside}name", "a string")
    if "tracks" not in data:
        raise TimelineError(f'{path or "the document"}: no "tracks"; a timeline is {{"name": "…", "tracks": [[…], …]}}')
    _expect(data["tracks"], list, f"{inside}tracks", "a list of tracks, each a list of prompts")
    entries = []
    for track, prompts in enumerate(data["tracks"]):
        place = f"{inside}tracks[{track}]"
        _expect(prompts, list, place, "a list of prompts")
        entries += [_entry_of_object(prompt, f"{place}[{index}]", track) for index, prompt in enumerate(prompts)]
    return Draft(path, name, entries)


def moment(frame: int, fps: float | int) -> float:
    """Convert a frame to a second such that `int(fps * second)` is the frame, whatever the rounding of the quotient."""
    second = frame / fps
    return second if int(fps * second) == frame else math.nextafter(second, math.inf)


def _composition(data: dict[str, Any], path: str, inside: str) -> Draft:
    """Parse FlowMDM's format: consecutive texts on one track, and the length of each in frames."""
    _check_keys(data, COMPOSITION, path or "the document")
    fps = _expect(data.get("fps", COMPOSITION_FPS), float, f"{inside}fps", "frames a second")
    if not 0 < fps <= 1000:
        raise TimelineError(f"{inside}fps: {quote(fps)} is not above 0 and at most 1000 frames a second")
    texts, lengths = (_expect(data.get(key), list, f"{inside}{key}", "a list") for key in ("text", "lengths"))
    if len(texts) != len(lengths):
        raise TimelineError(f"{inside}text: {len(texts)} texts, but {len(lengths)} lengths; each text needs one")
    for key, values, kind, meaning in (("text", texts, str, "a string"), ("lengths", lengths, int, "whole frames")):
        for index, value in enumerate(values):
            _expect(value, kind, f"{inside}{key}[{index}]", meaning)
    edges = pairwise(moment(frame, fps) for frame in accumulate(lengths, initial=0))
    entries = [
        Entry(f"{inside}text[{index}]", 0, text, *span, ())
        for index, (text, span) in enumerate(zip(texts, edges, strict=True))
    ]
    return Draft(path, str(data.get("id", "")), entries)


def _entry_of_object(data: Any, path: str, track: int) -> Entry:
    _expect(data, dict, path, 'a prompt, {"text": "…", "start": 0, "end": 4.2, "body_parts": ["legs"]}')
    _check_keys(data, tuple(KEYS), path)
    for key in ("text", "start", "end"):
        if key not in data:
            raise TimelineError(f'{path}: no "{key}"; a prompt needs text, start and end, and may have body_parts')
    text = _expect(data["text"], str, f"{path}.text", "a string")
    start, end = (_expect(data[key], float, f"{path}.{key}", "a number of seconds") for key in ("start", "end"))
    parts = _expect(data.get("body_parts", []), list, f"{path}.body_parts", "a list of body parts")
    for index, part in enumerate(parts):
        _expect(part, str, f"{path}.body_parts[{index}]", f"one of {', '.join(BodyPart)}")
    return Entry(path, track, text, start, end, tuple(parts))


def _expect(value: Any, kind: type, path: str, meaning: str) -> Any:
    kinds = (int, float) if kind is float else kind
    if not isinstance(value, kinds) or isinstance(value, bool):
        raise TimelineError(f"{path}: {quote(value)} is not {meaning}")
    return value


def _check_keys(data: dict[str, Any], keys: Sequence[str], path: str) -> None:
    for key in data:
        if key not in keys:
            raise TimelineError(f"{path}: unknown key {quote(key)}; choose from {', '.join(keys)}")


def to_text(drafts: Sequence[Draft]) -> str:
    """Format timelines as text. Raises `TimelineError` if text cannot represent a prompt."""
    text = "\n".join("".join(f"{_line(entry)}\n" for entry in draft.entries) for draft in drafts)
    return f"\ufeff{text}" if text.startswith("\ufeff") else text  # readers strip the first one as a byte order mark


def _line(entry: Entry) -> str:
    if "#" in entry.text:
        text = quote(entry.text)
        raise TimelineError(f"the text {text} has a #, which separates fields in .txt; write .json instead")
    return " # ".join((entry.text, repr(entry.start), repr(entry.end), *entry.parts))


def to_json(drafts: Sequence[Draft]) -> str:
    """Format timelines as JSON: one object for one timeline, otherwise a list.

    Reading the result gives the same prompts in the same order.
    """
    objects = [_object(draft) for draft in drafts]
    return f"{objects[0]}\n" if len(objects) == 1 else "[" + ",\n".join(objects) + "]\n"


def _object(draft: Draft) -> str:
    """Format one timeline with one line per prompt, as a person would write it."""
    tracks = [",\n   ".join(map(_json, prompts)) for prompts in _tracks(draft.entries)]
    return f'{{"name": {_json(draft.name)}, "tracks": [\n  [' + "],\n  [".join(tracks) + "]]}"


def _json(data: Any) -> str:
    return json.dumps(data, ensure_ascii=False)


def _tracks(entries: Sequence[Entry]) -> list[list[dict[str, Any]]]:
    rows = [entry.track for entry in entries if entry.track is not None]
    if rows != sorted(rows):  # the order breaks ties, so it takes precedence over the tracks, which serve drawing only
        rows = _rows_in_order(entries)
    tracks: list[list[dict[str, Any]]] = [[] for _ in set(rows)]
    for row, entry in zip(rows, entries, strict=True):
        prompt = {"text": entry.text, "start": entry.start, "end": entry.end}
        tracks[row].append(prompt | ({"body_parts": list(entry.parts)} if entry.parts else {}))
    return tracks


def _rows_in_order(entries: Sequence[Entry]) -> list[int]:
    rows = [0]
    for before, entry in pairwise(entries):
        rows.append(rows[-1] + (entry.start < before.end))
    return rows


def named(path: str | Path) -> str:
    """Format a path for messages."""
    return truncate(str(path), 200)


def choose(suffix: str, json_form: Callable, text_form: Callable, place: str = "") -> Callable:
    """Select the function for a file's suffix.

    Args:
        suffix: Suffix of the file, with its dot.
        json_form: Function for ".json".
        text_form: Function for ".txt".
        place: Prefix of the error message.

    Raises:
        TimelineError: If the suffix is neither; the message lists the legal suffixes.
    """
    forms = {".json": json_form, ".txt": text_form}
    if suffix.lower() not in forms:
        raise TimelineError(f"{place}unknown kind of timeline file {quote(suffix)}; choose from {', '.join(forms)}")
    return forms[suffix.lower()]


def parse(document: str, suffix: str) -> list[Draft]:
    """Parse the timelines of a document in the format of files with that suffix.

    Raises `TimelineError` with the place in the document.
    """
    return choose(suffix, parse_json, parse_text)(document)


def read(path: Path) -> list[Draft]:
    """Read the timelines of a file, in the format of its suffix.

    Raises `TimelineError` with the name of the file and the place in it.
    """
    parse = choose(path.suffix, parse_json, parse_text, f"{named(path)}: ")
    try:
        return parse(read_text(path, MOST_BYTES))
    except UnreadableError as error:
        raise TimelineError(f"{named(path)}: {error}") from None
    except TimelineError as error:
        raise TimelineError(f"{named(path)}, {error}") from None


def write(drafts: Sequence[Draft], path: Path) -> None:
    """Write timelines in the format of the suffix, so that the file appears complete or not at all."""
    text = choose(path.suffix, to_json, to_text, f"{named(path)}: ")(drafts)
    write_text(path, text)
