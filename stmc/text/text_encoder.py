"""The interface of every text encoder. Independent of models."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Protocol, runtime_checkable

from jaxtyping import Float, Int
from torch import Tensor


@runtime_checkable
class TextEncoder(Protocol):
    """A function from texts to words of `width` numbers.

    The words of a text do not depend on the other texts, up to float error. Encoders with different outputs have
    different values of `name`.
    """

    @property
    def name(self) -> str: ...

    @property
    def width(self) -> int: ...

    def encode(self, texts: Sequence[str]) -> tuple[Float[Tensor, "batch words width"], Int[Tensor, " batch"]]:
        """Encode texts: return float32 words, zero after the last word of each text, and the number of words of each.

        Every text, even "", has at least one word. Raises `ValueError` if there is no text.
        """
        ...


Encode = Callable[[Sequence[str]], tuple[Tensor, Tensor]]
"""A function like `TextEncoder.encode`: texts → their words and the number of words of each text."""


def check(texts: Sequence[str]) -> None:
    """Raise the `ValueError` of `TextEncoder.encode`."""
    if isinstance(texts, str):
        raise ValueError(f"expected several texts, got the single text {texts!r}; put it in a list")
    if not texts:
        raise ValueError("no texts to encode")
