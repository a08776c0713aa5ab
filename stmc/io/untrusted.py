"""Reads what strangers wrote: regular files of bounded size, JSON without duplicate keys, values short enough to show.

Knows neither formats nor what is asked for; each reader says in its own error what its file cannot mean.
"""

from __future__ import annotations

import json
import stat
from pathlib import Path
from typing import Any, BinaryIO

MOST_BYTES = 2**26
"""Of a data set's file of lines; HumanML3D's index has 3 MB."""

_CHUNK = 2**20

SHOWN = 60
"""How many characters of a value stand in a message."""


class UnreadableError(ValueError):
    """Not a file to be read, or not the JSON it should be; the message says why, but not which file."""


def read_bytes(path: Path, most: int) -> bytes:
    """The content of a regular file of at most `most` bytes; nothing else is opened, so that nothing is waited for.

    Raises:
        UnreadableError: For a directory, a pipe, a device, a loop of links, a path with a NUL, or a larger file.
        OSError: For a file that does not exist or may not be read, as `open` does.
    """
    try:
        status = path.stat()
    except FileNotFoundError:
        raise
    except (OSError, ValueError) as error:  # a loop of links, a name that is too long; a NUL or a lone surrogate
        raise UnreadableError(f"not a path to a file ({cut(getattr(error, 'strerror', None) or str(error))})") from None
    if not stat.S_ISREG(status.st_mode):
        kind = "a directory" if stat.S_ISDIR(status.st_mode) else "a pipe or a device"
        raise UnreadableError(f"{kind}, not a file")
    if status.st_size <= most:
        with path.open("rb") as file:
            content = _read_up_to(file, most + 1)
        if len(content) <= most:
            return content
    raise UnreadableError(f"larger than {most / 2**20:g} MiB, the limit for such a file")


def _read_up_to(file: BinaryIO, most: int) -> bytes:
    """At most so many bytes; `file.read(most)` would allocate as many for a small file, too."""
    chunks = []
    while most > 0 and (chunk := file.read(min(most, _CHUNK))):
        chunks.append(chunk)
        most -= len(chunk)
    return b"".join(chunks)


def read_text(path: Path, most: int) -> str:
    """The text of a file in UTF-8, with "\\n" for every end of a line. Raises as `read_bytes`."""
    try:
        text = read_bytes(path, most).decode("utf-8")
    except UnicodeDecodeError as error:
        raise UnreadableError(f"not UTF-8 text ({error.reason} at byte {error.start})") from None
    return text.replace("\r\n", "\n").replace("\r", "\n")


def read_lines(path: Path) -> list[str]:
    """The lines of a file in a data set; as `read_text`, but an `UnreadableError` names the file."""
    try:
        return read_text(path, MOST_BYTES).splitlines()
    except UnreadableError as error:
        raise UnreadableError(f"{path}: {error}") from None


def load_json(document: str) -> Any:
    """The data of a JSON document. Raises `UnreadableError` also for a key that an object has twice."""
    try:
        return json.loads(document, object_pairs_hook=_unique)
    except json.JSONDecodeError as error:
        raise UnreadableError(f"line {error.lineno}, column {error.colno}: not JSON ({error.msg})") from None
    except UnreadableError:
        raise
    except (ValueError, RecursionError) as error:  # a number of thousands of digits, thousands of brackets
        raise UnreadableError(f"not JSON that can be read ({cut(str(error), 100)})") from None


def _unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """An object whose keys are unique: which of two would count?"""
    data: dict[str, Any] = {}
    for key, value in pairs:
        if key in data:
            raise UnreadableError(f"the key {shown(key)} is duplicated in an object")
        data[key] = value
    return data


def shown(value: Any, most: int = SHOWN) -> str:
    """A value as a message shows it: on one line, escaped, cut after `most` characters; data as JSON."""
    if isinstance(value, str):
        quoted = repr(value[: most + 1])
        return quoted if len(quoted) <= most + 2 else quoted[: most - 1] + "…" + quoted[-1]
    if isinstance(value, int) and value.bit_length() > 3 * most:
        return f"an integer of {value.bit_length()} bits"
    if isinstance(value, float):
        return repr(value)
    text = ""
    for piece in json.JSONEncoder(ensure_ascii=False, default=str).iterencode(value):  # lazily: however deep or long
        text += piece[: most + 1]
        if len(text) > most:
            break
    return cut(text, most)


def cut(text: str, most: int = SHOWN) -> str:
    """At most `most` printable characters of a text, with … for what is left out; others are escaped."""
    escaped = "".join(letter if letter.isprintable() else repr(letter)[1:-1] for letter in text[: most + 1])
    return escaped if len(escaped) <= most else escaped[: most - 1] + "…"
