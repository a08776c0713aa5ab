"""Samplers: from noise to a clean sample, as generators of the clean sample each step predicts.

A sampler sees a `Predict` and tensors of any shape; it knows no networks, texts or timelines. Whoever iterates decides
what to show, when to stop, and whether gradients are recorded. The last value yielded is the result.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from typing import Literal, get_args

import torch
from jaxtyping import Float
from torch import Tensor

from stmc.diffusion.schedule import Schedule

Predict = Callable[[Float[Tensor, "batch frames features"], int], Float[Tensor, "batch frames features"]]
"""(x_t, t) → the clean sample predicted from it; t is a step of the full schedule."""

Draw = Callable[[torch.Size], Tensor]
"""shape → standard normal noise of that shape, on the device and in the dtype of the sample."""

Sampler = Callable[..., Iterable[Tensor]]
"""(predict, schedule, x, draw) → the clean sample that each step predicts, for steps of that very schedule."""

NoiseScale = Literal["std", "variance"]
"""What scales the noise of ancestral steps: the posterior's standard deviation, or its variance."""


def ddpm(
    predict: Predict,
    schedule: Schedule,
    x: Float[Tensor, "batch ..."],
    draw: Draw,
    steps: int | None = None,
    noise_scale: NoiseScale = "variance",
) -> Iterator[Float[Tensor, "batch ..."]]:
    """Ancestral sampling (Ho et al. 2020; STMC, Eq. 2 to 4) from the noise `x`, in all steps or in `steps` of them.

    `draw(x.shape)` is called once a step, also at the last, where the noise has no weight. `noise_scale` "std" scales
    it by the posterior's standard deviation, the textbook's; "variance" by its variance, as the published code of STMC
    does (R1): too narrow a distribution. Measured on real motion (see the bundled model's card) both do as the text
    says equally often, and "variance" slides a little less and is a little less diverse, so it is the default.

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
    """DDIM (Song et al. 2021, Eq. 12 and 16) from the noise `x`, in all steps or in `steps` of them.

    With `eta` 0 it follows the probability-flow ODE to first order and never draws; with 1 it is `ddpm`. In between,
    and up to there, `draw(x.shape)` is called once a step.

    Examples:
        >>> noise = stmc.Noise(seeds=[0], lengths=[40], features=205)()
        >>> *_, x0 = stmc.ddim(lambda x, t: torch.ones_like(x), stmc.Schedule.cosine(100), noise, steps=4)
        >>> x0.unique()
        tensor([1.])
    """
    if eta < 0 or (eta > 0 and draw is None):
        raise ValueError(f"eta={eta}: it must not be negative, and above 0 a source of noise (draw) is needed")
    times = schedule.spaced(steps)
    short = schedule.respaced(times)
    for i in reversed(range(len(times))):
        x0 = predict(x, times[i])
        yield x0
        noise = short.from_x0(x0, x, i, "eps")
        left = 1 - short.alpha_bar_before[i]
        variance = eta**2 * left * short.beta[i] / (1 - short.alpha_bar[i])
        x = short.alpha_bar_before[i].sqrt().to(x) * x0 + (left - variance).clamp(min=0).sqrt().to(x) * noise
        if eta > 0:
            x = x + variance.sqrt().to(x) * draw(x.shape)


def dpm_solver(
    predict: Predict,
    schedule: Schedule,
    x: Float[Tensor, "batch ..."],
    draw: Draw | None = None,
    steps: int | None = None,
) -> Iterator[Float[Tensor, "batch ..."]]:
    """DPM-Solver++(2M) (Lu et al. 2022, algorithm 2) from the noise `x`, in all steps or in `steps` of them.

    Follows the probability-flow ODE to second order with one prediction a step, the previous one giving the slope. It
    is deterministic: `draw` is accepted for the sake of one signature, and never called.

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
    before = None
    for i in reversed(range(len(times))):
        x0 = predict(x, times[i])
        yield x0
        if i == 0:
            return
        gain = log_snr[i - 1] - log_snr[i]
        slope = 0 if before is None else (x0 - before) * (gain / (2 * (log_snr[i] - log_snr[i + 1]))).to(x)
        x = (noise[i - 1] / noise[i]).to(x) * x - (signal[i - 1] * torch.expm1(-gain)).to(x) * (x0 + slope)
        before = x0


SAMPLERS = {"ddpm": ddpm, "ddim": ddim, "dpm_solver": dpm_solver}
"""By the names that configurations use."""
