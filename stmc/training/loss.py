"""What a network learns from: the protocol of objectives, and the denoiser's (STMC, Eq. 5), to restore what noise has
hidden, at a step drawn uniformly or, for denoisers that are to move where few clips say how, more often a noisy one.

Knows schedules and any network with a denoiser's signature; knows no data set and no optimiser.
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
"""Clean normalised features → more numbers that should be right too, each of a frame and the next."""

Teacher = Callable[["Batch", Float[Tensor, "batch frames features"], Int[Tensor, " batch"]], Tensor]
"""A batch, its noisy motion and the steps → the prediction that is to be learned: see `GuidedTeacher`."""


@dataclass(frozen=True, eq=False)
class Batch:
    """Clean motion and its texts, both normalised. `mask` is True where a frame exists; None where nothing is padded.

    `frames`: how many frames exist, known without waiting for an accelerator. With `segment`, rows have several texts
    of one word each, and it says of every frame which of the row's words it belongs to, in the padding any: for
    denoisers with `per_frame_text`. `sentence`: which of a data set's sentences each text is, for a teacher that reads
    them in its own way; 0 is none.
    """

    motion: Float[Tensor, "batch frames features"]
    mask: Bool[Tensor, "batch frames"] | None
    text: Float[Tensor, "batch words width"]
    text_mask: Bool[Tensor, "batch words"] | None
    frames: int
    segment: Int[Tensor, "batch frames"] | None = field(default=None, kw_only=True)
    sentence: Int[Tensor, "batch texts"] | None = field(default=None, kw_only=True)

    def denoised(
        self, denoiser: Denoiser, noisy: Float[Tensor, "batch frames features"], t: Int[Tensor, " batch"]
    ) -> Float[Tensor, "batch frames features"]:
        """What the denoiser predicts for the batch's noisy motion, told all that the batch knows."""
        told = () if self.segment is None else (self.segment,)
        return denoiser(noisy, t, self.text, self.text_mask, self.mask, *told)


@runtime_checkable
class Objective(Protocol):
    """What a network learns: numbers that should become small. A piece of a batch gives their sums over its frames."""

    @property
    def names(self) -> tuple[str, ...]:
        """Of the losses in the logs; the first is "loss"."""
        ...

    def __call__(self, network: nn.Module, piece: Batch, generator: torch.Generator) -> Float[Tensor, " terms"]:
        """The terms of one piece, summed over frames; `generator` is on the piece's device."""
        ...

    def weigh(self, terms: Float[Tensor, " terms"]) -> Float[Tensor, ""]:
        """The one number whose gradient is followed."""
        ...

    def losses(self, means: Float[Tensor, " terms"]) -> dict[str, float]:
        """What the logs say under `names`, from the terms' means over frames."""
        ...


@dataclass(frozen=True, eq=False)
class Denoising:
    """Eq. 5: the mean squared error of the prediction, per feature.

    `fields` names columns of the features, and after them of what `auxiliary_loss` makes of these, for the logs and for
    `weights`, which make fields count more or less than the 1 of the plain mean: in the gradient, not in the logs.
    `timestep_alpha`: the share of the noise's steps that a draw lies at follows Beta(alpha, 1); 1 is uniform, as in the
    papers, and of 2 half of the draws are from the noisiest 30 %, where it is decided which motion becomes of a noise.
    `energy_floor`: rows count by 1 / (energy + floor), see `energy_weights`; so do they in the logs. Else a cartwheel,
    of a hundred times an arm circle's energy, is learned a hundred times as eagerly. None: all alike, as in the papers.
    `teacher`: whose prediction is to be learned instead of the one that is right; None: nobody's.
    Raises `ValueError` for weights of unknown fields, numbers out of range, and where something is to be derived from
    anything but x0.
    """

    schedule: Schedule
    prediction: Prediction = "x0"
    fields: Mapping[str, slice] = field(default_factory=dict)
    weights: Mapping[str, float | int] = field(default_factory=dict)
    auxiliary_loss: AuxiliaryLoss | None = None
    timestep_alpha: float | int = 1.0
    energy_floor: float | int | None = None
    teacher: Teacher | None = None

    def __post_init__(self) -> None:
        if self.energy_floor is not None and self.energy_floor <= 0:
            raise ValueError(f"energy_floor {self.energy_floor} must be above 0, or None")
        if self.timestep_alpha <= 0:
            raise ValueError(f"timestep_alpha {self.timestep_alpha} must be above 0: 1 is uniform, 2 noisier")
        if self.auxiliary_loss is not None and self.prediction != "x0":
            raise ValueError(f"further features are derived from a prediction of x0, not of {self.prediction}")
        if unknown := set(self.weights) - set(self.fields):
            raise ValueError(f"weights of unknown fields {sorted(unknown)}; choose from {', '.join(self.fields)}")

    @property
    def names(self) -> tuple[str, ...]:
        """The plain mean over all columns, then that of each field."""
        return ("loss", *(f"loss_{name}" for name in self.fields))

    def __call__(self, network: Denoiser, piece: Batch, generator: torch.Generator) -> Float[Tensor, " terms"]:
        """Squared errors per column, at steps and with noise that `generator` draws."""
        t, noise = draw_noise(piece, self.schedule.steps, generator, self.timestep_alpha)
        weight = None if self.energy_floor is None else energy_weights(piece, self.energy_floor)
        return squared_errors(
            network, self.schedule, piece, t, noise, self.prediction, self.auxiliary_loss, weight, self.teacher
        )

    def weigh(self, terms: Float[Tensor, " terms"]) -> Float[Tensor, ""]:
        """The weighted mean over columns."""
        weight = torch.ones_like(terms)
        for name, of_field in self.weights.items():
            weight[self.fields[name]] = of_field
        return (terms * (weight / weight.mean())).mean()

    def losses(self, means: Float[Tensor, " terms"]) -> dict[str, float]:
        """The plain means of all columns and of each field."""
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
    """Squared error of the prediction from x_t, per feature, summed over real frames: Eq. 5 before its mean.

    `weight`: how much each row counts; None: as one. The errors of what `auxiliary_loss` makes of the features follow
    those of the features; it needs a prediction of x0. With a `teacher` they are errors of its prediction.
    """
    noisy = schedule.q_sample(batch.motion, t, noise)
    target = teacher(batch, noisy, t) if teacher else schedule.from_x0(batch.motion, noisy, t, prediction)
    output = batch.denoised(denoiser, noisy, t)
    sums = [_summed(output.float(), target, batch.mask, weight)]
    if auxiliary_loss is not None:
        both = None if batch.mask is None else batch.mask[:, 1:] & batch.mask[:, :-1]
        with torch.autocast(output.device.type, enabled=False):
            sums.append(_summed(auxiliary_loss(output.float()), auxiliary_loss(target), both, weight))
    return torch.cat(sums)


def energy_weights(batch: Batch, floor: float | int) -> Float[Tensor, " batch"]:
    """How much each row counts where all motions are to be learned alike: 1 / (energy + `floor`), scaled so that a real
    frame counts as one on average. The energy is the variance over real frames of the normalised features, the mean
    over features; `floor`, in the same unit, bounds what stillness counts."""
    motion, mask = batch.motion.float(), batch.mask
    real = torch.ones_like(motion[..., 0]) if mask is None else mask.float()
    frames = real.sum(dim=1)
    mean = (motion * real[..., None]).sum(dim=1) / frames[:, None]
    away = (motion - mean[:, None]).square() * real[..., None]
    weight = 1 / (away.mean(dim=2).sum(dim=1) / frames + floor)
    return weight * (frames.sum() / (weight * frames).sum())


def _summed(output: Tensor, target: Tensor, mask: Tensor | None, weight: Tensor | None = None) -> Tensor:
    errors = (output - target).square()
    if weight is not None:
        errors = errors * weight[:, None, None]
    if mask is not None:
        errors = torch.where(mask[..., None], errors, 0.0)
    return errors.sum(dim=(0, 1))


def draw_noise(
    batch: Batch, steps: int, generator: torch.Generator, alpha: float | int = 1.0
) -> tuple[Int[Tensor, " batch"], Float[Tensor, "batch frames features"]]:
    """A step of noising for each sample, whose share of `steps` follows Beta(`alpha`, 1), and standard normal noise;
    `generator` is on the batch's device."""
    motion = batch.motion
    if alpha == 1:
        t = torch.randint(steps, (len(motion),), generator=generator, device=motion.device)
    else:
        share = torch.rand(len(motion), generator=generator, device=motion.device) ** (1 / alpha)
        t = (share * steps).long().clamp(max=steps - 1)
    return t, torch.randn(motion.shape, generator=generator, device=motion.device, dtype=motion.dtype)
