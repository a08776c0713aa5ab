"""Inpainting by imputation: observed parts of a clean sample replace every prediction of them.

At every step the sampler noises the observed part like the rest, so that the network sees it and the new part fits to
it; samplers need no change. Depends on predictors and tensors; independent of plans.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from stmc.diffusion import Predict


class Observed(NamedTuple):
    """Observed features of timelines, normalised, and their weights: 1 is kept, 0 is generated, and values in between
    form a border (see `impute`).
    """

    content: Float[Tensor, "batch frames features"]
    weights: Float[Tensor, "batch frames features"]


def inpaint(
    predict: Predict, content: Float[Tensor, "batch frames features"], kept: Float[Tensor, "batch frames features"]
) -> Predict:
    """Wrap a predictor so that every prediction is interpolated towards `content` by the weights `kept`.

    To start with less than full noise, sample with `schedule.respaced(tuple(range(steps)))` from `content` noised to
    its last step; samplers need no change.

    Args:
        predict: Predictor of clean samples.
        content: Observed features, [batch, frames, features].
        kept: Weight of `content`, of the same shape: 0 keeps the prediction, 1 replaces it.
    """
    return lambda x, t: torch.lerp(predict(x, t), content, kept)


def impute(
    predict: Predict, content: Float[Tensor, "batch frames features"], weights: Float[Tensor, "batch frames features"]
) -> Predict:
    """Wrap a predictor so that every prediction equals `content` at weight 1 and moves towards it at lower weights.

    If there is no content (NaN), after the end of the observed part, a prediction is shifted instead by the weighted
    error in the nearest kept frame, so that the new part begins at the end of the kept part.

    Args:
        predict: Predictor of clean samples.
        content: Observed features or NaN, [batch, frames, features].
        weights: Weight of `content`, of the same shape.
    """
    kept, available = weights == 1, content.isfinite()
    nearest = _nearest(kept)

    def predict_imputed(x: Float[Tensor, "batch frames features"], t: int) -> Float[Tensor, "batch frames features"]:
        x0 = predict(x, t)
        error = content - x0
        error = torch.where(available, error, torch.where(kept, error, 0.0).gather(1, nearest))
        return torch.where(kept, content, x0 + weights * error)

    return predict_imputed


def _nearest(kept: Bool[Tensor, "batch frames features"]) -> Int[Tensor, "batch frames features"]:
    """Return the nearest kept frame for every frame, or any frame if none is kept."""
    frame = torch.arange(kept.shape[1], device=kept.device)[:, None].expand_as(kept)
    far = 2 * kept.shape[1]
    before = torch.where(kept, frame, -far).cummax(dim=1).values
    after = torch.where(kept, frame, far).flip(1).cummin(dim=1).values.flip(1)
    return torch.where(frame - before <= after - frame, before, after).clamp(0, kept.shape[1] - 1)
