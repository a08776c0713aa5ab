"""What clips show and what people would write about it: contents, styles and their mirror images.

Our own sentences, in `assets/contents.json`, for the Bandai Namco dataset's labels and for the segments of recordings;
knows the labels, their styles and English; knows no recordings, no motion and no text encoder.
Sentences that name a side are written once, for the left; those of the right are their mirror images, so that a
mirrored clip always has a sentence of its own.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from importlib.resources import files
from types import MappingProxyType

from stmc.motion.body import BodyPart
from stmc.text.vocabulary.qualifiers import mirrored

PLAIN_SHARE = 0.5
"""Share of the draws in which a styled clip is described without its style, so that plain texts reach every style."""

STYLED = 12
"""Sentences of a content, its first, that phrases of a style may follow: all of them would be twenty thousand."""

ALWAYS_STYLED = frozenset((f"raise-up-{side}", "feminine") for side in ("left-hand", "right-hand", "both-hands"))
"""Clips that no plain sentence describes: these raises end at the shoulder, lower than "raise the arm" would mean."""

FORWARD_WALKS = ("walk", "walk-left", "walk-right")
"""Where the actor goes in the room is not seen from his own frame: all of these say the same."""


@dataclass(frozen=True)
class Content:
    """What a clip shows. `parts` are those a prompt would claim for it; `cyclic` means that any trim of the clip still
    shows the content, whereas of the others the middle has to stay in; `sentences`
    are plain descriptions; `unseen` are three that no training sees, to ask models with, or none. `title` is the plain
    name to show to people, `topic` the group that it is listed in. `gerunds` pairs some sentences, imperatives, with
    their gerunds, for sentences about two contents (see `joined`); contents that claim the whole body have none."""

    name: str
    parts: frozenset[BodyPart]
    cyclic: bool
    sentences: tuple[str, ...]
    unseen: tuple[str, ...]
    title: str
    topic: str
    gerunds: tuple[tuple[str, str], ...] = ()

    def mirrored(self) -> Content:
        """The content of the mirror image."""
        return Content(
            mirrored(self.name),
            frozenset(BodyPart(mirrored(part)) for part in self.parts),
            self.cyclic,
            tuple(map(mirrored, self.sentences)),
            tuple(map(mirrored, self.unseen)),
            mirrored(self.title),
            self.topic,
            tuple((mirrored(imperative), mirrored(gerund)) for imperative, gerund in self.gerunds),
        )


def _read() -> Iterator[Content]:
    table = json.loads((files("stmc") / "assets" / "contents.json").read_text("utf-8"))
    for name, row in table.items():
        parts, gerunds = frozenset(map(BodyPart, row["parts"])), tuple(row.get("gerunds", {}).items())
        texts = tuple(row["sentences"]), tuple(row["unseen"])
        for each in FORWARD_WALKS if name in FORWARD_WALKS else (name,):
            yield Content(each, parts, row["cyclic"], *texts, row["title"], row["topic"], gerunds)
        if mirrored(name) != name:
            yield Content(name, parts, row["cyclic"], *texts, row["title"], row["topic"], gerunds).mirrored()


CONTENTS: Mapping[str, Content] = MappingProxyType({content.name: content for content in _read()})
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

    The plain sentences share `PLAIN_SHARE`, the first `STYLED` followed by a phrase of the style the rest; "normal" is
    all plain, and what is `ALWAYS_STYLED` is all styled. Raises `ValueError` for an unknown content or style.
    """
    sentences = content(name).sentences
    if style not in STYLES:
        raise ValueError(f"unknown style {style!r}; choose from {', '.join(STYLES)}")
    styled = tuple(f"{sentence} {phrase}" for sentence in sentences[:STYLED] for phrase in STYLES[style])
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
