"""The forward process, its posterior (STMC, Eq. 1 to 4) and the quantities that a network may predict.

`alpha_bar`, the cumulative product of 1 - beta, determines everything else. Coefficients stay float64 until they are
combined with a tensor, and then take its dtype. Independent of networks and motion.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal, get_args

import torch
from jaxtyping import Float, Float64, Int
from torch import Tensor

Prediction = Literal["x0", "eps", "v", "score"]
"""The quantity that a network predicts: the clean sample, the noise, sqrt(alpha_bar) eps - sqrt(1 - alpha_bar) x0, or
the score."""

Spacing = Literal["linspace", "trailing"]
"""Steps that a sampler of few steps visits, by diffusers' names (Lin et al. 2024, Table 2): see `Schedule.spaced`."""

Steps = int | Int[Tensor, " batch"]
"""One step for the whole batch, or one per sample; step 0 is the least noisy."""


MOST_STEPS = 10_000
"""Maximum number of steps of a schedule; published schedules have 50 to 1000."""


@dataclass(frozen=True, eq=False, repr=False)
class Schedule:
    """A noise schedule: `alpha_bar[t]` is the fraction of the clean sample's variance that remains at step t.

    `spacing` names the steps that a sampler of few steps visits; see `spaced`.

    Examples:
        >>> stmc.Schedule(torch.tensor([0.9, 0.5, 0.1], dtype=torch.float64))
        Schedule(3 steps, alpha_bar 0.9 to 0.1)
    """

    alpha_bar: Float64[Tensor, " _"]
    spacing: Spacing = "linspace"

    def __post_init__(self) -> None:
        if self.spacing not in get_args(Spacing):
            raise ValueError(f"unknown spacing {self.spacing!r}; choose from {', '.join(get_args(Spacing))}")
        before = torch.cat([self.alpha_bar.new_ones(1), self.alpha_bar])
        if len(before) < 2 or not bool((before[1:] < before[:-1]).all() & (before[1:] > 0).all()):
            raise ValueError(
                f"alpha_bar must start below 1 and decrease towards 0 at every step; got {self.alpha_bar.tolist()}"
            )

    def __repr__(self) -> str:
        return f"Schedule({self.steps} steps, alpha_bar {self.alpha_bar[0]:.4g} to {self.alpha_bar[-1]:.4g})"

    @classmethod
    def cosine(cls, steps: int, s: float = 0.008, spacing: Spacing = "linspace") -> Schedule:
        """Create the cosine schedule of Nichol and Dhariwal (2021), with every beta at most 0.999.

        MDM-SMPL uses it with 100 steps. `s` is the offset of the cosine, `spacing` as in `spaced`. Raises `ValueError`
        if `steps` is out of range.

        Examples:
            >>> stmc.Schedule.cosine(100).steps
            100
        """
        _check_steps(steps)

        def remaining(u: float) -> float:
            return math.cos(math.pi / 2 * (u + s) / (1 + s)) ** 2

        return cls._from_betas(
            [min(0.999, 1 - remaining((i + 1) / steps) / remaining(i / steps)) for i in range(steps)], spacing
        )

    @classmethod
    def linear(cls, steps: int, spacing: Spacing = "linspace") -> Schedule:
        """Create the linear schedule of Ho et al. (2020): beta from 1e-4 to 0.02 in 1000 steps, rescaled to `steps`.

        `spacing` as in `spaced`. Raises `ValueError` if `steps` is out of range.

        Examples:
            >>> round(float(stmc.Schedule.linear(1000).beta[-1]), 4)
            0.02
        """
        _check_steps(steps)
        scale = 1000 / steps
        betas = torch.linspace(1e-4 * scale, 0.02 * scale, steps, dtype=torch.float64).tolist()
        return cls._from_betas(betas, spacing)

    @classmethod
    def _from_betas(cls, betas: list[float], spacing: Spacing) -> Schedule:
        return cls(torch.cumprod(1 - torch.tensor(betas, dtype=torch.float64), dim=0), spacing)

    @property
    def steps(self) -> int:
        """Number of noising steps."""
        return len(self.alpha_bar)

    @property
    def alpha_bar_before(self) -> Float64[Tensor, " _"]:
        """`alpha_bar` one step earlier; 1 before the first step."""
        return torch.cat([self.alpha_bar.new_ones(1), self.alpha_bar[:-1]])

    @property
    def beta(self) -> Float64[Tensor, " _"]:
        """The fraction of the variance that each step replaces by noise."""
        return 1 - self.alpha_bar / self.alpha_bar_before

    def spaced(self, steps: int | None) -> tuple[int, ...]:
        """Return `steps` evenly spaced steps of this schedule in rising order; None returns all.

        With the spacing "linspace" they include both ends, as published. With "trailing" each is the noisiest of an
        equal share of the schedule, so that none of few steps is spent on the last trace of noise. Raises `ValueError`
        if `steps` is less than one or more than the schedule has.

        Examples:
            >>> stmc.Schedule.cosine(100).spaced(4)
            (0, 33, 66, 99)
            >>> stmc.Schedule.cosine(100, spacing="trailing").spaced(4)
            (24, 49, 74, 99)
        """
        if steps is None:
            return tuple(range(self.steps))
        if not 1 <= steps <= self.steps:
            raise ValueError(f"steps={steps}: this schedule can be sampled in 1 to {self.steps} steps")
        if steps == 1 or self.spacing == "trailing":
            return tuple(round((i + 1) * self.steps / steps) - 1 for i in range(steps))
        return tuple(round(i * (self.steps - 1) / (steps - 1)) for i in range(steps))

    def respaced(self, times: tuple[int, ...]) -> Schedule:
        """Return the schedule that visits only the steps `times` (rising): its step i has the noise of step times[i].

        Examples:
            >>> stmc.Schedule.cosine(100).respaced((0, 33, 66, 99)).steps
            4
        """
        return Schedule(self.alpha_bar[list(times)], self.spacing)

    def q_sample(
        self, x0: Float[Tensor, "batch ..."], t: Steps, noise: Float[Tensor, "batch ..."]
    ) -> Float[Tensor, "batch ..."]:
        """Add noise to clean samples: return x_t (Eq. 1, reparameterised).

        Args:
            x0: Clean samples, [batch, ...].
            t: Step of the batch, or of each sample.
            noise: Standard normal noise, of the shape of `x0`.

        Examples:
            >>> schedule = stmc.Schedule(torch.tensor([0.64, 0.36], dtype=torch.float64))
            >>> schedule.q_sample(torch.ones(1, 3), 1, noise=torch.zeros(1, 3))
            tensor([[0.6000, 0.6000, 0.6000]])
        """
        alpha_bar = self.alpha_bar
        return _at(alpha_bar.sqrt(), t, x0) * x0 + _at((1 - alpha_bar).sqrt(), t, x0) * noise

    def posterior(
        self, x0: Float[Tensor, "batch ..."], x: Float[Tensor, "batch ..."], t: Steps
    ) -> tuple[Float[Tensor, "batch ..."], Tensor]:
        """Compute the mean and variance of x_{t-1} given x_t and x_0 (Eq. 2 to 4).

        At step 0 they are `x0` and 0.

        Args:
            x0: Clean samples, [batch, ...].
            x: Noisy samples x_t, of the shape of `x0`.
            t: Step of the batch, or of each sample.

        Returns:
            The mean, [batch, ...], and the variance, which broadcasts to it.

        Examples:
            >>> mean, variance = stmc.Schedule.cosine(100).posterior(torch.ones(1, 3), torch.zeros(1, 3), 0)
            >>> mean, float(variance)
            (tensor([[1., 1., 1.]]), 0.0)
        """
        before, beta, noise = self.alpha_bar_before, self.beta, 1 - self.alpha_bar
        clean_weight = _at(beta * before.sqrt() / noise, t, x)
        noisy_weight = _at((1 - before) * (1 - beta).sqrt() / noise, t, x)
        return clean_weight * x0 + noisy_weight * x, _at(beta * (1 - before) / noise, t, x)

    def ddim(
        self, x0: Float[Tensor, "batch ..."], x: Float[Tensor, "batch ..."], t: Steps, eta: float = 0.0
    ) -> tuple[Float[Tensor, "batch ..."], Tensor]:
        """Compute the mean and variance of x_{t-1} given x_t and x_0 in DDIM (Song et al. 2021, Eq. 12 and 16).

        At step 0 they are `x0` and 0. With `eta=1` they are those of `posterior`.

        Args:
            x0: Clean samples, [batch, ...].
            x: Noisy samples x_t, of the shape of `x0`.
            t: Step of the batch, or of each sample.
            eta: Fraction of the ancestral noise.

        Returns:
            The mean, [batch, ...], and the variance, which broadcasts to it.

        Examples:
            >>> mean, variance = stmc.Schedule.cosine(100).ddim(torch.ones(1, 3), torch.zeros(1, 3), 0)
            >>> mean, float(variance)
            (tensor([[1., 1., 1.]]), 0.0)
        """
        before = self.alpha_bar_before
        variance = eta**2 * (1 - before) * self.beta / (1 - self.alpha_bar)
        noise_weight = (1 - before - variance).clamp(min=0).sqrt()
        noise = self.from_x0(x0, x, t, "eps")
        return _at(before.sqrt(), t, x) * x0 + _at(noise_weight, t, x) * noise, _at(variance, t, x)

    def to_x0(
        self, output: Float[Tensor, "batch ..."], x: Float[Tensor, "batch ..."], t: Steps, prediction: Prediction
    ) -> Float[Tensor, "batch ..."]:
        """Convert the output of a network to the clean sample that it represents.

        Args:
            output: Output of the network, [batch, ...].
            x: Noisy samples that the network received, of the same shape.
            t: Step of the batch, or of each sample.
            prediction: The quantity that the network predicts.

        Examples:
            >>> schedule = stmc.Schedule(torch.tensor([0.64, 0.36], dtype=torch.float64))
            >>> schedule.to_x0(output=torch.zeros(1, 3), x=torch.full((1, 3), 0.9), t=1, prediction="eps")
            tensor([[1.5000, 1.5000, 1.5000]])
        """
        if prediction == "x0":
            return output
        noisy_weight, output_weight = self._x0_weights(prediction)
        return _at(noisy_weight, t, x) * x + _at(output_weight, t, x) * output

    def from_x0(
        self, x0: Float[Tensor, "batch ..."], x: Float[Tensor, "batch ..."], t: Steps, prediction: Prediction
    ) -> Float[Tensor, "batch ..."]:
        """Convert the clean sample `x0` to the network output that represents it: the inverse of `to_x0`.

        With x = q_sample(x0, t, noise) the result is the training target of a network; for "eps" it is the noise.

        Args:
            x0: Clean samples, [batch, ...].
            x: Noisy samples, of the same shape.
            t: Step of the batch, or of each sample.
            prediction: The quantity that the network predicts.

        Examples:
            >>> schedule = stmc.Schedule(torch.tensor([0.64, 0.36], dtype=torch.float64))
            >>> schedule.from_x0(x0=torch.zeros(1, 3), x=torch.full((1, 3), 1.2), t=1, prediction="eps")
            tensor([[1.5000, 1.5000, 1.5000]])
        """
        if prediction == "x0":
            return x0
        noisy_weight, output_weight = self._x0_weights(prediction)
        return (x0 - _at(noisy_weight, t, x) * x) / _at(output_weight, t, x)

    def _x0_weights(self, prediction: str) -> tuple[Tensor, Tensor]:
        """Return the coefficients a and b of x0 = a x + b output, for every step."""
        signal, noise = self.alpha_bar.sqrt(), (1 - self.alpha_bar).sqrt()
        if prediction == "eps":
            return 1 / signal, -noise / signal
        if prediction == "v":
            return signal, -noise
        if prediction == "score":
            return 1 / signal, noise**2 / signal
        raise ValueError(f"unknown prediction {prediction!r}; choose from {', '.join(get_args(Prediction))}")


def _check_steps(steps: int) -> None:
    if not 1 <= steps <= MOST_STEPS:
        raise ValueError(f"steps={steps} must be 1 to {MOST_STEPS}")


def _at(coefficients: Float64[Tensor, " _"], t: Steps, like: Tensor) -> Tensor:
    """Return the coefficients of steps `t`, in the dtype and on the device of `like`, shaped to multiply it."""
    if isinstance(t, int):
        return coefficients[t].to(like)
    chosen = coefficients.to(t.device)[t].to(like)
    return chosen.reshape(-1, *[1] * (like.ndim - 1))
