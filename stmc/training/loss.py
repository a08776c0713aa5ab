"""The training objective (STMC, Eq. 5): restore what noise has hidden, at a step drawn uniformly.

Knows schedules and any network with a denoiser's signature; knows no data set and no optimiser.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from stmc.denoisers.protocol import Denoiser
from stmc.diffusion.schedule import Prediction, Schedule

Derive = Callable[[Float[Tensor, "batch frames features"]], Float[Tensor, "batch _ derived"]]
"""Clean normalised features → more numbers that should be right too, each of a frame and the next."""


@dataclass(frozen=True, eq=False)
class Batch:
    """Clean motion and its texts, both normalised. `mask` is True where a frame exists; None where nothing is padded.

    `frames`: how many frames exist, known without waiting for an accelerator.
    """

    motion: Float[Tensor, "batch frames features"]
    mask: Bool[Tensor, "batch frames"] | None
    text: Float[Tensor, "batch words width"]
    text_mask: Bool[Tensor, "batch words"] | None
    frames: int


def squared_errors(
    denoiser: Denoiser,
    schedule: Schedule,
    batch: Batch,
    t: Int[Tensor, " batch"],
    noise: Float[Tensor, "batch frames features"],
    prediction: Prediction = "x0",
    derive: Derive | None = None,
) -> Float[Tensor, " _"]:
    """Squared error of the prediction from x_t, per feature, summed over real frames: Eq. 5 before its mean.

    The errors of what `derive` makes of the features follow those of the features; it needs a prediction of x0.
    """
    noisy = schedule.q_sample(batch.motion, t, noise)
    target = schedule.from_x0(batch.motion, noisy, t, prediction)
    output = denoiser(noisy, t, batch.text, batch.text_mask, batch.mask)
    sums = [_summed(output.float(), target, batch.mask)]
    if derive is not None:
        both = None if batch.mask is None else batch.mask[:, 1:] & batch.mask[:, :-1]
        with torch.autocast(output.device.type, enabled=False):
            sums.append(_summed(derive(output.float()), derive(target), both))
    return torch.cat(sums)


def _summed(output: Tensor, target: Tensor, mask: Tensor | None) -> Tensor:
    errors = (output - target).square()
    if mask is not None:
        errors = torch.where(mask[..., None], errors, 0.0)
    return errors.sum(dim=(0, 1))


def draw_noise(
    batch: Batch, steps: int, generator: torch.Generator
) -> tuple[Int[Tensor, " batch"], Float[Tensor, "batch frames features"]]:
    """A uniform step of noising for each sample, and standard normal noise; `generator` is on the batch's device."""
    motion = batch.motion
    t = torch.randint(steps, (len(motion),), generator=generator, device=motion.device)
    return t, torch.randn(motion.shape, generator=generator, device=motion.device, dtype=motion.dtype)
