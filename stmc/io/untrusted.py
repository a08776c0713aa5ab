"""Safe reading of untrusted files: regular files of bounded size, JSON without duplicate keys, short quotes of values.

Independent of formats: each reader describes the errors of its own format.
"""

from __future__ import annotations

import json
import stat
from pathlib import Path
from typing import Any, BinaryIO

MOST_BYTES = 2**26
"""Maximum size of a data set's file of lines; HumanML3D's index has 3 MB."""
_CHUNK = 2**20

MAX_QUOTED = 60
"""Maximum number of characters of a value in a message."""


class UnreadableError(ValueError):
    """A file that cannot be read, or invalid JSON; the message gives the reason, but not the name of the file."""


def read_bytes(path: Path, most: int) -> bytes:
    """Read a regular file of at most `most` bytes. Nothing else is opened, so that the call never blocks.

    Raises:
        UnreadableError: If the path is a directory, a pipe, a device, a loop of links or contains a NUL, or if the file
            is larger.
        OSError: If the file does not exist or may not be read, as for `open`.
    """
    try:
        status = path.stat()
    except FileNotFoundError:
        raise
    except (OSError, ValueError) as error:  # a loop of links, a long name; a NUL or a lone surrogate
        raise UnreadableError(
            f"not a path to a file ({truncate(getattr(error, 'strerror', None) or str(error))})"
        ) from None
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
    """Read at most `most` bytes in chunks; `file.read(most)` would allocate `most` bytes for a small file, too."""
    chunks = []
    while most > 0 and (chunk := file.read(min(most, _CHUNK))):
        chunks.append(chunk)
        most -= len(chunk)
    return b"".join(chunks)


def read_text(path: Path, most: int) -> str:
    r"""Read a UTF-8 file, with "\\n" for every line end. Raises as `read_bytes`."""
    try:
        text = read_bytes(path, most).decode("utf-8")
    except UnicodeDecodeError as error:
        raise UnreadableError(f"not UTF-8 text ({error.reason} at byte {error.start})") from None
    return text.replace("\r\n", "\n").replace("\r", "\n")


def read_lines(path: Path) -> list[str]:
    """Read the lines of a file in a data set, as `read_text`; an `UnreadableError` names the file."""
    try:
        return read_text(path, MOST_BYTES).splitlines()
    except UnreadableError as error:
        raise UnreadableError(f"{path}: {error}") from None


def load_json(document: str) -> Any:
    """Parse a JSON document. Raises `UnreadableError` also if an object has a duplicate key."""
    try:
        return json.loads(document, object_pairs_hook=_build_object)
    except json.JSONDecodeError as error:
        raise UnreadableError(f"line {error.lineno}, column {error.colno}: not JSON ({error.msg})") from None
    except UnreadableError:
        raise
    except (ValueError, RecursionError) as error:  # thousands of digits or brackets
        raise UnreadableError(f"not JSON that can be read ({truncate(str(error), 100)})") from None


def _build_object(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """Build an object, and reject duplicate keys, because their meaning is ambiguous."""
    data: dict[str, Any] = {}
    for key, value in pairs:
        if key in data:
            raise UnreadableError(f"the key {quote(key)} is duplicated in an object")
        data[key] = value
    return data


def quote(value: Any, most: int = MAX_QUOTED) -> str:
    """Quote a value for a message: on one line, escaped, truncated after `most` characters; data as JSON."""
    if isinstance(value, str):
        quoted = repr(value[: most + 1])
        return quoted if len(quoted) <= most + 2 else quoted[: most - 1] + "…" + quoted[-1]
    if isinstance(value, int) and value.bit_length() > 3 * most:
        return f"an integer of {value.bit_length()} bits"
    if isinstance(value, float):
        return repr(value)
    text = ""
    for chunk in json.JSONEncoder(ensure_ascii=False, default=str).iterencode(value):  # lazy, for any depth or length
        text += chunk[: most + 1]
        if len(text) > most:
            break
    return truncate(text, most)


def truncate(text: str, most: int = MAX_QUOTED) -> str:
    """Truncate a text to `most` printable characters, with … for the rest; other characters are escaped."""
    escaped = "".join(letter if letter.isprintable() else repr(letter)[1:-1] for letter in text[: most + 1])
    return escaped if len(escaped) <= most else escaped[: most - 1] + "…"
