"""The sentences that a model was trained with, and whether a prompt is among what they say."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from stmc.io.untrusted import shown
from stmc.motion.body import BodyPart
from stmc.text import TextEncoder
from stmc.text.vocabulary.agreement import Agreement
from stmc.text.vocabulary.calibration import RARELY, Calibration
from stmc.text.vocabulary.sentences import Content, Sentence, embed_sentences

THRESHOLD = 0.6
"""Measured on prompts inside and outside of what a model of 74 contents knows: see docs/models.md."""

NEAR = 0.45
"""Cosine from which a known sentence is worth naming: of "tango" and "salsa footwork" it is 0.48, of "swim" and "a sip"
0.43."""

CONTRARY = 0.1
"""Cosine by which a sentence with other words for side, direction or speed counts less than an everyday action: what it
tells of may be known in other words. Measured with the left or right form of each action left out."""

NEAREST = 3
"""Known sentences that a message names."""

EXAMPLES = 5
"""Sentences that tell what a content is."""

_APART = -1.0
"""Cosine of what is not to be compared."""


@dataclass(frozen=True)
class Recognition:
    """How near a prompt is to what a model knows. `nearest` are known sentences, those first that agree with the
    prompt's words for side, direction and speed: the first example of each of the nearest contents, or where contents
    have no names the nearest themselves; `near` are those of them whose content is at least `NEAR`; `score` is what is
    compared with `threshold`. `rate` is the share of samples that show such a prompt, from 0 to 1; None: not measured.
    """

    text: str
    nearest: tuple[Sentence, ...]
    score: float
    threshold: float | int
    near: tuple[Sentence, ...]
    rate: float | int | None = None

    @property
    def known(self) -> bool:
        """Whether the prompt is near enough."""
        return self.score >= self.threshold

    @property
    def action(self) -> str:
        """The name of the content that is nearest; "" where contents have none."""
        return self.nearest[0].content.name

    @property
    def works(self) -> bool:
        """Whether the prompt is known, and its samples do not show it rarely."""
        return self.known and (self.rate is None or self.rate >= RARELY)

    @property
    def happens_once(self) -> bool:
        """Whether the prompt is known, and what it tells of does not go on for as long as it is asked for."""
        content = self.nearest[0].content
        return self.known and bool(content.name) and not content.cyclic

    @property
    def advice(self) -> str:
        """Describe in a line why the prompt may fail; "" where it works."""
        if self.works:
            return ""
        if self.known:
            return f"{shown(self.text)} rarely works: {100 * self.rate:.0f} % of samples show it"
        texts = ", ".join(shown(sentence.text) for sentence in self.near)
        near = f"the nearest it knows: {texts}" if texts else "it knows nothing near"
        return f"the model hardly knows {shown(self.text)} and may do something else; {near}"


@dataclass(frozen=True, eq=False, repr=False)
class Vocabulary:
    """What a model has heard: `known` sentences of its training, each with its content; and beside them sentences about
    `others`, everyday actions that are not among those. `embeddings` are of the known sentences and then of the others,
    rows of length 1, in half precision.

    A prompt is known where 2 k - o is at least `threshold`: k is its cosine to the nearest known sentence, o that to
    the nearest other one, both as seen from the mean of the others, since what all sentences share tells nothing. So
    "ride a bicycle" is not known although "ride a motorcycle" is: it is an everyday action itself. Known sentences that
    contradict the prompt's side, direction or speed count among the others, `CONTRARY` less: "jog backwards" is not
    known where all jogs are forwards. `calibration` is what was measured of the model; its thresholds replace
    `threshold`.

    Examples:
        >>> vocabulary = stmc.load().vocabulary
        >>> sorted(content.name for content in vocabulary.contents if content.parts == {"head", "spine"})
        ['bow', 'dodge']
    """

    known: tuple[Sentence, ...]
    others: tuple[Sentence, ...]
    embeddings: Float[Tensor, "sentences width"]
    threshold: float | int = THRESHOLD
    calibration: Calibration = field(default_factory=Calibration)

    def __post_init__(self) -> None:
        if not self.known or not self.others:
            raise ValueError("a vocabulary needs known sentences and others")
        if len(self.embeddings) != len(self.known) + len(self.others):
            count = len(self.known) + len(self.others)
            raise ValueError(f"{len(self.embeddings)} embeddings for {count} sentences")

    @cached_property
    def contents(self) -> tuple[Content, ...]:
        """Each content that has a name, in the order of its first sentence."""
        return tuple(dict.fromkeys(sentence.content for sentence in self.known if sentence.content.name))

    @cached_property
    def examples(self) -> Mapping[Content, tuple[Sentence, ...]]:
        """Of each content that has a name up to `EXAMPLES` sentences, those nearest to the mean of all that say it, the
        shortest first: the shortest of all may be slang.

        Examples:
            >>> examples = stmc.load().vocabulary.examples
            >>> next(sentences[0].text for content, sentences in examples.items() if content.name == "sit-down")
            'sitting down'
        """
        places: dict[Content, list[int]] = {content: [] for content in self.contents}
        for place, sentence in enumerate(self.known):
            if sentence.content.name:
                places[sentence.content].append(place)
        return {content: self._examples(same) for content, same in places.items()}

    def recognise(self, texts: Sequence[str], encoder: TextEncoder, count: int = NEAREST) -> list[Recognition]:
        """How near each text is to what is known, with the nearest sentences of up to `count` contents.

        Examples:
            >>> vocabulary, encoder = stmc.load().vocabulary, stmc.text.vocabulary.sentence_encoder()
            >>> [prompt] = vocabulary.recognise(["do a cartwheel"], encoder, count=1)
            >>> prompt.known, prompt.nearest[0].content.name
            (True, 'cartwheel')
        """
        rows = self.cosines(texts, encoder) if texts else []
        return [self._recognition(text, row, count) for text, row in zip(texts, rows, strict=True)]

    def cosines(self, texts: Sequence[str], encoder: TextEncoder) -> Float[Tensor, "texts sentences"]:
        """Of one text or more to all known sentences and then to all others, as seen from the others' mean.

        Examples:
            >>> vocabulary, encoder = stmc.load().vocabulary, stmc.text.vocabulary.sentence_encoder()
            >>> len(vocabulary.cosines(["walk", "jump"], encoder))
            2
        """
        return self._centred(embed_sentences(texts, encoder)) @ self._rows.T

    def _recognition(self, text: str, row: Float[Tensor, " sentences"], count: int) -> Recognition:
        known, others = row[: len(self.known)], row[len(self.known) :]
        agrees, contradicts = self._agreement.of(text)
        agreeing = known.masked_fill(~agrees, _APART)
        unlike = torch.cat([others, (known - CONTRARY).masked_fill(~contradicts, _APART)])
        nearest = self._nearest(agreeing, count) | self._nearest(known, count)
        near = [sentence for sentence, cosine in nearest.items() if cosine >= NEAR]
        action = next(iter(nearest)).content.name
        return Recognition(
            text,
            tuple(nearest)[:count],
            float(2 * agreeing.max() - unlike.max()),
            self.calibration.threshold_of(action, self.threshold),
            tuple(near[:count]),
            self.calibration.rate(text, action),
        )

    def _nearest(self, cosines: Float[Tensor, " known"], count: int) -> dict[Sentence, float]:
        """The first examples of up to `count` contents, each with the cosine of its nearest sentence."""
        nearest: dict[Sentence, float] = {}
        for place in cosines.argsort(descending=True).tolist():
            if len(nearest) == count or cosines[place] == _APART:
                break
            sentence = self.known[place]
            nearest.setdefault(self.examples.get(sentence.content, (sentence,))[0], float(cosines[place]))
        return nearest

    @cached_property
    def _agreement(self) -> Agreement:
        return Agreement(self.known)

    def _examples(self, places: Sequence[int]) -> tuple[Sentence, ...]:
        rows = self._rows[list(places)]
        order = (rows @ rows.mean(dim=0)).argsort(descending=True, stable=True)[:EXAMPLES].tolist()
        return tuple(sorted((self.known[places[row]] for row in order), key=lambda each: len(each.text)))

    @cached_property
    def _centre(self) -> Float[Tensor, " width"]:
        return self.embeddings[len(self.known) :].float().mean(dim=0)

    @cached_property
    def _rows(self) -> Float[Tensor, "sentences width"]:
        return self._centred(self.embeddings.float())

    def _centred(self, embeddings: Float[Tensor, "rows width"]) -> Float[Tensor, "rows width"]:
        return F.normalize(embeddings - self._centre, dim=-1)

    def __repr__(self) -> str:
        """The contents by their body parts."""
        if not self.contents:
            some = ", ".join(shown(sentence.text) for sentence in self.known[:NEAREST])
            return f"Vocabulary({len(self.known):,} sentences, such as {some})"
        by_parts: dict[frozenset[BodyPart], list[str]] = {}
        for content in self.contents:
            by_parts.setdefault(content.parts, []).append(f"{content.name}{' ↻' if content.cyclic else ''}")
        lines = [f"{listed(parts)}: {', '.join(names)}" for parts, names in by_parts.items()]
        wrapped = [textwrap.fill(line, 116, initial_indent="  ", subsequent_indent="    ") for line in lines]
        head = f"Vocabulary({len(self.contents)} contents, {len(self.known):,} sentences; ↻: for as long as asked"
        return "\n".join([head, *wrapped, ")"])


def listed(parts: frozenset[BodyPart]) -> str:
    """Body parts as a person reads them."""
    if parts == frozenset(BodyPart):
        return "whole body"
    return " and ".join(part for part in BodyPart if part in parts) or "parts not known"
