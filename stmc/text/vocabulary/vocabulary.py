"""The training sentences of a model, and the test of whether a prompt is in their vocabulary."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from stmc.io.untrusted import quote
from stmc.motion.body import BodyPart
from stmc.text import TextEncoder
from stmc.text.vocabulary.agreement import Agreement
from stmc.text.vocabulary.calibration import RARELY, Calibration
from stmc.text.vocabulary.classifier import Classifier, log_odds
from stmc.text.vocabulary.qualifiers import may_name_several
from stmc.text.vocabulary.sentences import Content, Sentence, embed_sentences

THRESHOLD = 0.6
"""Score from which a prompt is in the vocabulary, measured on prompts inside and outside that of a model of 74 actions;
see docs/models.md."""

NEAR = 0.45
"""Cosine from which a message names a training sentence: "tango" and "salsa footwork" have 0.48, "swim" and "a sip"
0.43."""

CONTRARY = 0.1
"""Cosine by which a contradicting sentence counts less than an everyday action, since its action may be in the
vocabulary in other words. Measured with the left or right form of each action left out."""

ODDS = 0.2
"""Weight of the classifier's log-odds beside cosines. With 0.1, more of the known prompts warn."""

NEAREST = 3
"""Number of training sentences in a message."""

EXAMPLES = 5
"""Number of example sentences of an action."""

_EXCLUDED = -1.0
"""Cosine of sentences that are excluded from a comparison."""


@dataclass(frozen=True)
class Recognition:
    """The result of comparing a prompt with a model's vocabulary.

    `nearest` holds the first example of each of the nearest actions, or the nearest sentences themselves if actions
    have no names; those that agree with the prompt's side, direction and speed come first. `near` holds those with a
    cosine of at least `NEAR`. The prompt is in the vocabulary if `score` is at least `threshold`, or if the prompt
    itself was `tested`. `rate` is the fraction of samples that show such a prompt, from 0 to 1; None: not measured.
    With the probability `confidence`, the prompt asks for its action in plain words, as `words` do: the action's first
    training sentence. `words` is empty without a classifier, if the prompt may be about several actions, if these words
    rarely work, or if the prompt was tested with many samples and works as it is.
    """

    text: str
    nearest: tuple[Sentence, ...]
    score: float
    threshold: float | int
    near: tuple[Sentence, ...]
    rate: float | int | None = None
    tested: bool = False
    confidence: float = 0.0
    words: str = ""

    @property
    def known(self) -> bool:
        """Whether the prompt is in the vocabulary."""
        return self.tested or self.score >= self.threshold

    @property
    def action(self) -> str:
        """The name of the nearest action; "" if actions have no names."""
        return self.nearest[0].content.name

    @property
    def works(self) -> bool:
        """Whether the prompt is in the vocabulary, and does not rarely work."""
        return self.known and (self.rate is None or self.rate >= RARELY)

    def read_from(self, confidence: float | int | None) -> str:
        """Return the text that a model reads.

        It is `words` if the prompt is known and its action has a probability of at least `confidence`. Otherwise, and
        with a `confidence` of 1 or None, it is the prompt itself.
        """
        if confidence is None or confidence >= 1 or not self.known:
            return self.text
        return self.words if self.words and self.confidence >= confidence else self.text

    @property
    def happens_once(self) -> bool:
        """Whether the prompt is in the vocabulary, and describes a one-shot action rather than a cyclic one."""
        content = self.nearest[0].content
        return self.known and bool(content.name) and not content.cyclic

    @property
    def advice(self) -> str:
        """A line that explains why the prompt may fail; "" if it works."""
        if self.works:
            return ""
        if self.known and self.rate is not None:
            return f"{quote(self.text)} rarely works: {100 * self.rate:.0f} % of samples show it"
        texts = ", ".join(quote(sentence.text) for sentence in self.near)
        near = f"the nearest it knows: {texts}" if texts else "it knows nothing near"
        return f"the model hardly knows {quote(self.text)} and may do something else; {near}"


@dataclass(frozen=True, eq=False, repr=False)
class Vocabulary:
    """The vocabulary of a model: `known` training sentences, each with its action, and `others`.

    `others` are sentences of everyday actions that are absent from training. `embeddings` holds one row of length 1 in
    half precision for each known sentence, then for each other one.

    A prompt is in the vocabulary if 2 k - o + `ODDS` l is at least `threshold`: k is its cosine to the nearest known
    sentence, o to the nearest other one, after subtraction of the others' mean, which all sentences share, and l the
    log-odds by the `classifier` that it asks for an action whose sentences agree with it. The classifier also tells
    which, if the prompt asks for it in plain words; otherwise, and without a classifier, where l is 0, the nearest
    sentence tells. For example, "ride a
    bicycle" is out of vocabulary although "ride a motorcycle" is in it, since it is an everyday action itself. Known
    sentences that contradict the prompt's side, direction or speed count among the others, with `CONTRARY` subtracted:
    "jog backwards" is out of vocabulary if all jogs go forwards. `calibration` holds measurements of the model; its
    thresholds replace `threshold`.

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
    classifier: Classifier | None = None

    def __post_init__(self) -> None:
        if not self.known or not self.others:
            raise ValueError("a vocabulary needs known sentences and others")
        if len(self.embeddings) != len(self.known) + len(self.others):
            count = len(self.known) + len(self.others)
            raise ValueError(f"{len(self.embeddings)} embeddings for {count} sentences")
        if self.classifier is not None and len(self.classifier.weights) != len(self.contents) + 2:
            classes = len(self.classifier.weights)
            raise ValueError(f"a classifier of {classes} classes for {len(self.contents)} actions, more and none")

    @cached_property
    def contents(self) -> tuple[Content, ...]:
        """All named actions, in the order of their first sentences."""
        return tuple(dict.fromkeys(sentence.content for sentence in self.known if sentence.content.name))

    @cached_property
    def examples(self) -> Mapping[Content, tuple[Sentence, ...]]:
        """Up to `EXAMPLES` sentences of each named action: those nearest to the mean of all its sentences.

        The shortest of them comes first; the shortest of all sentences may be slang.

        Examples:
            >>> examples = stmc.load().vocabulary.examples
            >>> next(sentences[0].text for content, sentences in examples.items() if content.name == "sit-down")
            'sitting down'
        """
        return {content: self._select_examples(same) for content, same in self._of_contents.items()}

    def recognise(self, texts: Sequence[str], encoder: TextEncoder, count: int = NEAREST) -> list[Recognition]:
        """Compare texts with the vocabulary.

        Args:
            texts: Prompts.
            encoder: Sentence encoder.
            count: Greatest number of nearest actions in each result.

        Examples:
            >>> vocabulary, encoder = stmc.load().vocabulary, stmc.text.vocabulary.sentence_encoder()
            >>> [prompt] = vocabulary.recognise(["do a cartwheel"], encoder, count=1)
            >>> prompt.known, prompt.nearest[0].content.name
            (True, 'cartwheel')
        """
        return self.recognise_embedded(texts, self.embed(texts, encoder), count) if texts else []

    def recognise_embedded(
        self, texts: Sequence[str], embeddings: Float[Tensor, "texts width"], count: int = NEAREST
    ) -> list[Recognition]:
        """Compare texts with the vocabulary as `recognise` does, given what `embed` returned for them.

        Examples:
            >>> vocabulary, encoder = stmc.load().vocabulary, stmc.text.vocabulary.sentence_encoder()
            >>> embeddings = vocabulary.embed(["do a cartwheel"], encoder)
            >>> vocabulary.recognise_embedded(["do a cartwheel"], embeddings)[0].action
            'cartwheel'
        """
        logits = self.classifier.logits(embeddings) if self.classifier else [None] * len(texts)
        rows = zip(texts, self.compare(embeddings), logits, strict=True)
        return [self._recognise(*row, count) for row in rows]

    def cosines(self, texts: Sequence[str], encoder: TextEncoder) -> Float[Tensor, "texts sentences"]:
        """Compute cosines of texts to all known sentences, then to all others, after subtraction of the others' mean.

        Examples:
            >>> vocabulary, encoder = stmc.load().vocabulary, stmc.text.vocabulary.sentence_encoder()
            >>> len(vocabulary.cosines(["walk", "jump"], encoder))
            2
        """
        return self.compare(self.embed(texts, encoder))

    def embed(self, texts: Sequence[str], encoder: TextEncoder) -> Float[Tensor, "texts width"]:
        """Embed texts as rows of length 1, after subtraction of the others' mean.

        Examples:
            >>> vocabulary, encoder = stmc.load().vocabulary, stmc.text.vocabulary.sentence_encoder()
            >>> vocabulary.embed(["walk", "jump"], encoder).shape
            torch.Size([2, 384])
        """
        return self._centre_rows(embed_sentences(texts, encoder))

    def compare(self, embeddings: Float[Tensor, "texts width"]) -> Float[Tensor, "texts sentences"]:
        """Compute the cosines of `cosines` from what `embed` returned.

        Examples:
            >>> vocabulary, encoder = stmc.load().vocabulary, stmc.text.vocabulary.sentence_encoder()
            >>> len(vocabulary.compare(vocabulary.embed(["walk", "jump"], encoder)))
            2
        """
        return embeddings @ self._rows.T

    def _recognise(
        self, text: str, row: Float[Tensor, " sentences"], logits: Float[Tensor, " classes"] | None, count: int
    ) -> Recognition:
        known, others = row[: len(self.known)], row[len(self.known) :]
        agrees, contradicts = self._agreement.of(text)
        agreeing = known.masked_fill(~agrees, _EXCLUDED)
        unlike = torch.cat([others, (known - CONTRARY).masked_fill(~contradicts, _EXCLUDED)])
        nearest = self._nearest(agreeing, count) | self._nearest(known, count)
        odds, confidence, words = 0.0, 0.0, ""
        if logits is not None:
            allowed = torch.stack([agrees[indices].any() for indices in self._of_contents.values()])
            odds, best = log_odds(logits, allowed), int(logits[:-2].masked_fill(~allowed, -torch.inf).argmax())
            if allowed[best] and logits[best] > logits[-2]:  # otherwise it says more: the nearest sentence decides
                confidence, indices = float(logits.softmax(dim=0)[best]), self._of_contents[self.contents[best]]
                nearest = {self.examples[self.contents[best]][0]: float(known[indices].max())} | nearest
                words = self._words(text, self.known[indices[0]].text)
        near = [sentence for sentence, cosine in nearest.items() if cosine >= NEAR]
        action = next(iter(nearest)).content.name
        return Recognition(
            text,
            tuple(nearest)[:count],
            float(2 * agreeing.max() - unlike.max()) + ODDS * odds,
            self.calibration.threshold_of(action, self.threshold),
            tuple(near[:count]),
            self.calibration.rate(text, action),
            self.calibration.trial(text) is not None,
            confidence,
            words,
        )

    def _nearest(self, cosines: Float[Tensor, " known"], count: int) -> dict[Sentence, float]:
        """Return the first example of each of the `count` nearest actions, with the cosine of its nearest sentence."""
        nearest: dict[Sentence, float] = {}
        for index in cosines.argsort(descending=True).tolist():
            if len(nearest) == count or cosines[index] == _EXCLUDED:
                break
            sentence = self.known[index]
            nearest.setdefault(self.examples.get(sentence.content, (sentence,))[0], float(cosines[index]))
        return nearest

    def _words(self, text: str, first: str) -> str:
        """Return the first sentence of a text's action.

        It is "" if the text may be about several actions, if the sentence was measured to work rarely, or if the text
        was measured to work.
        """
        if may_name_several(text):
            return ""
        trial, own = self.calibration.trial(first), self.calibration.trial(text)
        rarely = trial is not None and (trial.rate or 0.0) < RARELY
        return "" if rarely or (own is not None and own.proven) else first

    @cached_property
    def _of_contents(self) -> Mapping[Content, list[int]]:
        """The indices of the known sentences of each action."""
        indices: dict[Content, list[int]] = {content: [] for content in self.contents}
        for index, sentence in enumerate(self.known):
            if sentence.content.name:
                indices[sentence.content].append(index)
        return indices

    @cached_property
    def _agreement(self) -> Agreement:
        return Agreement(self.known)

    def _select_examples(self, indices: Sequence[int]) -> tuple[Sentence, ...]:
        rows = self._rows[list(indices)]
        order = (rows @ rows.mean(dim=0)).argsort(descending=True, stable=True)[:EXAMPLES].tolist()
        return tuple(sorted((self.known[indices[row]] for row in order), key=lambda sentence: len(sentence.text)))

    @cached_property
    def _centre(self) -> Float[Tensor, " width"]:
        return self.embeddings[len(self.known) :].float().mean(dim=0)

    @cached_property
    def _rows(self) -> Float[Tensor, "sentences width"]:
        return self._centre_rows(self.embeddings.float())

    def _centre_rows(self, embeddings: Float[Tensor, "rows width"]) -> Float[Tensor, "rows width"]:
        return F.normalize(embeddings - self._centre, dim=-1)

    def __repr__(self) -> str:
        """List the actions by body parts."""
        if not self.contents:
            some = ", ".join(quote(sentence.text) for sentence in self.known[:NEAREST])
            return f"Vocabulary({len(self.known):,} sentences, such as {some})"
        by_parts: dict[frozenset[BodyPart], list[str]] = {}
        for content in self.contents:
            by_parts.setdefault(content.parts, []).append(f"{content.name}{' ↻' if content.cyclic else ''}")
        lines = [f"{list_parts(parts)}: {', '.join(names)}" for parts, names in by_parts.items()]
        wrapped = [textwrap.fill(line, 116, initial_indent="  ", subsequent_indent="    ") for line in lines]
        head = f"Vocabulary({len(self.contents)} contents, {len(self.known):,} sentences; ↻: for as long as asked"
        return "\n".join([head, *wrapped, ")"])


def list_parts(parts: frozenset[BodyPart]) -> str:
    """Describe body parts in words."""
    if parts == frozenset(BodyPart):
        return "whole body"
    return " and ".join(part for part in BodyPart if part in parts) or "parts not known"
