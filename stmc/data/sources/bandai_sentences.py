"""What people would write about what clips show: contents, styles and their mirror images.

Knows the Bandai Namco dataset's content and style labels, the contents of `assets/segments.json` and English; knows no
recordings, no motion and no text encoder.
Sentences that name a side are written once, for the left; those of the right are their mirror images, so that a
mirrored clip always has a sentence of its own.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType

from stmc.body import BodyPart
from stmc.data.sources.segments import table

PLAIN_SHARE = 0.5
"""Share of the draws in which a styled clip is described without its style, so that plain texts reach every style."""

ALWAYS_STYLED = frozenset((f"raise-up-{side}", "feminine") for side in ("left-hand", "right-hand", "both-hands"))
"""Clips that no plain sentence describes: these raises end at the shoulder, lower than "raise the arm" would mean."""

ARMS = frozenset({BodyPart.LEFT_ARM, BodyPart.RIGHT_ARM})
LEGS = frozenset({BodyPart.LEGS})
BOW = frozenset({BodyPart.HEAD, BodyPart.SPINE})
EVERYTHING = frozenset(BodyPart)


@dataclass(frozen=True)
class Content:
    """What a clip shows. `parts` are those a prompt would claim for it; `cyclic` means that any trim of the clip still
    shows the content, whereas of the others the middle has to stay in; `sentences` are plain descriptions, any of which
    can be followed by a phrase of `STYLES`."""

    name: str
    parts: frozenset[BodyPart]
    cyclic: bool
    sentences: tuple[str, ...]


def mirrored(text: str) -> str:
    """`text` about the mirror image: left ↔ right, clockwise ↔ counterclockwise, case and everything else kept.

    Whole words only ("upright" stays), also within names ("raise-up-left-hand") and before "-ward(s)"; every spelling
    of anticlockwise becomes clockwise, and clockwise becomes counterclockwise.
    """
    return _SIDED.sub(_swap, text)


_SIDED = re.compile(
    r"(?<![a-z])(left|right|clockwise|(?:counter|anti)[- ]?clockwise)(?=(?:wards?)?(?![a-z]))", flags=re.IGNORECASE
)


def _swap(match: re.Match[str]) -> str:
    word = match[0]
    other = {"left": "right", "right": "left", "clockwise": "counterclockwise"}.get(word.lower(), "clockwise")
    if word.isupper():
        return other.upper()
    return other.capitalize() if word[0].isupper() else other


_WALK = (
    "walk",
    "walk forward",
    "walk forwards",
    "walk straight ahead",
    "a person walks",
    "a person walks forward",
    "a person walks forwards",
    "the person is walking forward",
    "someone walks forwards in a straight line",
    "a man takes several steps forward",
    "a figure walks ahead at a normal pace",
    "walking",
    "walking forwards",
    "he strolls forwards",
)

_TURN_LEFT = (
    "turn left",
    "turn to the left",
    "walk and turn left",
    "walk and turn to the left",
    "walk forwards then turn left",
    "walk in a quarter circle to the left",
    "a person turns left",
    "a person walks forward and turns to the left",
    "the person makes a left turn while walking",
    "someone turns to their left and keeps walking",
    "turning left",
    "walking and turning left",
    "make a 90 degree turn to the left",
    "turn counterclockwise while walking",
)

_RAISE_LEFT = (
    "raise the left arm",
    "raise the left hand",
    "raise left arm",
    "raise your left hand",
    "lift the left arm",
    "lift the left hand up",
    "a person raises the left arm",
    "a person raises their left hand",
    "the person lifts his left arm up in the air",
    "someone puts their left hand up",
    "raising the left arm",
    "raising the left hand high",
    "raise the left arm in the air",
    "raises the left hand and lowers it again",
)

_RAISE_BOTH = (
    "raise both arms",
    "raise both hands",
    "raise both arms in the air",
    "raise the arms",
    "raise your hands",
    "lift both arms",
    "lift both hands up",
    "a person raises both arms",
    "a person raises both hands high",
    "the person lifts his arms up in the air",
    "someone puts both hands up",
    "raising both arms",
    "raising both hands in the air",
    "raises the hands and lowers them again",
)

_WAVE_LEFT = (
    "wave with the left hand",
    "wave the left hand",
    "wave with the left arm",
    "wave your left hand",
    "waves with his left hand",
    "a person waves with the left hand",
    "a person waves their left arm",
    "the person is waving the left hand at somebody",
    "someone waves with their left hand",
    "waving with the left hand",
    "waving the left arm",
    "wave the left hand from side to side",
)

_WAVE_BOTH = (
    "wave with both hands",
    "wave both hands",
    "wave with both arms",
    "wave the arms",
    "wave your hands in the air",
    "waves with his hands",
    "a person waves with both hands",
    "a person waves both arms",
    "the person is waving both hands at somebody",
    "someone waves with both of their arms",
    "waving with both hands",
    "waving both arms from side to side",
)

_CONTENTS = (
    Content("walk", LEGS, True, _WALK),
    # Where the actor goes in the room is not seen from his own frame: both of these are forward walks.
    Content("walk-left", LEGS, True, _WALK),
    Content("walk-right", LEGS, True, _WALK),
    Content("walk-back", LEGS, True, (
        "walk back",
        "walk backward",
        "walk backwards",
        "walk in reverse",
        "a person walks backward",
        "a person walks backwards",
        "the person is walking backwards",
        "someone takes several steps backwards",
        "a man steps back again and again",
        "walking backwards",
        "he walks backwards in a straight line",
        "go backwards",
    )),
    Content("run", LEGS, True, (
        "run",
        "run forward",
        "run forwards",
        "jog",
        "jog forwards",
        "jogs forwards",
        "a person runs",
        "a person runs forward",
        "a person is jogging",
        "the person runs straight ahead",
        "someone runs forwards",
        "running",
        "running forwards",
        "he jogs in a straight line",
    )),
    Content("dash", LEGS, True, (
        "dash",
        "dash forwards",
        "sprint",
        "sprint forwards",
        "run very fast",
        "quickly run forwards",
        "a person sprints",
        "a person runs as fast as possible",
        "the person dashes forward",
        "someone runs at full speed",
        "sprinting",
        "dashing straight ahead",
    )),
    Content("walk-turn-left", LEGS, False, _TURN_LEFT),
    Content("walk-turn-right", LEGS, False, tuple(map(mirrored, _TURN_LEFT))),
    Content("raise-up-left-hand", frozenset({BodyPart.LEFT_ARM}), False, _RAISE_LEFT),
    Content("raise-up-right-hand", frozenset({BodyPart.RIGHT_ARM}), False, tuple(map(mirrored, _RAISE_LEFT))),
    Content("raise-up-both-hands", ARMS, False, _RAISE_BOTH),
    Content("wave-left-hand", frozenset({BodyPart.LEFT_ARM}), True, _WAVE_LEFT),
    Content("wave-right-hand", frozenset({BodyPart.RIGHT_ARM}), True, tuple(map(mirrored, _WAVE_LEFT))),
    Content("wave-both-hands", ARMS, True, _WAVE_BOTH),
    Content("bow", BOW, False, (
        "bow",
        "bow down",
        "take a bow",
        "a person bows",
        "the person bows politely",
        "someone bends forward in a bow",
        "bowing",
        "bow to greet someone",
    )),
    # One hand: the right one, or in the mirror the left one.
    Content("bye", ARMS, False, (
        "wave goodbye",
        "wave goodbye with one hand",
        "say goodbye with a wave",
        "a person waves goodbye",
        "the person waves farewell to somebody",
        "someone says bye with the hand",
        "waving goodbye",
    )),
    Content("byebye", ARMS, False, (
        "wave goodbye with both hands",
        "say bye-bye with both hands",
        "a person waves goodbye with both arms",
        "the person keeps waving goodbye with both hands",
        "someone waves farewell with both hands",
        "waving bye-bye with both hands",
    )),
    Content("guide", ARMS, False, (
        "show the way with the hand",
        "guide someone with the hand",
        "a person shows the way",
        "the person gestures to come this way",
        "someone ushers a guest in",
        "showing someone the way",
    )),
    Content("punch", EVERYTHING, False, (
        "punch",
        "throw punches",
        "a person punches",
        "the person boxes in the air",
        "someone throws a punch",
        "punching",
    )),
    Content("kick", EVERYTHING, False, (
        "kick",
        "kick in the air",
        "a person kicks",
        "the person does several kicks",
        "someone kicks and spins",
        "kicking",
    )),
    Content("slash", EVERYTHING, False, (
        "slash",
        "slash with a sword",
        "a person swings a sword",
        "the person slashes at an enemy",
        "someone cuts through the air with a blade",
        "slashing",
    )),
    Content("call", ARMS, False, (
        "call out to someone",
        "shout with the hands at the mouth",
        "a person calls somebody",
        "the person calls out loudly with both hands at the mouth",
        "calling somebody from afar",
    )),
    Content("respond", ARMS, False, (
        "respond to a call",
        "answer someone with a raised hand",
        "a person responds to somebody",
        "the person reacts to being called",
        "responding with the hand",
    )),
    Content("dance-short", EVERYTHING, True, (
        "dance",
        "do a dance",
        "a person dances",
        "the person is dancing",
        "someone dances to music",
        "dancing",
    )),
)  # fmt: skip

_OF_SEGMENTS = (
    Content(name, frozenset(map(BodyPart, row["parts"])), row["cyclic"], tuple(row["sentences"]))
    for name, row in table()["contents"].items()
)

CONTENTS: Mapping[str, Content] = MappingProxyType({each.name: each for each in (*_CONTENTS, *_OF_SEGMENTS)})
"""Every content by its name: the Bandai dataset's labels, and what else segments of recordings show."""

_MASCULINE = ("like a man", "in a masculine way", "in a manly manner", "with a masculine manner")
_OLD = ("like an old person", "like an elderly person", "in an elderly way", "as if very old", "like a grandparent")
_TIRED = ("tiredly", "wearily", "in a tired way", "as if exhausted", "with no energy at all")

STYLES: Mapping[str, tuple[str, ...]] = MappingProxyType({
    "normal": (),
    "happy": ("happily", "cheerfully", "in a happy mood", "with joy", "in a joyful way"),
    "sad": ("sadly", "in a sad mood", "gloomily", "while feeling down", "in a depressed way"),
    "angry": ("angrily", "in an angry mood", "furiously", "while being mad", "in an aggressive way"),
    "proud": ("proudly", "in a proud way", "with pride", "with the chest out", "in a haughty manner"),
    "not-confident": ("timidly", "shyly", "without confidence", "in an insecure way", "nervously"),
    "masculinity": _MASCULINE,
    "masculine": _MASCULINE,
    "feminine": ("like a woman", "in a feminine way", "in a womanly manner", "gracefully, like a lady"),
    "childish": ("like a child", "childishly", "in a childlike way", "playfully, like a kid"),
    "old": _OLD,
    "elderly": (*_OLD, "slowly", "at a slow pace"),
    "tired": _TIRED,
    "exhausted": (*_TIRED, "in an exhausted way"),
    "active": ("energetically", "actively", "with a lot of energy", "in an active way", "quickly", "fast"),
    "youthful": ("youthfully", "like a young person", "in a youthful way", "with the vigour of youth"),
    "musical": ("rhythmically", "as if to music", "to the beat", "as in a musical", "in a musical way"),
    "giant": ("like a giant", "heavily, like a giant", "as if huge and heavy", "with ponderous movements"),
    "chimpira": ("like a thug", "like a hoodlum", "with a swagger", "in the way of a street gangster"),
})  # fmt: skip
"""Phrases that can follow a sentence, by the dataset's style label; "normal" has none. "chimpira" is a Japanese
small-time gangster. The two halves of the dataset label some styles differently (masculinity, masculine; old, elderly).
Whatever they do, the active are 1.3 to 2.5 times as fast as the normal and the elderly half as fast."""


def content(name: str) -> Content:
    """The content with the dataset's label `name`. Raises `ValueError` with the labels there are for any other."""
    if name not in CONTENTS:
        raise ValueError(f"unknown content {name!r}; choose from {', '.join(CONTENTS)}")
    return CONTENTS[name]


def describe(name: str, style: str) -> tuple[tuple[str, float], ...]:
    """Every sentence for a clip of the content `name` in `style`, each with its probability (together 1).

    The plain sentences share `PLAIN_SHARE`, those followed by a phrase of the style the rest; "normal" is all plain,
    and what is `ALWAYS_STYLED` is all styled. Raises `ValueError` for an unknown content or style.
    """
    sentences = content(name).sentences
    if style not in STYLES:
        raise ValueError(f"unknown style {style!r}; choose from {', '.join(STYLES)}")
    styled = tuple(f"{sentence} {phrase}" for sentence in sentences for phrase in STYLES[style])
    if not styled:
        return tuple((sentence, 1.0 / len(sentences)) for sentence in sentences)
    if (name, style) in ALWAYS_STYLED:
        return tuple((sentence, 1.0 / len(styled)) for sentence in styled)
    return (
        *((sentence, PLAIN_SHARE / len(sentences)) for sentence in sentences),
        *((sentence, (1.0 - PLAIN_SHARE) / len(styled)) for sentence in styled),
    )


def mirrored_content(name: str) -> str:
    """The label of the content that a mirrored clip of `name` shows: the other side's, or its own where it has no side.

    Raises `ValueError` for an unknown content.
    """
    return content(mirrored(content(name).name)).name
