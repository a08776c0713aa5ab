"""Classifier-free guidance (Ho and Salimans 2022)."""

from __future__ import annotations

from jaxtyping import Float
from torch import Tensor


def guide(
    text: Float[Tensor, "batch ..."], null: Float[Tensor, "batch ..."], guidance: float | int
) -> Float[Tensor, "batch ..."]:
    """The prediction without a text (`null`), moved `guidance` times the way to the prediction with it (`text`).

    0 ignores the text, 1 is the prediction with it, more exaggerates it. Predictions of x0, eps, v and the score can
    all be guided, and agree, since each is affine in the others.

    Examples:
        >>> stmc.guide(text=torch.tensor([1.0]), null=torch.tensor([0.0]), guidance=2.5)
        tensor([2.5000])
    """
    return null + guidance * (text - null)
