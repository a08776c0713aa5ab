"""Training objectives: their protocol, and that of denoisers (STMC, Eq. 5).

Diffusion steps are drawn uniformly, or noisy steps more often, which helps contents with few clips. This module knows
schedules and networks with a denoiser's signature; it knows no data set and no optimiser.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from stmc.denoisers.denoiser import Denoiser
from stmc.diffusion.schedule import Prediction, Schedule

AuxiliaryLoss = Callable[[Float[Tensor, "batch frames features"]], Float[Tensor, "batch _ derived"]]
"""Clean normalised features → derived features that are also trained, each of a frame and the next."""
Teacher = Callable[["Batch", Float[Tensor, "batch frames features"], Int[Tensor, " batch"]], Tensor]
"""A batch, its noisy motion and the steps → the prediction to learn: see `GuidedTeacher` and `MultistepTeacher`."""


@dataclass(frozen=True, eq=False)
class Batch:
    """Clean motion and its texts, both normalised.

    Args:
        motion: Clean motion.
        mask: True for frames that exist; None if nothing is padded.
        text: Text embeddings.
        text_mask: True for words that exist; None if nothing is padded.
        frames: Number of existing frames, known without waiting for an accelerator.
        segment: Index of the word that applies to each frame, for denoisers with `per_frame_text`, whose rows have
            several texts of one word each; arbitrary in the padding.
        sentence: Index of each text among the data set's sentences, for a teacher; 0 is the empty text.
    """

    motion: Float[Tensor, "batch frames features"]
    mask: Bool[Tensor, "batch frames"] | None
    text: Float[Tensor, "batch words width"]
    text_mask: Bool[Tensor, "batch words"] | None
    frames: int
    segment: Int[Tensor, "batch frames"] | None = field(default=None, kw_only=True)
    sentence: Int[Tensor, "batch texts"] | None = field(default=None, kw_only=True)

    def denoise(
        self, denoiser: Denoiser, noisy: Float[Tensor, "batch frames features"], t: Int[Tensor, " batch"]
    ) -> Float[Tensor, "batch frames features"]:
        """Call the denoiser with the batch's noisy motion, at steps `t`, with its texts, masks and segments."""
        segment = () if self.segment is None else (self.segment,)
        return denoiser(noisy, t, self.text, self.text_mask, self.mask, *segment)


@runtime_checkable
class Objective(Protocol):
    """Protocol of objectives: loss terms, summed over the frames of a batch."""

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the logged losses; the first is "loss"."""
        ...

    def __call__(self, network: nn.Module, piece: Batch, generator: torch.Generator) -> Float[Tensor, " terms"]:
        """Compute the terms of a batch, summed over frames; `generator` is on the batch's device."""
        ...

    def weigh(self, terms: Float[Tensor, " terms"]) -> Float[Tensor, ""]:
        """Combine the terms into the number to minimise."""
        ...

    def losses(self, means: Float[Tensor, " terms"]) -> dict[str, float]:
        """Return the logged losses by `names`, from the means of the terms over frames."""
        ...


@dataclass(frozen=True, eq=False)
class Denoising:
    """Mean squared error of the prediction, per feature (STMC, Eq. 5).

    Raises `ValueError` for weights of unknown fields, values out of range, and an auxiliary loss with a prediction
    other than x0.

    Args:
        schedule: Noise schedule.
        prediction: Quantity that the network predicts.
        fields: Names of columns, for the logs and for `weights`; columns of `auxiliary_loss` follow the features.
        weights: Weights of fields in the gradient, 1 by default; they do not affect the logs.
        auxiliary_loss: Function that derives further features to train; None: none.
        timestep_alpha: Relative steps follow Beta(alpha, 1). 1 is uniform, as in the papers; with 2, half of the draws
            are from the noisiest 30 %, at which it is decided which motion emerges from the noise.
        steps: Number of the schedule's spaced steps to train, those that few-step sampling visits; None: all.
        energy_floor: Weigh rows by 1 / (energy + floor), also in the logs, see `energy_weights`. Otherwise a cartwheel,
            with a hundred times the energy of an arm circle, dominates the loss. None: equal weights, as in the papers.
        teacher: Teacher whose prediction is the target; None: the true value is.
    """

    schedule: Schedule
    prediction: Prediction = "x0"
    fields: Mapping[str, slice] = field(default_factory=dict)
    weights: Mapping[str, float | int] = field(default_factory=dict)
    auxiliary_loss: AuxiliaryLoss | None = None
    timestep_alpha: float | int = 1.0
    steps: int | None = None
    energy_floor: float | int | None = None
    teacher: Teacher | None = None

    def __post_init__(self) -> None:
        if self.energy_floor is not None and self.energy_floor <= 0:
            raise ValueError(f"energy_floor {self.energy_floor} must be above 0, or None")
        self.schedule.spaced(self.steps)  # checks their number
        if self.timestep_alpha <= 0:
            raise ValueError(
                f"timestep_alpha {self.timestep_alpha} must be above 0; 1 is uniform, 2 favours noisy steps"
            )
        if self.auxiliary_loss is not None and self.prediction != "x0":
            raise ValueError(f"an auxiliary loss needs the prediction x0, not {self.prediction}")
        if unknown := set(self.weights) - set(self.fields):
            raise ValueError(f"weights of unknown fields {sorted(unknown)}; choose from {', '.join(self.fields)}")

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the logged losses: the mean over all columns, then the mean of each field."""
        return ("loss", *(f"loss_{name}" for name in self.fields))

    def __call__(self, network: Denoiser, piece: Batch, generator: torch.Generator) -> Float[Tensor, " terms"]:
        """Compute squared errors per column, with steps and noise drawn from `generator`."""
        times = torch.tensor(self.schedule.spaced(self.steps), device=piece.motion.device)
        index, noise = draw_noise(piece, len(times), generator, self.timestep_alpha)
        weight = None if self.energy_floor is None else energy_weights(piece, self.energy_floor)
        settings = self.prediction, self.auxiliary_loss, weight, self.teacher
        return squared_errors(network, self.schedule, piece, times[index], noise, *settings)

    def weigh(self, terms: Float[Tensor, " terms"]) -> Float[Tensor, ""]:
        """Return the weighted mean over columns."""
        weight = torch.ones_like(terms)
        for name, of_field in self.weights.items():
            weight[self.fields[name]] = of_field
        return (terms * (weight / weight.mean())).mean()

    def losses(self, means: Float[Tensor, " terms"]) -> dict[str, float]:
        """Return the unweighted means of all columns and of each field."""
        return {"loss": means.mean().item()} | {
            f"loss_{name}": means[columns].mean().item() for name, columns in self.fields.items()
        }


def squared_errors(
    denoiser: Denoiser,
    schedule: Schedule,
    batch: Batch,
    t: Int[Tensor, " batch"],
    noise: Float[Tensor, "batch frames features"],
    prediction: Prediction = "x0",
    auxiliary_loss: AuxiliaryLoss | None = None,
    weight: Float[Tensor, " batch"] | None = None,
    teacher: Teacher | None = None,
) -> Float[Tensor, " _"]:
    """Compute the squared error of the prediction from x_t, per feature, summed over real frames (STMC, Eq. 5).

    Args:
        denoiser: Network to evaluate.
        schedule: Noise schedule.
        batch: Clean motion and texts.
        t: Diffusion step of each row.
        noise: Noise of each row.
        prediction: Quantity that the network predicts.
        auxiliary_loss: Function that derives further features from x0, whose errors follow those of the features.
        weight: Weight of each row; None: 1.
        teacher: Teacher whose prediction is the target; None: the true value is.
    """
    noisy = schedule.q_sample(batch.motion, t, noise)
    target = teacher(batch, noisy, t) if teacher else schedule.from_x0(batch.motion, noisy, t, prediction)
    output = batch.denoise(denoiser, noisy, t)
    sums = [_sum_errors(output.float(), target, batch.mask, weight)]
    if auxiliary_loss is not None:
        both = None if batch.mask is None else batch.mask[:, 1:] & batch.mask[:, :-1]
        with torch.autocast(output.device.type, enabled=False):
            sums.append(_sum_errors(auxiliary_loss(output.float()), auxiliary_loss(target), both, weight))
    return torch.cat(sums)


def energy_weights(batch: Batch, floor: float | int) -> Float[Tensor, " batch"]:
    """Return a weight per row, 1 / (energy + `floor`), scaled to a mean of one over real frames.

    The energy is the variance of the normalised features over real frames, averaged over features. `floor`, in the
    same unit, bounds the weight of motionless rows.
    """
    motion, mask = batch.motion.float(), batch.mask
    real = torch.ones_like(motion[..., 0]) if mask is None else mask.float()
    frames = real.sum(dim=1)
    mean = (motion * real[..., None]).sum(dim=1) / frames[:, None]
    away = (motion - mean[:, None]).square() * real[..., None]
    weight = 1 / (away.mean(dim=2).sum(dim=1) / frames + floor)
    return weight * (frames.sum() / (weight * frames).sum())


def _sum_errors(output: Tensor, target: Tensor, mask: Tensor | None, weight: Tensor | None = None) -> Tensor:
    errors = (output - target).square()
    if weight is not None:
        errors = errors * weight[:, None, None]
    if mask is not None:
        errors = torch.where(mask[..., None], errors, 0.0)
    return errors.sum(dim=(0, 1))


def draw_noise(
    batch: Batch, steps: int, generator: torch.Generator, alpha: float | int = 1.0
) -> tuple[Int[Tensor, " batch"], Float[Tensor, "batch frames features"]]:
    """Draw a diffusion step and standard normal noise for each row.

    Args:
        batch: Batch to draw for.
        steps: Number of diffusion steps; the drawn step divided by `steps` follows Beta(`alpha`, 1).
        generator: Random generator on the batch's device.
        alpha: Parameter of the distribution; 1 is uniform.
    """
    motion = batch.motion
    if alpha == 1:
        t = torch.randint(steps, (len(motion),), generator=generator, device=motion.device)
    else:
        share = torch.rand(len(motion), generator=generator, device=motion.device) ** (1 / alpha)
        t = (share * steps).long().clamp(max=steps - 1)
    return t, torch.randn(motion.shape, generator=generator, device=motion.device, dtype=motion.dtype)
