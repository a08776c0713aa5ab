"""File names that are valid on Linux, macOS and Windows. Independent of the files' content."""

from __future__ import annotations

import hashlib
import re
import unicodedata
from collections.abc import Iterable, Iterator
from itertools import chain, count

MOST = 150
"""Bytes of a name; a number and a suffix still fit after it (file systems allow 255)."""
_DEVICES = {"con", "prn", "aux", "nul", *(f"{port}{number}" for port in ("com", "lpt") for number in range(10))}


def safe_name(name: str) -> str:
    """Turn a name into a file name of letters, digits, `_`, `.` and `-`.

    The result does not begin with a dot, a dash or an underscore, is not a Windows device, and has at most `MOST`
    bytes; a hash replaces a longer name's end. It is empty if no character is left.
    """
    base = re.sub(r"[^\w.-]+", "_", unicodedata.normalize("NFC", name)).lstrip("._-").rstrip("._")
    stem, dot, rest = base.partition(".")
    if stem.lower() in _DEVICES:
        base = f"{stem}_{dot}{rest}"
    encoded = base.encode()
    if len(encoded) <= MOST:
        return base
    return f"{encoded[: MOST - 9].decode(errors='ignore')}_{hashlib.sha256(encoded).hexdigest()[:8]}"


def distinct_names(names: Iterable[str], stem: str) -> Iterator[str]:
    """Yield a safe name for each name; all differ, regardless of case.

    A name that is taken already gets its index as a suffix. A name without a valid character becomes `stem` and its
    index.
    """
    taken: set[str] = set()
    for index, name in enumerate(names):
        base = safe_name(name) or f"{safe_name(stem) or 'timeline'}_{index:04d}"
        candidates = chain([base], (f"{base}_{number:04d}" for number in count(index)))
        chosen = next(candidate for candidate in candidates if candidate.casefold() not in taken)
        taken.add(chosen.casefold())
        yield chosen


def name_of_texts(texts: Iterable[str]) -> str:
    """Make a file name of texts, such as `walk_raise-the-right-arm`.

    Different texts have different names: if letters, digits and spaces do not tell them apart, a hash follows.
    """
    texts = list(texts)
    words = [re.sub(r"[\W_]+", "-", text).strip("-").lower() for text in texts]
    name = "_".join(words)
    if [word.replace("-", " ") for word in words] != texts:
        name += f"-{hashlib.sha256(chr(0).join(texts).encode(errors='surrogatepass')).hexdigest()[:6]}"
    return safe_name(name)
