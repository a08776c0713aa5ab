"""Which sentences of a training are kept to know it by, and the everyday actions that they do not cover."""

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
"""Cosine from which a sentence tells nothing that a kept one of its content does not; fewer are recognised above 0.8 no
better."""

SAME = 0.75
"""Cosine from which an everyday action is one that the model knows."""

CONSIDERED, KEPT = 20_000, 2_000
"""Sentences at most: of which some are kept, and that are kept (0.8 MB)."""


def build_vocabulary(weights: Mapping[Sentence, float], encoder: TextEncoder) -> Vocabulary:
    """The vocabulary of a training that drew sentences with these `weights`.

    Of the sentences of each content those are kept that tell something new, the weightiest first, and `KEPT` in all at
    most; those behind the first `CONSIDERED` are not looked at. Raises `ValueError` where there is no sentence.
    """
    sentences = _considered(weights)
    if not sentences:
        raise ValueError("there is no sentence to know a model by")
    others = everyday_actions()
    embeddings = embed_sentences([sentence.text for sentence in (*sentences, *others)], encoder)
    centre = embeddings[len(sentences) :].mean(dim=0)
    known, actions = F.normalize(embeddings - centre, dim=-1).split([len(sentences), len(others)])
    kept = torch.tensor(_uncovered(known, [sentence.content for sentence in sentences]))
    new = ((actions @ known.T).amax(dim=1) < SAME).nonzero()[:, 0]
    return Vocabulary(
        known=tuple(sentences[index] for index in kept.tolist()),
        others=tuple(others[index] for index in new.tolist()),
        embeddings=torch.cat([embeddings[kept], embeddings[len(sentences) + new]]).half(),
    )


@cache
def everyday_actions() -> tuple[Sentence, ...]:
    """What people do all day, in our own words, with body parts: `assets/everyday_actions.json`."""
    groups = json.loads((files("stmc") / "assets" / "everyday_actions.json").read_text("utf-8"))
    contents = [Content(parts=frozenset(map(BodyPart, group["parts"]))) for group in groups]
    return tuple(
        Sentence(action, content)
        for group, content in zip(groups, contents, strict=True)
        for action in group["actions"]
    )


def _considered(weights: Mapping[Sentence, float]) -> list[Sentence]:
    """The weightiest sentences, each text once (of several contents: the one that says it most often); those of equal
    weights in an order by chance, always the same."""
    ordered = sorted(weights, key=lambda each: (each.text, each.content.name))
    chance = torch.randperm(len(ordered), generator=torch.Generator().manual_seed(0)).tolist()
    texts: dict[str, Sentence] = {}
    for sentence in sorted((ordered[place] for place in chance), key=lambda each: -round(weights[each], 6)):
        if sentence.text.strip() and sentence.text.isprintable() and len(sentence.text) <= LONGEST_TEXT:
            texts.setdefault(sentence.text, sentence)
    return list(texts.values())[:CONSIDERED]


def _uncovered(embeddings: Float[Tensor, "sentences width"], contents: Sequence[Content]) -> list[int]:
    """The places of those sentences that no earlier kept one of the same content is near to, at most `KEPT`: of every
    content as many as of any other, as far as it has them."""
    places: dict[Content, list[int]] = {}
    for place, content in enumerate(contents):
        places.setdefault(content, []).append(place)
    kept: list[tuple[int, int]] = []
    for same in places.values():
        rows, nearest, count = embeddings[same], torch.zeros(len(same)), 0
        for row, place in enumerate(same):
            if nearest[row] < COVERED and count < KEPT:
                nearest, count = nearest.maximum(rows @ rows[row]), count + 1
                kept.append((count, place))
    return sorted(place for _, place in sorted(kept)[:KEPT])
