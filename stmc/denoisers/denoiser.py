"""What every denoiser is: noisy crops, a step and a text in; a prediction for each frame out.

Knows nothing of schedules, plans or features: whether the prediction is the clean motion, the noise or a velocity is
the affair of whoever trained it.
"""

from __future__ import annotations

from typing import Protocol, runtime_checkable

from jaxtyping import Bool, Float, Int
from torch import Tensor


@runtime_checkable
class Denoiser(Protocol):
    """A network that predicts for crops of motion; rows of the batch never see each other.

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
        """The prediction for noisy `x` at the steps `t` (0 is the least noisy).

        The masks are True where there is something; None says that nothing is padded. Frames outside `mask` influence
        no other frame, and what comes out there is arbitrary.
        """
        ...
