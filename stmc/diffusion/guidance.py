"""Classifier-free guidance (Ho and Salimans 2022)."""

from __future__ import annotations

from jaxtyping import Float
from torch import Tensor


def guide(
    text: Float[Tensor, "batch ..."], null: Float[Tensor, "batch ..."], guidance: float | int
) -> Float[Tensor, "batch ..."]:
    """Extrapolate from the unconditional prediction `null` towards the conditional prediction `text`.

    A guidance of 0 ignores the text, 1 returns the conditional prediction, and larger values exaggerate it. Predictions
    of x0, eps, v and the score may all be guided and give the same result, because each is affine in the others.

    Args:
        text: Prediction with the text, [batch, ...].
        null: Prediction without a text, of the same shape.
        guidance: Guidance scale.

    Returns:
        `null + guidance * (text - null)`.

    Examples:
        >>> stmc.guide(text=torch.tensor([1.0]), null=torch.tensor([0.0]), guidance=2.5)
        tensor([2.5000])
    """
    return null + guidance * (text - null)
