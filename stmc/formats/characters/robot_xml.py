"""XML of robots, read as hostile: files of bounded size, without document types and so without entities.

Knows elements and numbers; knows no robot.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element
from xml.parsers import expat

import numpy as np
from jaxtyping import Float

from stmc.formats.characters.gltf_file import CharacterError
from stmc.io.untrusted import UnreadableError, quote, read_bytes, truncate

MOST_BYTES = 2**24
"""A file's limit: 16 MiB; a robot of 200 links has 200 kB."""
MOST_ELEMENTS = 50_000
_DEEPEST = 200
_MOST_NUMBER = 1e6
"""The limit of every length and angle."""


def read_xml(path: Path) -> Element:
    """Parse a file. Raise `CharacterError` for what is no XML, has a document type, or is larger than the bounds."""
    try:
        content = read_bytes(path, MOST_BYTES)
    except UnreadableError as error:
        raise CharacterError(str(error)) from None
    open_elements, count = [Element("")], 0

    def start(tag: str, attributes: dict[str, str]) -> None:
        nonlocal count
        count += 1
        if count > MOST_ELEMENTS or len(open_elements) > _DEEPEST:
            raise CharacterError(f"more than {MOST_ELEMENTS:,} elements, or more than {_DEEPEST} deep")
        element = Element(tag, attributes)
        open_elements[-1].append(element)
        open_elements.append(element)

    _parse(content, start, lambda tag: open_elements.pop())
    return open_elements[0][0]


def _parse(content: bytes, start: Callable[..., Any], end: Callable[..., Any]) -> None:
    parser = expat.ParserCreate()
    parser.StartElementHandler, parser.EndElementHandler = start, end
    parser.StartDoctypeDeclHandler = _refuse_doctype
    try:
        parser.Parse(content, True)
    except CharacterError:
        raise
    except expat.ExpatError as error:
        message = expat.ErrorString(error.code)
        raise CharacterError(f"line {error.lineno}, column {error.offset + 1}: not XML ({message})") from None
    except (ValueError, LookupError) as error:  # an encoding that expat does not know
        raise CharacterError(f"not XML ({truncate(str(error), 100)})") from None


def _refuse_doctype(*_: Any) -> None:
    raise CharacterError("it has a document type (<!DOCTYPE>), which is not supported: remove it")


def numbers(element: Element, name: str, counts: tuple[int, ...], place: str) -> Float[np.ndarray, " _"] | None:
    """Return the finite numbers of an attribute, None if the element has none.

    Args:
        element: Element with the attribute.
        name: Name of the attribute.
        counts: Numbers that it may have.
        place: The element's name for the message.

    Raises:
        CharacterError: For other content; the message names the place and the attribute.
    """
    text = element.get(name)
    if text is None:
        return None
    words = text.split()
    try:
        values = np.array([float(word) for word in words])
    except ValueError:
        raise CharacterError(f"{name} of {place} is {quote(text)}, which is not a list of numbers") from None
    if len(values) not in counts:
        wanted = " or ".join(map(str, counts)) if len(counts) < 4 else f"up to {counts[-1]}"
        raise CharacterError(f"{name} of {place} is {quote(text)}: it must have {wanted} numbers")
    if not (np.abs(values) <= _MOST_NUMBER).all():
        raise CharacterError(f"{name} of {place} is {quote(text)}, which is not finite and up to {_MOST_NUMBER:g}")
    return values


def number(element: Element, name: str, default: float, place: str) -> float:
    """Return the number of an attribute, or the default without one. Raises as `numbers`."""
    values = numbers(element, name, (1,), place)
    return default if values is None else float(values[0])


def unit(vector: Float[np.ndarray, " 3"], name: str, place: str) -> Float[np.ndarray, " 3"]:
    """Return a vector of length 1. Raise `CharacterError` for one without a direction."""
    length = np.linalg.norm(vector)
    if not length > 1e-9:
        raise CharacterError(f"{name} of {place} is {quote(vector.tolist())}, which has no direction")
    return vector / length
