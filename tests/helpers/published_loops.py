"""The sampling loops of the four published codes, written anew from the papers and from facts about the code.

One timeline at a time, crop by crop and frame by frame of a plan by `appendix_b`; schedules and steps in float64 until
they meet a tensor. Networks are given: their own oracles are in `equations`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence

import numpy as np
import torch
from helpers.appendix_b import PARTS, by_the_rules
from torch import Tensor

Network = Callable[..., Tensor]
Answer = Callable[[Tensor, int, int], Tensor]
"""(noisy crop [frames, features], t, number of the crop) → its clean frames."""


def cosine(steps: int) -> list[float]:
    """Alpha bar of Nichol and Dhariwal (2021): no beta above 0.999."""
    level = [math.cos((i / steps + 0.008) / 1.008 * math.pi / 2) ** 2 for i in range(steps + 1)]
    return np.cumprod([1 - min(1 - level[i + 1] / level[i], 0.999) for i in range(steps)]).tolist()


def linear(steps: int) -> list[float]:
    """Alpha bar of Ho et al. (2020), rescaled to other numbers of steps."""
    return np.cumprod(1 - np.linspace(0.1 / steps, 20 / steps, steps)).tolist()


def chain(predict: Callable[[Tensor, int], Tensor], left: Sequence[float], shape: tuple, seed: int, root: bool):
    """The clean sample after all steps; noise is scaled by the posterior's standard deviation (`root`), as in MDM's
    code, MotionDiffuse's and FlowMDM's, or by its variance, as in the code of STMC's own model."""
    draw = np.random.default_rng(seed)
    x = torch.from_numpy(draw.standard_normal(shape, dtype=np.float32))
    for t in reversed(range(len(left))):
        clean = predict(x, t)
        now, before = left[t], left[t - 1] if t else 1.0
        beta = 1 - now / before
        mean = math.sqrt(before) * beta / (1 - now) * clean + math.sqrt(1 - beta) * (1 - before) / (1 - now) * x
        variance = beta * (1 - before) / (1 - now)
        noise = torch.from_numpy(draw.standard_normal(shape, dtype=np.float32))
        x = mean + (math.sqrt(variance) if root else variance) * noise
    return clean


def stmc(
    answer: Answer,
    left: Sequence[float],
    prompts: list[tuple[int, int, list[str]]],
    columns: Mapping[str, Sequence[int]],
    overlap: int,
    seed: int,
    window: int | None,
    root: bool,
) -> Tensor:
    """STMC, section 3.3: crops are answered, added up and, in transitions, subtracted, part by part, at every step.

    With a `window` every crop has as many frames, and as many stand behind the timeline's end, whose clean ones are 0.
    """
    frames, crops, plus, minus = by_the_rules(prompts, overlap)
    features = sum(len(own) for own in columns.values())

    def composite(x: Tensor, t: int) -> Tensor:
        clean = torch.zeros_like(x)
        for number, (start, end) in enumerate(crops):
            answered = answer(x[start : start + window if window else end], t, number)
            for sign, tiles in ((1, plus), (-1, minus)):
                for part, own in zip(PARTS, tiles, strict=True):
                    for row, first, last, inner, outer in own:
                        if row == number:
                            clean[first:last, columns[part]] += sign * answered[inner:outer, columns[part]]
        return clean

    return chain(composite, left, (frames + (window or 0), features), seed, root)[:frames]


def guided_answer(network: Network, words: Sequence[Tensor], null: Tensor, scale: float) -> Answer:
    """MDM's and MDM-SMPL's: every crop with its text and without one, also those of transitions."""

    def answer(x: Tensor, t: int, number: int) -> Tensor:
        rows = [network(x[None], torch.tensor([t]), text[None])[0] for text in (words[number], null)]
        return rows[1] + scale * (rows[0] - rows[1])

    return answer


def noise_answer(denoise: Network, words: Sequence[Tensor], left: Sequence[float]) -> Answer:
    """MotionDiffuse's: the noise is predicted, without guidance, and taken off each crop before they are added up.
    `words` have been through its text transformer, once for all steps."""

    def answer(x: Tensor, t: int, number: int) -> Tensor:
        eps = denoise(x[None], torch.tensor([t]), words[number][None])[0]
        return math.sqrt(1 / left[t]) * x - math.sqrt(1 / left[t] - 1) * eps

    return answer


def flow_mdm(
    blended: Network, words: Tensor, lengths: Sequence[int], features: int, left: Sequence[float], more: dict
) -> Tensor:
    """FlowMDM, section 3: the whole composition as one sequence; its noisiest steps, one less than asked for, with
    absolute positions. `words` [segments, width] as the network embeds them, `more["null"]` that of no text."""
    segment = torch.from_numpy(np.repeat(np.arange(len(lengths)), lengths))[None]
    none = more["null"].expand_as(words)

    def predict(x: Tensor, t: int) -> Tensor:
        absolute = torch.tensor([t > len(left) - more["absolute"]])
        rows = [blended(x[None], torch.tensor([t]), text[None], absolute, None, segment)[0] for text in (words, none)]
        return rows[1] + more["scale"] * (rows[0] - rows[1])

    return chain(predict, left, (sum(lengths), features), more["seed"], root=True)
