"""Body parts of a prompt, from the nearest sentences and from words for parts and sides."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

from jaxtyping import Float
from torch import Tensor

from stmc.motion.body import BodyPart
from stmc.text import TextEncoder
from stmc.text.vocabulary.sentences import Sentence
from stmc.text.vocabulary.vocabulary import Vocabulary, list_parts

ARMS = frozenset({BodyPart.LEFT_ARM, BodyPart.RIGHT_ARM})
EVERYTHING = frozenset(BodyPart)

NEIGHBOURS, SHARPNESS = 30, 24.0
"""Number of voting sentences; each has exp(sharpness x cosine) votes."""

MAJORITY, NAMED, UNNAMED = 0.5, 0.8, 0.5
"""Fraction of the votes that claims a part; least fraction of a part that a word names; and factor of the fractions of
other parts then."""

LIKELY = 0.7
"""Probability of an action from which its body parts are suggested; see `Sampling.restate_from`."""

SURE = 0.5
"""Confidence from which the whole body is suggested because of what is near, and not for want of it."""

UNLIKE = 0.3
"""Cosine below which even the nearest sentence is ignored."""

_ARM = r"(?:arm|hand|elbow|fist|wrist|finger|palm|thumb)s?"
_GROUPS = {
    ARMS: re.compile(rf"\b{_ARM}\b"),
    frozenset({BodyPart.LEGS}): re.compile(r"\b(?:legs?|foot|feet|knees?|toes?|ankles?|heels?)\b"),
    frozenset({BodyPart.HEAD}): re.compile(r"\b(?:head|neck|chin)\b"),
    frozenset({BodyPart.SPINE}): re.compile(r"\b(?:torso|spine|waist|trunk|upper body)\b"),
}
"""Groups of parts that are decided separately, and the words for them; words for sides select the arm."""
_SIDED_ARM = re.compile(rf"\b(left|right)\s+(?:\w+\s+)?{_ARM}\b")
_SIDE = re.compile(r"\b(left|right)\b")


@dataclass(frozen=True)
class Suggestion:
    """Suggested body parts for a prompt.

    `confidence`, from 0 to 1, is the probability of the action that has these parts, or the fraction of the nearest
    sentences' votes that claim them (either arm counts as both). It is 0 if no sentence is near; the suggestion is then
    the whole body.
    """

    parts: frozenset[BodyPart]
    confidence: float

    @property
    def needs(self) -> frozenset[BodyPart]:
        """The body parts of which the action needs at least one: the legs if it moves them, or else all its parts.

        Empty for a whole body that is suggested with less than `SURE` confidence.
        """
        if self.parts == EVERYTHING and self.confidence < SURE:
            return frozenset()
        return self.parts & {BodyPart.LEGS} or self.parts

    def __str__(self) -> str:
        return f"{list_parts(self.parts)} ({self.confidence:.0%} sure)"


def suggest(texts: Sequence[str], examples: Vocabulary, encoder: TextEncoder) -> list[Suggestion]:
    """Suggest the body parts of prompts from a vocabulary's sentences with known body parts.

    If the vocabulary's classifier gives an action a probability of at least `LIKELY`, its parts are suggested.
    Otherwise the nearest sentences vote for each part, and words for parts outvote them. "Left" and "right" select an
    arm if they stand beside a word for it, or if they stand alone and the legs do not move.

    Args:
        texts: Prompts.
        examples: Vocabulary whose sentences vote.
        encoder: Sentence encoder.
    """
    sentences = (*examples.known, *examples.others)
    indices = [index for index, sentence in enumerate(sentences) if sentence.content.parts]
    labelled = [sentences[index] for index in indices]
    embeddings = examples.embed(texts, encoder)
    rows = examples.compare(embeddings)[:, indices]
    recognitions = examples.recognise_embedded(texts, embeddings, count=1)
    return [
        Suggestion(each.nearest[0].content.parts, each.confidence)
        if each.confidence >= LIKELY
        else _suggest(each.text.lower(), labelled, row)
        for each, row in zip(recognitions, rows, strict=True)
    ]


def _suggest(text: str, sentences: Sequence[Sentence], row: Float[Tensor, " sentences"]) -> Suggestion:
    cosines, indices = row.topk(min(NEIGHBOURS, len(sentences)))
    names = {group: bool(words.search(text)) for group, words in _GROUPS.items()}
    if cosines[0] < UNLIKE and not any(names.values()):
        return Suggestion(EVERYTHING, 0.0)
    votes = (SHARPNESS * cosines).softmax(dim=0).tolist()
    claims = [sentences[index].content.parts for index in indices.tolist()]
    groups = (group for group in _GROUPS if _vote_fraction(group, votes, claims, names) >= MAJORITY)
    parts = frozenset().union(*groups) or EVERYTHING
    agreeing = sum(
        (vote for vote, claimed in zip(votes, claims, strict=True) if _with_both_arms(claimed) == parts), 0.0
    )
    return Suggestion(_select_side(text, parts), min(agreeing, 1.0))


def _vote_fraction(
    group: frozenset[BodyPart],
    votes: Sequence[float],
    claims: Sequence[frozenset[BodyPart]],
    names: dict[frozenset[BodyPart], bool],
) -> float:
    """Compute the fraction of the votes for a group, adjusted by words for parts."""
    fraction = sum((vote for vote, claimed in zip(votes, claims, strict=True) if claimed & group), 0.0)
    if names[group]:
        return max(fraction, NAMED)
    return fraction * UNNAMED if any(names.values()) else fraction


def _with_both_arms(parts: frozenset[BodyPart]) -> frozenset[BodyPart]:
    return parts | ARMS if parts & ARMS else parts


def _select_side(text: str, parts: frozenset[BodyPart]) -> frozenset[BodyPart]:
    """Remove the arm that a text's side excludes."""
    sides = set(_SIDED_ARM.findall(text))
    if not sides and BodyPart.LEGS not in parts:
        sides = set(_SIDE.findall(text))
    if len(sides) != 1 or parts == EVERYTHING:
        return parts
    return parts - {BodyPart.RIGHT_ARM if "left" in sides else BodyPart.LEFT_ARM}
