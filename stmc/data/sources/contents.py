"""Actions of clips, sentences that describe them, styles, and their mirror images.

`assets/contents.json` holds our own sentences for the labels of the Bandai Namco dataset and for segments of
recordings. Sentences that name a side are written once, for the left; those for the right are mirrored, so that a
mirrored clip always has its own sentences. Independent of recordings, motions and text encoders.
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
"""Probability that a styled clip is described without its style, so that plain texts reach every style."""
STYLED = 12
"""Number of sentences of an action, the first ones, that take phrases of a style: all of them would give 20,000."""
ALWAYS_STYLED = frozenset((f"raise-up-{side}", "feminine") for side in ("left-hand", "right-hand", "both-hands"))
"""Clips that no plain sentence describes: these raises end at the shoulder, lower than "raise the arm" would mean."""
FORWARD_WALKS = ("walk", "walk-left", "walk-right")
"""Labels with the same meaning, because the direction in the room is not visible in the actor's own frame."""


@dataclass(frozen=True)
class Content:
    """The action of a clip.

    Args:
        name: Label of the action.
        parts: Body parts that a prompt for the action would claim.
        cyclic: Whether any part of a clip still shows the action; otherwise the middle must stay in.
        sentences: Plain descriptions.
        unseen: Three descriptions that are held out from training, for tests of models, or none.
        title: Plain name for people.
        topic: Group in lists.
        gerunds: Some imperative sentences with their gerunds, for sentences about two actions (see `joined`); none for
            actions of the whole body.
    """

    name: str
    parts: frozenset[BodyPart]
    cyclic: bool
    sentences: tuple[str, ...]
    unseen: tuple[str, ...]
    title: str
    topic: str
    gerunds: tuple[tuple[str, str], ...] = ()

    def mirrored(self) -> Content:
        """Return the action of the mirror image."""
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
        for label in FORWARD_WALKS if name in FORWARD_WALKS else (name,):
            yield Content(label, parts, row["cyclic"], *texts, row["title"], row["topic"], gerunds)
        if mirrored(name) != name:
            yield Content(name, parts, row["cyclic"], *texts, row["title"], row["topic"], gerunds).mirrored()


CONTENTS: Mapping[str, Content] = MappingProxyType({content.name: content for content in _read()})
"""Actions by name: the labels of the Bandai dataset, and further actions in segments of recordings."""
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
In every action, active people are 1.3 to 2.5 times as fast as normal ones, and elderly people half as fast."""


def content(name: str) -> Content:
    """Return the action with the label `name`. Raises `ValueError` with the legal labels if it is unknown."""
    if name not in CONTENTS:
        raise ValueError(f"unknown content {name!r}; choose from {', '.join(CONTENTS)}")
    return CONTENTS[name]


def describe(name: str, style: str) -> tuple[tuple[str, float], ...]:
    """Return every sentence for a clip of the action `name` in `style`, with probabilities that sum to 1.

    Plain sentences have the total probability `PLAIN_SHARE`; the first `STYLED` sentences followed by a phrase of the
    style have the rest. "normal" clips have plain sentences only, clips in `ALWAYS_STYLED` styled ones only. Raises
    `ValueError` for an unknown action or style.
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


def mirror_content(name: str) -> str:
    """Return the label of a mirrored clip of `name`: that of the other side, or `name` itself if it has no side.

    Raises `ValueError` if the action is unknown.
    """
    return content(mirrored(content(name).name)).name
