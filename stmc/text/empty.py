"""The empty text as zeros, for networks whose training represented a missing text by zeros."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from jaxtyping import Float, Int
from torch import Tensor

from stmc.diffusion.tensors import pad
from stmc.text.text_encoder import TextEncoder, check


class EmptyAsZeros:
    """Wrap an encoder so that the empty text becomes one word of zeros, as MDM represents a missing text."""

    def __init__(self, encoder: TextEncoder) -> None:
        self.encoder = encoder

    @property
    def name(self) -> str:
        """The name of the wrapped encoder, marked as different for the empty text."""
        return f"{self.encoder.name}, empty as zeros"

    @property
    def width(self) -> int:
        """The width of the wrapped encoder."""
        return self.encoder.width

    def encode(self, texts: Sequence[str]) -> tuple[Float[Tensor, "batch words width"], Int[Tensor, " batch"]]:
        """Encode texts on the device of the wrapped encoder; see `TextEncoder`."""
        check(texts)
        nonempty = [text for text in dict.fromkeys(texts) if text]
        if not nonempty:
            return torch.zeros(len(texts), 1, self.width), torch.ones(len(texts), dtype=torch.int64)
        words, lengths = self.encoder.encode(nonempty)
        rows = {text: row[:length] for text, row, length in zip(nonempty, words, lengths.tolist(), strict=True)}
        return pad([rows[text] if text else words.new_zeros(1, self.width) for text in texts])
