"""The forward process and its posterior: Eq. 1 to 4 of STMC, and what a network may be trained to predict.

`alpha_bar` (the cumulative product of 1 - beta) determines everything else. Coefficients stay float64 until they meet a
tensor, then take its dtype. Knows no networks and no motion.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal, get_args

import torch
from jaxtyping import Float, Float64, Int
from torch import Tensor

Prediction = Literal["x0", "eps", "v", "score"]
"""What a network predicts: the clean sample, the noise, sqrt(alpha_bar) eps - sqrt(1 - alpha_bar) x0, or the score."""

Steps = int | Int[Tensor, " batch"]
"""One step for the whole batch, or one for each sample; 0 is the least noisy."""


MOST_STEPS = 10_000
"""Of a schedule; published ones have 50 to 1000."""


@dataclass(frozen=True, eq=False, repr=False)
class Schedule:
    """A noise schedule: `alpha_bar[t]` is the share of the clean sample's variance that is left at step t.

    Examples:
        >>> stmc.Schedule(torch.tensor([0.9, 0.5, 0.1], dtype=torch.float64))
        Schedule(3 steps, alpha_bar 0.9 to 0.1)
    """

    alpha_bar: Float64[Tensor, " _"]

    def __post_init__(self) -> None:
        before = torch.cat([self.alpha_bar.new_ones(1), self.alpha_bar])
        if len(before) < 2 or not bool((before[1:] < before[:-1]).all() & (before[1:] > 0).all()):
            raise ValueError(f"alpha_bar must fall from below 1 towards 0 at every step, not {self.alpha_bar.tolist()}")

    def __repr__(self) -> str:
        return f"Schedule({self.steps} steps, alpha_bar {self.alpha_bar[0]:.4g} to {self.alpha_bar[-1]:.4g})"

    @classmethod
    def cosine(cls, steps: int, s: float = 0.008) -> Schedule:
        """The schedule of Nichol and Dhariwal (2021), which MDM-SMPL uses with 100 steps; no beta exceeds 0.999.

        Examples:
            >>> stmc.Schedule.cosine(100).steps
            100
        """
        _check_steps(steps)

        def left(u: float) -> float:
            return math.cos(math.pi / 2 * (u + s) / (1 + s)) ** 2

        return cls._from_betas([min(0.999, 1 - left((i + 1) / steps) / left(i / steps)) for i in range(steps)])

    @classmethod
    def linear(cls, steps: int) -> Schedule:
        """The schedule of Ho et al. (2020), 1e-4 to 0.02 for 1000 steps, rescaled to other numbers of steps.

        Examples:
            >>> round(float(stmc.Schedule.linear(1000).beta[-1]), 4)
            0.02
        """
        _check_steps(steps)
        scale = 1000 / steps
        return cls._from_betas(torch.linspace(1e-4 * scale, 0.02 * scale, steps, dtype=torch.float64).tolist())

    @classmethod
    def _from_betas(cls, betas: list[float]) -> Schedule:
        return cls(torch.cumprod(1 - torch.tensor(betas, dtype=torch.float64), dim=0))

    @property
    def steps(self) -> int:
        """How many steps of noising there are."""
        return len(self.alpha_bar)

    @property
    def alpha_bar_before(self) -> Float64[Tensor, " _"]:
        """`alpha_bar` one step earlier; 1 before the first."""
        return torch.cat([self.alpha_bar.new_ones(1), self.alpha_bar[:-1]])

    @property
    def beta(self) -> Float64[Tensor, " _"]:
        """The share of variance that each step replaces by noise."""
        return 1 - self.alpha_bar / self.alpha_bar_before

    def spaced(self, steps: int | None) -> tuple[int, ...]:
        """`steps` of this schedule's steps in rising order, evenly spaced and with both ends; all of them for None.

        Raises `ValueError` for less than one or more than there are.

        Examples:
            >>> stmc.Schedule.cosine(100).spaced(4)
            (0, 33, 66, 99)
        """
        if steps is None:
            return tuple(range(self.steps))
        if not 1 <= steps <= self.steps:
            raise ValueError(f"steps={steps}: this schedule can be sampled in 1 to {self.steps} steps")
        if steps == 1:
            return (self.steps - 1,)
        return tuple(round(i * (self.steps - 1) / (steps - 1)) for i in range(steps))

    def respaced(self, times: tuple[int, ...]) -> Schedule:
        """The schedule that visits only the steps `times` (rising): its step i has the noise of step times[i].

        Examples:
            >>> stmc.Schedule.cosine(100).respaced((0, 33, 66, 99)).steps
            4
        """
        return Schedule(self.alpha_bar[list(times)])

    def q_sample(
        self, x0: Float[Tensor, "batch ..."], t: Steps, noise: Float[Tensor, "batch ..."]
    ) -> Float[Tensor, "batch ..."]:
        """x_t of clean samples `x0` with standard normal `noise`: Eq. 1, reparameterised.

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
        """Mean and variance of x_{t-1} given x_t and x_0 (Eq. 2 to 4); at step 0 they are `x0` itself and 0.

        Examples:
            >>> mean, variance = stmc.Schedule.cosine(100).posterior(torch.ones(1, 3), torch.zeros(1, 3), 0)
            >>> mean, float(variance)
            (tensor([[1., 1., 1.]]), 0.0)
        """
        before, beta, noise = self.alpha_bar_before, self.beta, 1 - self.alpha_bar
        clean_share = _at(beta * before.sqrt() / noise, t, x)
        noisy_share = _at((1 - before) * (1 - beta).sqrt() / noise, t, x)
        return clean_share * x0 + noisy_share * x, _at(beta * (1 - before) / noise, t, x)

    def to_x0(
        self, output: Float[Tensor, "batch ..."], x: Float[Tensor, "batch ..."], t: Steps, prediction: Prediction
    ) -> Float[Tensor, "batch ..."]:
        """The clean sample that a network's `output` for the noisy `x` stands for.

        Examples:
            >>> schedule = stmc.Schedule(torch.tensor([0.64, 0.36], dtype=torch.float64))
            >>> schedule.to_x0(output=torch.zeros(1, 3), x=torch.full((1, 3), 0.9), t=1, prediction="eps")
            tensor([[1.5000, 1.5000, 1.5000]])
        """
        if prediction == "x0":
            return output
        noisy_share, output_share = self._x0_shares(prediction)
        return _at(noisy_share, t, x) * x + _at(output_share, t, x) * output

    def from_x0(
        self, x0: Float[Tensor, "batch ..."], x: Float[Tensor, "batch ..."], t: Steps, prediction: Prediction
    ) -> Float[Tensor, "batch ..."]:
        """The output that stands for the clean sample `x0` of the noisy `x`: the inverse of `to_x0`.

        With x = q_sample(x0, t, noise) it is a network's target in training; for "eps" it is the noise.

        Examples:
            >>> schedule = stmc.Schedule(torch.tensor([0.64, 0.36], dtype=torch.float64))
            >>> schedule.from_x0(x0=torch.zeros(1, 3), x=torch.full((1, 3), 1.2), t=1, prediction="eps")
            tensor([[1.5000, 1.5000, 1.5000]])
        """
        if prediction == "x0":
            return x0
        noisy_share, output_share = self._x0_shares(prediction)
        return (x0 - _at(noisy_share, t, x) * x) / _at(output_share, t, x)

    def _x0_shares(self, prediction: str) -> tuple[Tensor, Tensor]:
        """a and b of x0 = a x + b output, for every step."""
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
        raise ValueError(f"steps={steps}: a schedule has 1 to {MOST_STEPS} steps")


def _at(coefficients: Float64[Tensor, " _"], t: Steps, like: Tensor) -> Tensor:
    """The coefficients of steps `t`, in dtype and on the device of `like`, ready to multiply it."""
    if isinstance(t, int):
        return coefficients[t].to(like)
    chosen = coefficients.to(t.device)[t].to(like)
    return chosen.reshape(-1, *[1] * (like.ndim - 1))
