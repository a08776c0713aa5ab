"""Names that every file system takes: Linux's, macOS' and Windows'. Knows nothing of what is in the files."""

from __future__ import annotations

import hashlib
import re
import unicodedata
from collections.abc import Iterable, Iterator
from itertools import chain, count

MOST = 150
"""Bytes of a name, so that a number and a suffix fit behind it (file systems take 255)."""

_DEVICES = {"con", "prn", "aux", "nul", *(f"{port}{number}" for port in ("com", "lpt") for number in range(10))}


def safe(name: str) -> str:
    """A name as a file name: letters, digits, `_`, `.` and `-` alone, none of them dots or dashes in front, no device
    of Windows, and at most `MOST` bytes; what is cut off is replaced by a hash. Empty where nothing is left."""
    kept = re.sub(r"[^\w.-]+", "_", unicodedata.normalize("NFC", name)).lstrip("._-").rstrip("._")
    stem, dot, rest = kept.partition(".")
    if stem.lower() in _DEVICES:
        kept = f"{stem}_{dot}{rest}"
    whole = kept.encode()
    if len(whole) <= MOST:
        return kept
    return f"{whole[: MOST - 9].decode(errors='ignore')}_{hashlib.sha256(whole).hexdigest()[:8]}"


def distinct(names: Iterable[str], stem: str) -> Iterator[str]:
    """A safe name for each, no two of which differ in upper and lower case alone: the name itself, behind it the place
    in the list where others took it, or `stem` and the place where it says nothing."""
    taken: set[str] = set()
    for place, name in enumerate(names):
        base = safe(name) or f"{safe(stem) or 'timeline'}_{place:04d}"
        tried = chain([base], (f"{base}_{number:04d}" for number in count(place)))
        chosen = next(each for each in tried if each.casefold() not in taken)
        taken.add(chosen.casefold())
        yield chosen


def name_of_texts(texts: Iterable[str]) -> str:
    """A file name that says texts: `walk_raise-the-right-arm`. Other texts have another name: where letters, digits and
    spaces do not say all, a hash follows."""
    texts = list(texts)
    words = [re.sub(r"[\W_]+", "-", text).strip("-").lower() for text in texts]
    name = "_".join(words)
    if [word.replace("-", " ") for word in words] != texts:
        name += f"-{hashlib.sha256(chr(0).join(texts).encode(errors='surrogatepass')).hexdigest()[:6]}"
    return safe(name)
