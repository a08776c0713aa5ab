"""Samplers: generators that turn noise into a clean sample and yield the clean sample predicted at each step.

A sampler sees a `Predict` function and tensors of any shape; it is independent of networks, texts and timelines. The
caller iterates, and so decides about progress, early stopping and gradients. The last value yielded is the result.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import Literal, get_args

import torch
from jaxtyping import Float
from torch import Tensor

from stmc.diffusion.schedule import Schedule

Predict = Callable[[Float[Tensor, "batch frames features"], int], Float[Tensor, "batch frames features"]]
"""(x_t, t) → the clean sample predicted from x_t, where t is a step of the full schedule."""

Draw = Callable[[torch.Size], Tensor]
"""shape → standard normal noise of that shape, on the device and in the dtype of the sample."""

Sampler = Callable[..., Iterable[Tensor]]
"""(predict, schedule, x, draw) → the clean samples predicted at each step of that schedule."""

NoiseScale = Literal["std", "variance"]
"""Scale of the noise in ancestral steps: standard deviation or variance of the posterior."""


def ddpm(
    predict: Predict,
    schedule: Schedule,
    x: Float[Tensor, "batch ..."],
    draw: Draw,
    steps: int | None = None,
    noise_scale: NoiseScale = "variance",
) -> Iterator[Float[Tensor, "batch ..."]]:
    """Sample ancestrally (Ho et al. 2020; STMC, Eq. 2 to 4), starting from the noise `x`.

    With `noise_scale="std"` the noise is scaled by the standard deviation of the posterior, as in the textbook. With
    "variance" it is scaled by the variance, as in the published code of STMC (R1), which makes the distribution too
    narrow. On real motion (see the card of the bundled model) both follow the text equally often; "variance" has
    slightly less foot sliding and slightly less diversity, and is the default.

    Args:
        predict: Function that predicts the clean sample.
        schedule: Full noise schedule.
        x: Initial noise, [batch, ...].
        draw: Source of noise. It is called once per step, also at the last step, where the noise has no weight.
        steps: Number of evenly spaced steps; None uses all steps of the schedule.
        noise_scale: "std" or "variance".

    Yields:
        The clean sample predicted at each step, [batch, ...].

    Raises:
        ValueError: If `noise_scale` is unknown or `steps` is out of range.

    Examples:
        >>> draw = stmc.Noise(seeds=[0], lengths=[40], features=205)
        >>> *_, x0 = stmc.ddpm(lambda x, t: torch.ones_like(x), stmc.Schedule.cosine(100), draw(), draw, steps=4)
        >>> x0.shape, x0.unique()
        (torch.Size([1, 40, 205]), tensor([1.]))
    """
    if noise_scale not in get_args(NoiseScale):
        raise ValueError(f"unknown noise_scale {noise_scale!r}; choose from {', '.join(get_args(NoiseScale))}")
    times = schedule.spaced(steps)
    short = schedule.respaced(times)
    for i in reversed(range(len(times))):
        x0 = predict(x, times[i])
        yield x0
        mean, variance = short.posterior(x0, x, i)
        x = mean + (variance.sqrt() if noise_scale == "std" else variance) * draw(x.shape)


def ddim(
    predict: Predict,
    schedule: Schedule,
    x: Float[Tensor, "batch ..."],
    draw: Draw | None = None,
    steps: int | None = None,
    eta: float = 0.0,
) -> Iterator[Float[Tensor, "batch ..."]]:
    """Sample with DDIM (Song et al. 2021, Eq. 12 and 16), starting from the noise `x`.

    With `eta=0` the sampler follows the probability-flow ODE to first order and never draws noise; with `eta=1` it
    equals `ddpm` with `noise_scale="std"`.

    Args:
        predict: Function that predicts the clean sample.
        schedule: Full noise schedule.
        x: Initial noise, [batch, ...].
        draw: Source of noise, called once per step if `eta` is above 0.
        steps: Number of evenly spaced steps; None uses all steps of the schedule.
        eta: Fraction of the ancestral noise, 0 or greater.

    Yields:
        The clean sample predicted at each step, [batch, ...].

    Raises:
        ValueError: If `eta` is negative, if `eta` is above 0 and `draw` is missing, or if `steps` is out of range.

    Examples:
        >>> noise = stmc.Noise(seeds=[0], lengths=[40], features=205)()
        >>> *_, x0 = stmc.ddim(lambda x, t: torch.ones_like(x), stmc.Schedule.cosine(100), noise, steps=4)
        >>> x0.unique()
        tensor([1.])
    """
    if eta < 0 or (eta > 0 and draw is None):
        raise ValueError(f"eta={eta} must be 0 or greater, and a value above 0 needs a source of noise (draw)")
    times = schedule.spaced(steps)
    short = schedule.respaced(times)
    for i in reversed(range(len(times))):
        x0 = predict(x, times[i])
        yield x0
        x, variance = short.ddim(x0, x, i, eta)
        if draw is not None and eta > 0:
            x = x + variance.sqrt() * draw(x.shape)


def dpm_solver(
    predict: Predict,
    schedule: Schedule,
    x: Float[Tensor, "batch ..."],
    draw: Draw | None = None,
    steps: int | None = None,
) -> Iterator[Float[Tensor, "batch ..."]]:
    """Sample with DPM-Solver++(2M) (Lu et al. 2022, algorithm 2), starting from the noise `x`.

    The sampler follows the probability-flow ODE to second order with one prediction per step: the previous prediction
    gives the slope. It is deterministic.

    Args:
        predict: Function that predicts the clean sample.
        schedule: Full noise schedule.
        x: Initial noise, [batch, ...].
        draw: Never called; all samplers share one signature.
        steps: Number of evenly spaced steps; None uses all steps of the schedule.

    Yields:
        The clean sample predicted at each step, [batch, ...].

    Raises:
        ValueError: If `steps` is out of range.

    Examples:
        >>> noise = stmc.Noise(seeds=[0], lengths=[40], features=205)()
        >>> steps = stmc.dpm_solver(lambda x, t: torch.ones_like(x), stmc.Schedule.cosine(100), noise, steps=4)
        >>> len(list(steps))
        4
    """
    times = schedule.spaced(steps)
    short = schedule.respaced(times)
    signal, noise = short.alpha_bar.sqrt(), (1 - short.alpha_bar).sqrt()
    log_snr = (signal / noise).log()
    previous = None
    for i in reversed(range(len(times))):
        x0 = predict(x, times[i])
        yield x0
        if i == 0:
            return
        gain = log_snr[i - 1] - log_snr[i]
        slope = 0 if previous is None else (x0 - previous) * (gain / (2 * (log_snr[i] - log_snr[i + 1]))).to(x)
        x = (noise[i - 1] / noise[i]).to(x) * x - (signal[i - 1] * torch.expm1(-gain)).to(x) * (x0 + slope)
        previous = x0


SAMPLERS: Mapping[str, Sampler] = {"ddpm": ddpm, "ddim": ddim, "dpm_solver": dpm_solver}
"""Samplers by their names in configurations."""
