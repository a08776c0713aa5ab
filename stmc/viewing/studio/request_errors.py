"""Errors of the studio, and reading of requests: JSON of known shape, within bounds."""

from __future__ import annotations

import errno
import json
import math
from collections.abc import Mapping
from typing import Any

from stmc.io.files import FolderInUse
from stmc.io.untrusted import UnreadableError, load_json, quote, truncate
from stmc.settings.records import SettingError
from stmc.timeline import TimelineError

MOST_NUMBER = 2**53 - 1
"""Largest portable integer of JSON (RFC 7493)."""

_FULL = {errno.ENOSPC, errno.EDQUOT, errno.EFBIG}


class RequestError(ValueError):
    """Error for a request that cannot be fulfilled: an HTTP status, a message, and further data for the page."""

    def __init__(self, status: int, message: str, **others: Any) -> None:
        super().__init__(message)
        self.status, self.others = status, others


def request_error(error: Exception) -> RequestError | None:
    """Convert an error that the user can fix into a `RequestError`; return None for a bug."""
    if isinstance(error, RequestError):
        return error
    if isinstance(error, (SettingError, TimelineError)):
        return RequestError(422, str(error))
    if isinstance(error, FolderInUse):
        return RequestError(503, "another program is writing in the studio's folder; try again")
    if isinstance(error, OSError):
        if error.errno in _FULL:
            return RequestError(507, "the disk is full, so this was not saved; free some space and try again")
        return RequestError(503, f"the studio's folder cannot be used: {truncate(error.strerror or str(error), 100)}")
    if isinstance(error, MemoryError) or "can't allocate memory" in str(error):  # torch has no class for it
        return RequestError(503, "there is not enough memory for this; make it shorter")
    return None


def read_object(body: bytes) -> dict[str, Any]:
    """Read the JSON object of a request's body. Raises `RequestError` for anything else."""
    try:
        data = read_value(body.decode("utf-8"), "the request")
    except UnicodeDecodeError:
        raise RequestError(400, "the request is not UTF-8") from None
    if not isinstance(data, dict):
        raise RequestError(400, "the request should be a JSON object")
    return data


def read_value(text: str, name: str) -> Any:
    """Read a JSON value of a request, called `name` in messages. Raises `RequestError` for anything else."""
    try:
        data = load_json(text)
    except (UnreadableError, RecursionError) as error:
        raise RequestError(400, f"{name} is not JSON: {error}") from None
    _check_portable(data)
    return data


def _check_portable(data: Any) -> None:
    """Raise `RequestError` for values that are not portable JSON.

    These are NaN, infinities, numbers beyond `MOST_NUMBER`, and halves of surrogate pairs.
    """
    left = [data]
    while left:
        value = left.pop()
        if isinstance(value, dict):
            left += [*value, *value.values()]
        elif isinstance(value, list):
            left += value
        elif isinstance(value, str):
            if not value.isascii() and any("\ud800" <= letter <= "\udfff" for letter in value):
                raise RequestError(422, f"{quote(value)} has half of a surrogate pair, which is no text")
        elif isinstance(value, (int, float)) and not abs(value) <= MOST_NUMBER:
            raise RequestError(422, f"{_number(value)}: must be a finite number up to 2**53")


def _number(value: float | int) -> str:
    return quote(value) if isinstance(value, int) or math.isfinite(value) else f"{value}"


def take(data: Mapping[str, Any], name: str, kind: type | tuple[type, ...], default: Any = ...) -> Any:
    """Return the value of a key.

    Raises `RequestError` if it has another type, or is missing without a default.

    Args:
        data: JSON object.
        name: Key.
        kind: Type or types of the value.
        default: Value for a missing key.
    """
    value = data.get(name, default)
    if value is ...:
        raise RequestError(422, f"{name} is missing")
    if value is not default and (not isinstance(value, kind) or (isinstance(value, bool) and kind is not bool)):
        kinds = kind if isinstance(kind, tuple) else (kind,)
        raise RequestError(
            422, f"{name}={truncate(json.dumps(value))}: {' or '.join(each.__name__ for each in kinds)} expected"
        )
    return value


def take_texts(data: Mapping[str, Any], name: str) -> list[str]:
    """Return a list of texts, empty if the key is missing. Raises `RequestError` for anything else."""
    values = take(data, name, list, [])
    for value in values:
        if not isinstance(value, str):
            raise RequestError(422, f"{name}: {quote(value)} is no text")
    return values
