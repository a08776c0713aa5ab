"""Edits of a stream as JSON objects: what `stmc stream` reads line by line, and the studio's page sends."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from stmc.editing.streaming import MotionStream
from stmc.settings.records import SettingError, check_name, check_value
from stmc.timeline import Prompt, TimelineError

_PROMPT = ("text", "start", "end", "seconds", "body_parts")


def apply_edit(stream: MotionStream, edit: Mapping[str, Any]) -> dict[str, Any]:
    """Apply an edit, and return the answer to it as a JSON object.

    - `{"add": {"text": "wave", "start": 4, "end": 6, "body_parts": ["right arm"]}}` → `{"added": 3, "start": 4, "end":
      6}`; without `start`, from the next frame on; `seconds` may replace `end`.
    - `{"move": 3, "start": 5, "end": 7}` → `{"moved": 3, "start": 5, "end": 7}`; an omitted time stays.
    - `{"remove": 3}` → `{"removed": 3}`.

    Raises:
        SettingError: If the object is not an edit.
        TimelineError: If the stream refuses the edit, as everything before the next frame.

    Examples:
        >>> stream = stmc.load().stream()
        >>> stmc.editing.stream_edits.apply_edit(stream, {"add": {"text": "walk", "seconds": 4}})
        {'added': 0, 'start': 0.0, 'end': 4.0}
    """
    kind = next((name for name in _EDITS if name in edit), None)
    if kind is None:
        raise SettingError(f"edit: must be an object with one of the keys {', '.join(_EDITS)}")
    return _EDITS[kind](stream, edit)


def answer_edit(stream: MotionStream, edit: Mapping[str, Any]) -> dict[str, Any]:
    """Apply an edit, and return the answer with the number of the next frame; a refused one gets an `error`.

    Examples:
        >>> stmc.editing.stream_edits.answer_edit(stmc.load().stream(), {"remove": 0})
        {'error': 'there is no prompt 0: there are none', 'frame': 0}
    """
    try:
        return {**apply_edit(stream, edit), "frame": stream.cursor}
    except (SettingError, TimelineError) as error:
        return {"error": str(error), "frame": stream.cursor}


def _add(stream: MotionStream, edit: Mapping[str, Any]) -> dict[str, Any]:
    _check_keys(edit, ("add",))
    values = edit["add"]
    check_value("add", values, Mapping)
    _check_keys(values, _PROMPT)
    check_value("text", values.get("text"), str)
    start = _number(values, "start", stream.now)
    if ("seconds" in values) == ("end" in values):
        raise SettingError("add: a prompt needs either its end or its seconds")
    if "seconds" in values and _number(values, "seconds") <= 0:
        raise SettingError(f"seconds={values['seconds']:g}: must be above 0")
    end = start + values["seconds"] if "seconds" in values else _number(values, "end")
    parts = values.get("body_parts", [])
    check_value("body_parts", tuple(parts) if isinstance(parts, list) else parts, tuple[str, ...])
    number = stream.add(Prompt(values["text"], start, end, parts))
    return {"added": number, "start": start, "end": end}


def _move(stream: MotionStream, edit: Mapping[str, Any]) -> dict[str, Any]:
    _check_keys(edit, ("move", "start", "end"))
    number = _prompt_number(edit, "move")
    before = stream.prompts.get(number)
    start = _number(edit, "start", before.start if before else 0.0)
    end = _number(edit, "end", before.end if before else 1.0)
    stream.move(number, start, end)
    return {"moved": number, "start": start, "end": end}


def _remove(stream: MotionStream, edit: Mapping[str, Any]) -> dict[str, Any]:
    _check_keys(edit, ("remove",))
    number = _prompt_number(edit, "remove")
    stream.remove(number)
    return {"removed": number}


_EDITS = {"add": _add, "move": _move, "remove": _remove}


def _prompt_number(edit: Mapping[str, Any], name: str) -> int:
    check_value(name, edit[name], int)
    return edit[name]


def _number(values: Mapping[str, Any], name: str, default: float | None = None) -> float:
    value = values.get(name, default)
    check_value(name, value, float)
    return float(value)


def _check_keys(values: Mapping[str, Any], valid: tuple[str, ...]) -> None:
    for name in values:
        check_name(name, valid, "key")
