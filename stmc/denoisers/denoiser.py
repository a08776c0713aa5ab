"""The interface of every denoiser: noisy crops, a step and a text go in; one prediction per frame comes out.

Independent of schedules, plans and features. Whether the prediction is the clean motion, the noise or a velocity
depends on the training.
"""

from __future__ import annotations

from typing import Protocol, runtime_checkable

from jaxtyping import Bool, Float, Int
from torch import Tensor


@runtime_checkable
class Denoiser(Protocol):
    """A network that makes predictions for crops of motion; the rows of a batch do not influence each other.

    Examples:
        >>> from dataclasses import replace
        >>> def still(x, t, text, text_mask=None, mask=None):
        ...     return torch.zeros_like(x)
        >>> replace(stmc.load(), denoiser=still).generate("stand # 0 # 1", steps=1)
        [Motion(20 frames at 20 fps, 1.00 s)]
    """

    def __call__(
        self,
        x: Float[Tensor, "batch frames features"],
        t: Int[Tensor, " batch"],
        text: Float[Tensor, "batch words width"],
        text_mask: Bool[Tensor, "batch words"] | None = None,
        mask: Bool[Tensor, "batch frames"] | None = None,
    ) -> Float[Tensor, "batch frames features"]:
        """Predict for noisy motion at given steps.

        Frames outside `mask` do not influence other frames, and their predictions are arbitrary.

        Args:
            x: Noisy crops, [batch, frames, features].
            t: Diffusion step of each crop, [batch]; 0 is the least noisy.
            text: Text embeddings, [batch, words, width].
            text_mask: True at words, False in the padding, [batch, words]; None means no padding.
            mask: True at frames, False in the padding, [batch, frames]; None means no padding.

        Returns:
            The prediction, [batch, frames, features].
        """
        ...
