"""Sentences about two contents at once, for bodies that are composed of the two: "walk forwards while waving".

Knows contents and English; knows no motion and no text encoder. The order of words tells nothing: either content may
come first.
"""

from __future__ import annotations

import zlib
from collections.abc import Collection, Mapping
from itertools import combinations

from stmc.data.sources.contents import CONTENTS, FORWARD_WALKS, Content

PER_PAIR = 2
"""Joined sentences of each pair of contents: some thousand pairs are to be embedded."""

Phrase = tuple[str, str]
"""An imperative and its gerund: "walk forwards", "walking forwards"."""

Joined = Mapping[frozenset[str], tuple[str, ...]]
"""Sentences about two contents at once, by the contents' names."""


def join(first: Phrase, second: Phrase) -> tuple[str, ...]:
    """Every sentence that says that `first` and `second` happen at the same time."""
    (do, doing), (also_do, also_doing) = first, second
    return (
        f"{do} while {also_doing}",
        f"{also_do} while {doing}",
        f"{do} and {also_do}",
        f"{also_do} and {do}",
        f"{do}, {also_doing}",
        f"{doing} and {also_doing}",
        f"a person is {also_doing} while {doing}",
        f"{do} and {also_do} at the same time",
    )


def joined_sentences(names: Collection[str]) -> Joined:
    """`PER_PAIR` sentences about each two of the contents `names` that can be shown at once.

    Two contents can be if they claim different body parts and both have gerunds. Names that no content has are skipped.
    Which phrases and which form a pair gets follows from its names alone, so that all forms occur alike.
    """
    known = sorted({CONTENTS[name] for name in names if name in CONTENTS and CONTENTS[name].gerunds}, key=_by_name)
    return {
        frozenset((first.name, second.name)): _chosen(first, second)
        for first, second in combinations(known, 2)
        if not first.parts & second.parts
    }


def _by_name(content: Content) -> str:
    return content.name


def _chosen(first: Content, second: Content) -> tuple[str, ...]:
    """The sentences of a pair; those of the three forward walks are the same."""
    names = ["walk" if each.name in FORWARD_WALKS else each.name for each in (first, second)]
    number = zlib.crc32(" ".join(names).encode())
    forms = join(*(each.gerunds[number // 8 % len(each.gerunds)] for each in (first, second)))
    return tuple(forms[(number + place * 3) % len(forms)] for place in range(PER_PAIR))
