"""No text as zeros: for networks that learned without a text by a zero where its features would be."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from jaxtyping import Float, Int
from torch import Tensor

from stmc.diffusion.tensors import pad
from stmc.text.text_encoder import TextEncoder, check


class EmptyAsZeros:
    """Another encoder, but the empty text is one word of zeros: what MDM is given where there is no text."""

    def __init__(self, encoder: TextEncoder) -> None:
        self.encoder = encoder

    @property
    def name(self) -> str:
        """The encoder's, and that it is another for the empty text."""
        return f"{self.encoder.name}, empty as zeros"

    @property
    def width(self) -> int:
        """The encoder's."""
        return self.encoder.width

    def encode(self, texts: Sequence[str]) -> tuple[Float[Tensor, "batch words width"], Int[Tensor, " batch"]]:
        """See `TextEncoder`; where the encoder gives its words."""
        check(texts)
        told = [text for text in dict.fromkeys(texts) if text]
        if not told:
            return torch.zeros(len(texts), 1, self.width), torch.ones(len(texts), dtype=torch.int64)
        words, lengths = self.encoder.encode(told)
        rows = {text: row[:length] for text, row, length in zip(told, words, lengths.tolist(), strict=True)}
        return pad([rows[text] if text else words.new_zeros(1, self.width) for text in texts])
