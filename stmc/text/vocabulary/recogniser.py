"""Recognition of prompts with a cache: each text is compared with the training sentences once.

Depends on vocabularies and sentence encoders; independent of timelines.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from functools import cached_property
from typing import Any

from stmc.text import TextEncoder, WeightsNotFound
from stmc.text.vocabulary.sentences import sentence_encoder
from stmc.text.vocabulary.vocabulary import Recognition, Vocabulary

logger = logging.getLogger(__name__)

_CACHE_SIZE = 10_000
"""Texts after which the cache is emptied; the studio sends a text at every key press."""


class Recogniser:
    """A cached recogniser of the prompts in a `vocabulary`; None: the model has no vocabulary.

    Texts are embedded with MiniLM, or with the model's `encoder` if it is MiniLM.
    """

    def __init__(self, vocabulary: Vocabulary | None, encoder: Any = None) -> None:
        self.vocabulary, self._model_encoder, self._cache = vocabulary, encoder, dict[str, Recognition]()

    @cached_property
    def _encoder(self) -> TextEncoder:
        return sentence_encoder(self._model_encoder)

    def __call__(self, texts: Sequence[str]) -> list[Recognition]:
        """Recognise each distinct text, in order. Empty without a vocabulary, or if MiniLM is not available."""
        if self.vocabulary is None:
            return []
        distinct, cache = list(dict.fromkeys(texts)), self._cache
        if new := [text for text in distinct if text not in cache]:
            try:
                cache |= zip(new, self.vocabulary.recognise(new, self._encoder), strict=True)
            except WeightsNotFound as error:
                logger.info("prompts are not compared with the model's vocabulary: %s", error)
                return []
        if len(cache) > _CACHE_SIZE:
            self._cache = {}  # other threads keep the old one
        return [cache[text] for text in distinct]
