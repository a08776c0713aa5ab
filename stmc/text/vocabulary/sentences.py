"""Sentences, what they are about, and their embeddings, which are MiniLM's whatever a model itself reads texts with.

One encoder for all: it was trained to tell what sentences mean, which CLIP and T5 were not, and what is measured with
it holds for every model.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from stmc.diffusion.tensors import mask
from stmc.motion.body import BodyPart
from stmc.text import Cached, MiniLM, TextEncoder

LONGEST_TEXT = 1000
"""Characters of a sentence."""


@dataclass(frozen=True)
class Content:
    """What sentences are about: an action, the body parts that a prompt would claim for it (none: not known), and
    whether it goes on for as long as it is asked for (`cyclic`) or happens once. `name` is "" where it has none."""

    name: str = ""
    parts: frozenset[BodyPart] = frozenset()
    cyclic: bool = False


@dataclass(frozen=True)
class Sentence:
    """A text and what it is about."""

    text: str
    content: Content


def sentence_encoder(own: Any = None) -> TextEncoder:
    """The encoder that sentences are compared with: a model's `own`, if that is MiniLM, so that no weights are read
    twice."""
    inner = own.encoder if isinstance(own, Cached) else own
    return own if isinstance(inner, MiniLM) and inner.source is None else MiniLM()


def embed_sentences(texts: Sequence[str], encoder: TextEncoder) -> Float[Tensor, "texts width"]:
    """The mean over each text's words, of length 1: with MiniLM's tokens the same as its sentence."""
    words, lengths = encoder.encode(list(texts))
    words, lengths = words.float().cpu(), lengths.cpu()
    words = words * mask(lengths, words.shape[1])[..., None]
    return F.normalize(words.sum(dim=1) / lengths[:, None], dim=-1)
