"""What a model recognises: each text compared once with what it was trained with, whoever asks again.

Knows vocabularies and sentence encoders; knows no timeline.
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

_REMEMBERED = 10_000
"""Texts after which what is known of earlier ones is forgotten: a studio is asked at every key that is pressed."""


class Recogniser:
    """Recognitions of a `vocabulary` (None: a model does not say what it was trained with), by MiniLM: the model's
    `own` encoder, if it is that."""

    def __init__(self, vocabulary: Vocabulary | None, own: Any = None) -> None:
        self.vocabulary, self._own, self._known = vocabulary, own, dict[str, Recognition]()

    @cached_property
    def _encoder(self) -> TextEncoder:
        return sentence_encoder(self._own)

    def __call__(self, texts: Sequence[str]) -> list[Recognition]:
        """One for each text, in order, the same text once; none without a vocabulary, or where MiniLM cannot be had."""
        if self.vocabulary is None:
            return []
        distinct, known = list(dict.fromkeys(texts)), self._known
        if new := [text for text in distinct if text not in known]:
            try:
                known |= zip(new, self.vocabulary.recognise(new, self._encoder), strict=True)
            except WeightsNotFound as error:
                logger.info("prompts are not compared with what the model knows: %s", error)
                return []
        if len(known) > _REMEMBERED:
            self._known = {}  # other threads go on with what they began with
        return [known[text] for text in distinct]
