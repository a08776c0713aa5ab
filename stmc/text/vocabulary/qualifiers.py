"""Words of a text that qualify its action by side, direction and speed, or join actions; the text of its mirror image.

A closed table of English words; independent of sentences, embeddings and actions.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from types import MappingProxyType
from typing import Literal

Kind = Literal["side", "direction", "speed"]

Qualifiers = Mapping[Kind, frozenset[str]]
"""Values named by a text, by kind; a kind that the text does not name is absent."""

_ASIDE = r"(?! (?:away|now|after|before|here|there|behind|in front|next|up|down|angles?)\b)"
"""Words after "right" with which it names no side."""

_WORDS: Mapping[Kind, Mapping[str, re.Pattern[str]]] = MappingProxyType({
    "side": {
        "left": re.compile(r"\bleft(?:wards?)?\b|\b(?:counter|anti)[- ]?clockwise\b"),
        "right": re.compile(
            rf"(?<!\ball )\bright(?:wards?)?\b{_ASIDE}"
            r"|(?<!counter)(?<!anti)(?<!counter[- ])(?<!anti[- ])clockwise\b"
        ),
        "both": re.compile(r"\bboth\b|\btwo (?:arms|hands|fists|feet|legs)\b"),
    },
    "direction": {
        "forward": re.compile(r"\b(?:for|on)wards?\b|\bahead\b"),
        "backward": re.compile(r"\b(?:back|rear)wards?\b|\bin reverse\b"),
        "sideways": re.compile(r"\bside(?:ways|wards)\b|\blaterally\b"),
    },
    "speed": {
        "slow": re.compile(r"\bslow(?:ly|er)?\b|\b(?:leisurely|unhurried(?:ly)?)\b"),
        "quick": re.compile(
            r"\b(?:quick|rapid|brisk|swift|hurried)(?:ly)?\b|\b(?:quicker|fast|faster|speedy|speedily)\b"
        ),
    },
})  # fmt: skip
"""Seen from above, counterclockwise is to the left."""

_BOTH = frozenset({"left", "right"})

_DEFAULTS: Mapping[Kind, frozenset[str]] = MappingProxyType({"side": _BOTH, "direction": frozenset({"forward"})})
"""Implied values: a jog goes forwards, and applause uses both hands."""


def read_qualifiers(text: str) -> Qualifiers:
    """Find the side ("left", "right"), direction ("forward", "backward", "sideways") and speed ("slow", "quick").

    "Both" hands or feet are the left and the right.

    Examples:
        >>> sorted(read_qualifiers("jog backwards, slowly, with both hands up").items())
        [('direction', frozenset({'backward'})), ('side', frozenset({'left', 'right'})), ('speed', frozenset({'slow'}))]
    """
    lower = " ".join(text.lower().split())
    named = {kind: {value for value, words in table.items() if words.search(lower)} for kind, table in _WORDS.items()}
    if "both" in named["side"]:
        named["side"] = set(_BOTH)
    return {kind: frozenset(values) for kind, values in named.items() if values}


def agree(requested: Qualifiers, present: Qualifiers) -> bool:
    """Tell whether a text with the qualifiers `present` shows an action as `requested`.

    A kind that is not requested may have any value. A requested side or direction must be named, unless it is implied;
    a named speed must be the requested one. Several directions or speeds request a change over time, which is not
    judged.
    """
    return all(_agrees(kind, values, present.get(kind)) for kind, values in requested.items())


def without_defaults(requested: Qualifiers) -> Qualifiers:
    """Drop implied values."""
    return {kind: values for kind, values in requested.items() if values != _DEFAULTS.get(kind)}


def _agrees(kind: Kind, requested: frozenset[str], present: frozenset[str] | None) -> bool:
    if kind != "side" and len(requested) > 1:
        return True
    if present is None:
        return requested == _DEFAULTS.get(kind, requested)
    return requested == present


def mirrored(text: str) -> str:
    """Rewrite a text for the mirror image: left ↔ right, clockwise ↔ counterclockwise, with case and the rest kept.

    It replaces whole words only ("upright" stays), also within names ("raise-up-left-hand") and before "-ward(s)".
    Every spelling of anticlockwise becomes clockwise, and clockwise becomes counterclockwise.
    """
    return _SIDED.sub(_swap, text)


def may_name_several(text: str) -> bool:
    """Tell whether a text has a word that stands between actions; a mean embedding keeps one of them only.

    Examples:
        >>> [may_name_several(text) for text in ("sit down and get up again", "sit down")]
        [True, False]
    """
    return _BETWEEN.search(text) is not None


_BETWEEN = re.compile(r"\b(?:and|then|while|before|after)\b|,", flags=re.IGNORECASE)


def without_side(text: str) -> str:
    """Rewrite a text so that it names no side: "wave with the left hand" becomes "wave".

    Examples:
        >>> [without_side(text) for text in ("look left", "throw a left jab", "hop to the right")]
        ['look', 'throw a jab', 'hop']
    """
    return " ".join(_SIDE_WORDS.sub(" ", text).split()).strip(" ,")


_SIDE_WORDS = re.compile(
    r"\b(?:(?:with|using|on|to|in|towards|by) )?(?:(?:the|a|your|his|her|their|its) )?(?:left|right)(?:wards?|-handed)?"
    r"(?: (?:hand|arm|fist|foot|leg|side))?\b",
    flags=re.IGNORECASE,
)

_SIDED = re.compile(
    r"(?<![a-z])(left|right|clockwise|(?:counter|anti)[- ]?clockwise)(?=(?:wards?)?(?![a-z]))", flags=re.IGNORECASE
)


def _swap(match: re.Match[str]) -> str:
    word = match[0]
    other = {"left": "right", "right": "left", "clockwise": "counterclockwise"}.get(word.lower(), "clockwise")
    if word.isupper():
        return other.upper()
    return other.capitalize() if word[0].isupper() else other
