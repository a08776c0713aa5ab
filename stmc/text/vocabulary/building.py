"""Construction of a vocabulary: a selection of training sentences, and the everyday actions that they do not cover."""

from __future__ import annotations

import json
from collections.abc import Collection, Mapping, Sequence
from functools import cache
from importlib.resources import files

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from stmc.motion.body import BodyPart
from stmc.text import TextEncoder
from stmc.text.vocabulary.classifier import fit_classifier
from stmc.text.vocabulary.qualifiers import mirrored, without_side
from stmc.text.vocabulary.sentences import LONGEST_TEXT, Content, Sentence, embed_sentences
from stmc.text.vocabulary.vocabulary import THRESHOLD, Vocabulary

COVERED = 0.7
"""Cosine from which a kept sentence of the same action covers another one. Above 0.8, recognition does not improve."""

SAME = 0.7
"""Cosine from which an everyday action counts as in the vocabulary: a "body wave" is near "wave"."""

CONSIDERED, KEPT = 40_000, 1_200
"""Limits of the number of sentences to learn from, and of those to keep: 10 for each of 119 actions, in 0.5 MB. With a
classifier, 2,200 recognise no better."""

CLASSIFIED = 0.85
"""Threshold of a vocabulary with a classifier, whose log-odds raise the scores; measured on the bundled model."""


def build_vocabulary(weights: Mapping[Sentence, float], encoder: TextEncoder, more: Collection[str] = ()) -> Vocabulary:
    """Build the vocabulary of a training.

    For each action, the first sentence in plain words is kept, then sentences that earlier ones do not cover, the
    largest weight first: at most `KEPT` of the first `CONSIDERED` in all. The classifier learns from all of the latter
    and from `more`.

    Args:
        weights: Probabilities with which the training drew sentences; of each action, that which says it best is first.
        encoder: Sentence encoder.
        more: Sentences that say more than one action in plain words, among `weights` or not.

    Raises:
        ValueError: If there is no sentence.
    """
    sentences = _rank_sentences(weights, more)
    if not sentences:
        raise ValueError("a vocabulary needs at least one sentence")
    others, texts = everyday_actions(), {sentence.text for sentence in sentences}
    further = sorted((_without_sides(sentences) | set(more)) - texts)
    embeddings = embed_sentences([*(sentence.text for sentence in (*sentences, *others)), *further], encoder)
    ends = [len(sentences), len(others), len(further)]
    centre = embeddings.split(ends)[1].mean(dim=0)
    known, actions, beyond = F.normalize(embeddings - centre, dim=-1).split(ends)
    kept = torch.tensor(_select_uncovered(known, [sentence.content for sentence in sentences]))
    new = ((actions @ torch.cat([known, beyond]).T).amax(dim=1) < SAME).nonzero()[:, 0]
    found = dict.fromkeys(sentences[index].content for index in kept.tolist())
    contents = {content: index for index, content in enumerate(found)}
    classifier = None
    if all(content.name for content in contents):
        plain = [len(contents) if each.text in more else contents[each.content] for each in sentences]
        classes = torch.tensor(plain + [len(contents)] * len(further) + [len(contents) + 1] * len(new))
        classifier = fit_classifier(torch.cat([known, beyond, actions[new]]), classes, len(contents))
    return Vocabulary(
        known=tuple(sentences[index] for index in kept.tolist()),
        others=tuple(others[index] for index in new.tolist()),
        embeddings=torch.cat([embeddings[kept], embeddings[len(sentences) + new]]).half(),
        threshold=THRESHOLD if classifier is None else CLASSIFIED,
        classifier=classifier,
    )


def _without_sides(sentences: Sequence[Sentence]) -> set[str]:
    """Return sentences about either side of an action, which say no side: "wave", if both sides are known."""
    names = {sentence.content.name for sentence in sentences}
    both = [each for each in sentences if mirrored(each.content.name) in names - {each.content.name}]
    return {without_side(each.text) for each in both} - {""}


@cache
def everyday_actions() -> tuple[Sentence, ...]:
    """Return everyday actions with their body parts, from `assets/everyday_actions.json`."""
    groups = json.loads((files("stmc") / "assets" / "everyday_actions.json").read_text("utf-8"))
    contents = [Content(parts=frozenset(map(BodyPart, group["parts"]))) for group in groups]
    return tuple(
        Sentence(action, content)
        for group, content in zip(groups, contents, strict=True)
        for action in group["actions"]
    )


def _rank_sentences(weights: Mapping[Sentence, float], more: Collection[str]) -> list[Sentence]:
    """Sort sentences by weight, each text once with its most frequent action; a fixed random order breaks ties.

    The first sentence of each action that does not say more precedes all others.
    """
    first: dict[Content, Sentence] = {}
    for sentence in weights:
        if sentence.text not in more:
            first.setdefault(sentence.content, sentence)
    firsts = set(first.values())
    ordered = sorted(weights, key=lambda sentence: (sentence.text, sentence.content.name))
    shuffled = torch.randperm(len(ordered), generator=torch.Generator().manual_seed(0)).tolist()
    texts: dict[str, Sentence] = {}
    for sentence in sorted(
        (ordered[index] for index in shuffled), key=lambda each: (each not in firsts, -round(weights[each], 6))
    ):
        if sentence.text.strip() and sentence.text.isprintable() and len(sentence.text) <= LONGEST_TEXT:
            texts.setdefault(sentence.text, sentence)
    return list(texts.values())[:CONSIDERED]


def _select_uncovered(embeddings: Float[Tensor, "sentences width"], contents: Sequence[Content]) -> list[int]:
    """Select sentences that no earlier selected one of the same action covers, and return their indices.

    At most `KEPT` sentences are selected, equally many of each action as far as available.
    """
    indices: dict[Content, list[int]] = {}
    for index, content in enumerate(contents):
        indices.setdefault(content, []).append(index)
    kept: list[tuple[int, int]] = []
    for same in indices.values():
        rows, nearest, count = embeddings[same], torch.zeros(len(same)), 0
        for row, index in enumerate(same):
            if nearest[row] < COVERED and count < KEPT:
                nearest, count = nearest.maximum(rows @ rows[row]), count + 1
                kept.append((count, index))
    return sorted(index for _, index in sorted(kept)[:KEPT])
