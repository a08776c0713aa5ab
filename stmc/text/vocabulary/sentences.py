"""Sentences, their actions, and their embeddings, which are MiniLM's whatever text encoder a model has.

MiniLM was trained for the meaning of sentences, unlike CLIP and T5, and one encoder makes measurements comparable
between models.
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
"""Greatest number of characters of a sentence."""


@dataclass(frozen=True)
class Content:
    """The action of sentences: its name ("": none) and the body parts that a prompt would claim (empty: unknown).

    A `cyclic` action continues for the duration of its prompt; any other action happens once.
    """

    name: str = ""
    parts: frozenset[BodyPart] = frozenset()
    cyclic: bool = False


@dataclass(frozen=True)
class Sentence:
    """A text and its action."""

    text: str
    content: Content


def sentence_encoder(encoder: Any = None) -> TextEncoder:
    """Return MiniLM for comparing sentences: the model's `encoder` if it is MiniLM, so that weights are read once."""
    inner = encoder.encoder if isinstance(encoder, Cached) else encoder
    return encoder if isinstance(inner, MiniLM) and inner.source is None else MiniLM()


def embed_sentences(texts: Sequence[str], encoder: TextEncoder) -> Float[Tensor, "texts width"]:
    """Embed texts as the mean over their words, normalised to length 1; for MiniLM, this is its sentence embedding."""
    words, lengths = encoder.encode(list(texts))
    words, lengths = words.float().cpu(), lengths.cpu()
    words = words * mask(lengths, words.shape[1])[..., None]
    return F.normalize(words.sum(dim=1) / lengths[:, None], dim=-1)
