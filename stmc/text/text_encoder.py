"""What every text encoder is. Knows no model."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol, runtime_checkable

from jaxtyping import Float, Int
from torch import Tensor


@runtime_checkable
class TextEncoder(Protocol):
    """Anything that turns texts into words of `width` numbers; a text's words do not depend on the others' beyond float
    error. `name` tells encoders apart whose outputs differ."""

    @property
    def name(self) -> str: ...

    @property
    def width(self) -> int: ...

    def encode(self, texts: Sequence[str]) -> tuple[Float[Tensor, "batch words width"], Int[Tensor, " batch"]]:
        """The words of each text, zeros after its last, and how many each has (at least one, also for ""); float32.

        Raises `ValueError` for no text at all.
        """
        ...


def check(texts: Sequence[str]) -> None:
    """Raises the `ValueError` of `TextEncoder.encode`."""
    if isinstance(texts, str):
        raise ValueError(f"expected several texts, got the single text {texts!r}; put it in a list")
    if not texts:
        raise ValueError("no texts to encode")
