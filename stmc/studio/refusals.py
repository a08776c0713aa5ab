"""What the studio refuses, and reading what a page sends: JSON of known shape, within bounds."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

from stmc.untrusted import UnreadableError, cut, load_json


class Refused(ValueError):
    """A request that cannot be met: an HTTP status, a sentence, and what else the page should know."""

    def __init__(self, status: int, message: str, **others: Any) -> None:
        super().__init__(message)
        self.status, self.others = status, others


def read_object(body: bytes) -> dict[str, Any]:
    """The JSON object of a request's body. Raises `Refused`."""
    try:
        data = load_json(body.decode("utf-8"))
    except UnicodeDecodeError:
        raise Refused(400, "the request is not UTF-8") from None
    except (UnreadableError, RecursionError) as error:
        raise Refused(400, f"the request is not JSON: {error}") from None
    if not isinstance(data, dict):
        raise Refused(400, "the request should be a JSON object")
    return data


def take(data: Mapping[str, Any], name: str, kind: type | tuple[type, ...], default: Any = ...) -> Any:
    """The value of a key, of the right kind. Raises `Refused` where it is another one, or missing without a default."""
    value = data.get(name, default)
    if value is ...:
        raise Refused(422, f"{name} is missing")
    if value is not default and (not isinstance(value, kind) or (isinstance(value, bool) and kind is not bool)):
        kinds = kind if isinstance(kind, tuple) else (kind,)
        raise Refused(422, f"{name}={cut(json.dumps(value))}: {' or '.join(each.__name__ for each in kinds)} needed")
    return value
