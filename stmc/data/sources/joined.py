"""Sentences about two actions at once, for composed motions: "walk forwards while waving".

Depends on actions and English; independent of motions and text encoders. The order of words has no meaning: either
action may come first.
"""

from __future__ import annotations

import zlib
from collections.abc import Collection, Mapping
from itertools import combinations

from stmc.data.sources.contents import CONTENTS, FORWARD_WALKS, Content

PER_PAIR = 2
"""Number of joined sentences per pair of actions: some thousand pairs have to be embedded."""
Phrase = tuple[str, str]
"""An imperative and its gerund: "walk forwards", "walking forwards"."""
Joined = Mapping[frozenset[str], tuple[str, ...]]
"""Sentences about two actions at once, by the actions' names."""


def join(first: Phrase, second: Phrase) -> tuple[str, ...]:
    """Return every sentence that describes `first` and `second` at the same time."""
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
    """Return `PER_PAIR` sentences about each pair of actions that can be shown at once.

    These are pairs that claim different body parts and both have gerunds. Unknown names are skipped. The phrases and
    forms of a pair depend on its names alone, so that all forms are equally frequent.
    """
    actions = sorted({CONTENTS[name] for name in names if name in CONTENTS and CONTENTS[name].gerunds}, key=_by_name)
    return {
        frozenset((first.name, second.name)): _choose(first, second)
        for first, second in combinations(actions, 2)
        if not first.parts & second.parts
    }


def _by_name(content: Content) -> str:
    return content.name


def _choose(first: Content, second: Content) -> tuple[str, ...]:
    """Choose the sentences of a pair; the three forward walks share theirs."""
    names = ["walk" if action.name in FORWARD_WALKS else action.name for action in (first, second)]
    number = zlib.crc32(" ".join(names).encode())
    forms = join(*(action.gerunds[number // 8 % len(action.gerunds)] for action in (first, second)))
    return tuple(forms[(number + index * 3) % len(forms)] for index in range(PER_PAIR))
