"""Construction of a vocabulary: a selection of training sentences, and the everyday actions that they do not cover."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from functools import cache
from importlib.resources import files

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from stmc.motion.body import BodyPart
from stmc.text import TextEncoder
from stmc.text.vocabulary.sentences import LONGEST_TEXT, Content, Sentence, embed_sentences
from stmc.text.vocabulary.vocabulary import Vocabulary

COVERED = 0.7
"""Cosine from which a kept sentence of the same action covers another one. Above 0.8, recognition does not improve."""

SAME = 0.75
"""Cosine from which an everyday action counts as in the vocabulary."""

CONSIDERED, KEPT = 20_000, 2_200
"""Limits of the number of sentences to select from, and of the selected sentences (0.9 MB): 18 for each of 119 actions.
With 16 of today's sentences, 8.2 % of the held-out ones are unknown; with 18, 6.8 %."""


def build_vocabulary(weights: Mapping[Sentence, float], encoder: TextEncoder) -> Vocabulary:
    """Build the vocabulary of a training that drew sentences with these `weights`.

    For each action, sentences that earlier ones do not cover are kept, the largest weight first: at most `KEPT` of the
    first `CONSIDERED` in all. Raises `ValueError` if there is no sentence.
    """
    sentences = _rank_sentences(weights)
    if not sentences:
        raise ValueError("a vocabulary needs at least one sentence")
    others = everyday_actions()
    embeddings = embed_sentences([sentence.text for sentence in (*sentences, *others)], encoder)
    centre = embeddings[len(sentences) :].mean(dim=0)
    known, actions = F.normalize(embeddings - centre, dim=-1).split([len(sentences), len(others)])
    kept = torch.tensor(_select_uncovered(known, [sentence.content for sentence in sentences]))
    new = ((actions @ known.T).amax(dim=1) < SAME).nonzero()[:, 0]
    return Vocabulary(
        known=tuple(sentences[index] for index in kept.tolist()),
        others=tuple(others[index] for index in new.tolist()),
        embeddings=torch.cat([embeddings[kept], embeddings[len(sentences) + new]]).half(),
    )


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


def _rank_sentences(weights: Mapping[Sentence, float]) -> list[Sentence]:
    """Sort sentences by weight, each text once with its most frequent action; a fixed random order breaks ties."""
    ordered = sorted(weights, key=lambda sentence: (sentence.text, sentence.content.name))
    shuffled = torch.randperm(len(ordered), generator=torch.Generator().manual_seed(0)).tolist()
    texts: dict[str, Sentence] = {}
    for sentence in sorted((ordered[index] for index in shuffled), key=lambda sentence: -round(weights[sentence], 6)):
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
