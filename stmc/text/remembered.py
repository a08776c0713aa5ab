"""Embeddings in memory: a program that embeds the same few texts again and again encodes each once.

`cached` keeps embeddings on disk, across programs.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from jaxtyping import Float, Int
from torch import Tensor

from stmc.diffusion.tensors import pad


class Remembered:
    """Wrap an encoder, or a function like `TextEncoder.encode`, so that the latest texts are not encoded again.

    Args:
        encoder: The encoder or the function.
        most: Number of texts to remember.
    """

    def __init__(self, encoder: Any, most: int = 256) -> None:
        self._encode: Callable[[Sequence[str]], tuple[Tensor, Tensor]] = getattr(encoder, "encode", encoder)
        self._most, self._words = most, dict[str, Tensor]()

    def __call__(self, texts: Sequence[str]) -> tuple[Float[Tensor, "batch words width"], Int[Tensor, " batch"]]:
        """Encode texts; see `TextEncoder`."""
        distinct = dict.fromkeys(texts)
        known = {text: self._words.pop(text) for text in distinct if text in self._words}
        if missing := [text for text in distinct if text not in known]:
            rows, lengths = self._encode(missing)
            known |= {text: row[:length] for text, row, length in zip(missing, rows, lengths.tolist(), strict=True)}
        self._words |= {text: known[text] for text in distinct}  # the latest last
        for text in list(self._words)[: -self._most]:
            del self._words[text]
        return pad([known[text] for text in texts])
