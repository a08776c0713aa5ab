"""Which body parts a prompt is about: by the sentences nearest to it, and by the words that name parts and sides."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

from jaxtyping import Float
from torch import Tensor

from stmc.motion.body import BodyPart
from stmc.text import TextEncoder
from stmc.text.vocabulary.sentences import Sentence
from stmc.text.vocabulary.vocabulary import Vocabulary, listed

ARMS = frozenset({BodyPart.LEFT_ARM, BodyPart.RIGHT_ARM})
EVERYTHING = frozenset(BodyPart)

NEIGHBOURS, SHARPNESS = 15, 18.0
"""Sentences that vote; each has exp(sharpness x cosine) votes."""

MAJORITY, NAMED, UNNAMED = 0.5, 0.8, 0.5
"""The share of the votes that claims a part; the share at least where a word names it; and by what shares are
multiplied where words name other parts."""

UNLIKE = 0.3
"""Cosine below which even the nearest sentence says nothing."""

_ARM = r"(?:arm|hand|elbow|fist|wrist|finger|palm|thumb)s?"
_GROUPS = {
    ARMS: re.compile(rf"\b{_ARM}\b"),
    frozenset({BodyPart.LEGS}): re.compile(r"\b(?:legs?|foot|feet|knees?|toes?|ankles?|heels?)\b"),
    frozenset({BodyPart.HEAD}): re.compile(r"\b(?:head|neck|chin)\b"),
    frozenset({BodyPart.SPINE}): re.compile(r"\b(?:torso|spine|waist|trunk|upper body)\b"),
}
"""What is decided alone, and the words that name it; which of the arms it is, sides say."""
_SIDED_ARM = re.compile(rf"\b(left|right)\s+(?:\w+\s+)?{_ARM}\b")
_SIDE = re.compile(r"\b(left|right)\b")


@dataclass(frozen=True)
class Suggestion:
    """Body parts for a prompt. `confidence`: the share, from 0 to 1, of the nearest sentences' votes that claim the
    same (either arm counting as both); 0 where nothing known is like it, and the whole body is suggested."""

    parts: frozenset[BodyPart]
    confidence: float

    def __str__(self) -> str:
        return f"{listed(self.parts)} ({self.confidence:.0%} sure)"


def suggest(texts: Sequence[str], examples: Vocabulary, encoder: TextEncoder) -> list[Suggestion]:
    """The body parts that prompts would claim, going by all of a vocabulary's sentences whose body parts are known.

    The nearest sentences vote for each part; words that name parts outvote them; "left" and "right" say which arm: the
    one that they stand beside, or where they stand alone and no leg moves, any.
    """
    sentences = (*examples.known, *examples.others)
    places = [place for place, sentence in enumerate(sentences) if sentence.content.parts]
    labelled = [sentences[place] for place in places]
    rows = examples.cosines(texts, encoder)[:, places]
    return [_suggestion(text.lower(), labelled, row) for text, row in zip(texts, rows, strict=True)]


def _suggestion(text: str, sentences: Sequence[Sentence], row: Float[Tensor, " sentences"]) -> Suggestion:
    cosines, places = row.topk(min(NEIGHBOURS, len(sentences)))
    names = {group: bool(words.search(text)) for group, words in _GROUPS.items()}
    if cosines[0] < UNLIKE and not any(names.values()):
        return Suggestion(EVERYTHING, 0.0)
    votes = (SHARPNESS * cosines).softmax(dim=0).tolist()
    claims = [sentences[place].content.parts for place in places.tolist()]
    found = frozenset().union(*(group for group in _GROUPS if _share(group, votes, claims, names) >= MAJORITY))
    parts = found or EVERYTHING
    agreeing = sum(
        (vote for vote, claimed in zip(votes, claims, strict=True) if _with_both_arms(claimed) == parts), 0.0
    )
    return Suggestion(_of_side(text, parts), min(agreeing, 1.0))


def _share(
    group: frozenset[BodyPart],
    votes: Sequence[float],
    claims: Sequence[frozenset[BodyPart]],
    names: dict[frozenset[BodyPart], bool],
) -> float:
    """Of the votes for a group, as words have changed it."""
    share = sum((vote for vote, claimed in zip(votes, claims, strict=True) if claimed & group), 0.0)
    if names[group]:
        return max(share, NAMED)
    return share * UNNAMED if any(names.values()) else share


def _with_both_arms(parts: frozenset[BodyPart]) -> frozenset[BodyPart]:
    return parts | ARMS if parts & ARMS else parts


def _of_side(text: str, parts: frozenset[BodyPart]) -> frozenset[BodyPart]:
    """The parts without the arm that a text's side excludes."""
    sides = set(_SIDED_ARM.findall(text))
    if not sides and BodyPart.LEGS not in parts:
        sides = set(_SIDE.findall(text))
    if len(sides) != 1 or parts == EVERYTHING:
        return parts
    return parts - {BodyPart.RIGHT_ARM if "left" in sides else BodyPart.LEFT_ARM}
