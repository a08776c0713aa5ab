"""Batches of motions with a text for each of several segments, for denoisers that know a text for every frame.

Knows no data set and no network.
"""

from __future__ import annotations

from dataclasses import dataclass

from jaxtyping import Float, Int
from torch import Tensor

from stmc.denoisers.protocol import Denoiser
from stmc.training.loss import Batch


@dataclass(frozen=True, eq=False)
class Sequences(Batch):
    """A batch whose `text` has a word for each segment of a row. `segment` says of every frame to which it belongs, in
    the padding to any; None: each row is one segment."""

    segment: Int[Tensor, "batch frames"] | None = None

    def denoised(
        self, denoiser: Denoiser, noisy: Float[Tensor, "batch frames features"], t: Int[Tensor, " batch"]
    ) -> Float[Tensor, "batch frames features"]:
        """See `Batch.denoised`."""
        return denoiser(noisy, t, self.text, self.text_mask, self.mask, self.segment)
