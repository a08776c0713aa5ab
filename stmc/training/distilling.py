"""Guidance distillation (Meng et al. 2023, first stage): one pass of a network learns what two passes of its teacher,
with a text and without, predict together.

Knows networks with a denoiser's signature; knows no data set and no schedule.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from stmc.denoisers.protocol import Denoiser
from stmc.diffusion import guide
from stmc.training.loss import Batch


@dataclass(frozen=True, eq=False)
class GuidedTeacher:
    """What `denoiser` predicts with classifier-free `guidance`, for `Denoising` to learn; no gradient reaches it.

    `null` is the empty text, normalised. Rows without a text have it, so guidance moves them nowhere, and what they
    teach is the prediction without a text: they need not be told apart. The denoiser must be in evaluation mode.

    Examples:
        >>> def sums(x, t, text, text_mask=None, mask=None):
        ...     return x + text.sum()
        >>> motion = torch.zeros(1, 2, 3)
        >>> piece = stmc.training.Batch(motion, None, text=torch.ones(1, 1, 1), text_mask=None, frames=2)
        >>> teacher = stmc.training.GuidedTeacher(sums, guidance=2.5, null=torch.zeros(1, 1))
        >>> teacher(piece, motion, torch.tensor([5]))[0, 0]
        tensor([2.5000, 2.5000, 2.5000])
    """

    denoiser: Denoiser
    guidance: float | int
    null: Float[Tensor, "words width"]

    @torch.no_grad()
    def __call__(
        self, batch: Batch, noisy: Float[Tensor, "batch frames features"], t: Int[Tensor, " batch"]
    ) -> Float[Tensor, "batch frames features"]:
        """The guided prediction for the batch's noisy motion."""
        unconditional = replace(batch, text=self.null.expand(len(noisy), -1, -1), text_mask=None)
        text, null = (each.denoised(self.denoiser, noisy, t).float() for each in (batch, unconditional))
        return guide(text, null, self.guidance)
