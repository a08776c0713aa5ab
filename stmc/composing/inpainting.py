"""Inpainting: what is known of a clean sample stands in every prediction of it (imputation).

At every step the sampler then noises the known part like the rest, so that a network sees it, and what is new fits to
it; samplers need not know. Knows predictors and tensors; knows no plans.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from stmc.diffusion import Predict


class Known(NamedTuple):
    """What is known of timelines: normalised features, and their weights: 1 is kept, 0 is made anew, and what lies
    between them is a border: see `impute`."""

    content: Float[Tensor, "batch frames features"]
    weights: Float[Tensor, "batch frames features"]


def inpaint(
    predict: Predict, content: Float[Tensor, "batch frames features"], kept: Float[Tensor, "batch frames features"]
) -> Predict:
    """The predictor whose every answer is drawn towards `content`: by nothing where `kept` is 0, entirely where 1.

    To begin with less than full noise, sample with `schedule.respaced(tuple(range(steps)))` from `content` as noisy as
    at its last step: the samplers need not know.
    """
    return lambda x, t: torch.lerp(predict(x, t), content, kept)


def impute(
    predict: Predict, content: Float[Tensor, "batch frames features"], weights: Float[Tensor, "batch frames features"]
) -> Predict:
    """The predictor whose every answer is `content` where `weights` are 1, and is drawn towards it where they are less.

    Where there is no content (NaN), behind the end of what is known, an answer is moved instead by what it was off in
    the nearest frame that is kept, as much as weights say: so what is new begins where what is kept ends.
    """
    whole, there = weights == 1, content.isfinite()
    nearest = _nearest(whole)

    def imputed(x: Float[Tensor, "batch frames features"], t: int) -> Float[Tensor, "batch frames features"]:
        x0 = predict(x, t)
        off = content - x0
        off = torch.where(there, off, torch.where(whole, off, 0.0).gather(1, nearest))
        return torch.where(whole, content, x0 + weights * off)

    return imputed


def _nearest(whole: Bool[Tensor, "batch frames features"]) -> Int[Tensor, "batch frames features"]:
    """For every frame the nearest one that is kept; some frame where none is."""
    frame = torch.arange(whole.shape[1], device=whole.device)[:, None].expand_as(whole)
    far = 2 * whole.shape[1]
    before = torch.where(whole, frame, -far).cummax(dim=1).values
    behind = torch.where(whole, frame, far).flip(1).cummin(dim=1).values.flip(1)
    return torch.where(frame - before <= behind - frame, before, behind).clamp(0, whole.shape[1] - 1)
