"""The published sampling loop of STMC as a method, to measure the speed of ours against.

It is slow on purpose: every step calls the network twice over all crops, padded to the longest, with text and without,
also for transitions, encodes the texts anew, and adds up the crops one body part at a time. Written from section 3.3
and from facts about the published code; `stmc_paper` gives the same motions.
"""

from __future__ import annotations

import math
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from stmc.composing import Method, Run, find_method
from stmc.composing.guided import NULL, distinct_texts
from stmc.diffusion import guide
from stmc.diffusion.tensors import mask, pad
from stmc.model import Model
from stmc.timeline.planning import Plan


def published_loop(model: Model) -> Method:
    """Return a method that samples with the published loop, in fp32, on a model with one text per crop.

    The method does not support constraints or observed frames.

    Args:
        model: Model whose network, texts and schedule are used; its crops must not have a fixed length.

    Raises:
        ValueError: If the network sees crops of one fixed length, or a text for every frame.
    """
    network = model.network
    if network.fixed_length is not None or network.per_frame_text:
        raise ValueError(f"{network.name}: the published loop needs one text per crop, and crops of any length")
    return replace(find_method("stmc_paper"), sample=partial(_sample, model), label="published loop")


class _Rows(NamedTuple):
    """All crops of all plans as rows of a batch."""

    plan: list[int]
    lengths: Tensor
    text: Tensor
    text_mask: Tensor
    null: Tensor
    null_mask: Tensor


def _sample(model: Model, run: Run) -> Float[Tensor, "batch frames features"]:
    plans, schedule = run.plans(), run.schedule.respaced(run.times)
    rows, draw = _rows(model, plans, run.device), run.noise(plans)
    x = clean = draw()
    for i in reversed(range(schedule.steps)):
        clean = _compose(_predict(model, x, run.times[i], run.guidance, plans, rows), x, plans, rows, run)
        now, before = float(schedule.alpha_bar[i]), float(schedule.alpha_bar_before[i])
        beta = 1 - now / before
        mean = math.sqrt(before) * beta / (1 - now) * clean + math.sqrt(1 - beta) * (1 - before) / (1 - now) * x
        variance = beta * (1 - before) / (1 - now)
        x = mean + (math.sqrt(variance) if run.sampling.noise_scale == "std" else variance) * draw()
    return clean


def _rows(model: Model, plans: list[Plan], device: torch.device) -> _Rows:
    embeddings = model.embed(distinct_texts(plans))
    crops = [(number, crop) for number, plan in enumerate(plans) for crop in plan.crops]
    text, words = pad([embeddings[crop.text or NULL] for _, crop in crops])
    null, null_words = pad([embeddings[NULL]] * len(crops))
    lengths = torch.tensor([crop.frames for _, crop in crops])
    return _Rows(
        [number for number, _ in crops],
        lengths,
        *(each.to(device) for each in (text, mask(words), null, mask(null_words))),
    )


def _predict(model: Model, x: Tensor, t: int, guidance: float | int, plans: list[Plan], rows: _Rows) -> Tensor:
    """Predict the clean crops, [crops, frames, features]: two calls over all crops, padded to the longest."""
    longest = int(rows.lengths.max())
    noisy = x.new_zeros(len(rows.lengths), longest, x.shape[-1])
    for row, (number, crop) in enumerate(zip(rows.plan, (each for plan in plans for each in plan.crops), strict=True)):
        noisy[row, : crop.frames] = x[number, crop.start : crop.end]
    step, real = torch.full((len(noisy),), t, device=x.device), mask(rows.lengths).to(x.device)
    text, null = (
        model.schedule.to_x0(model.denoiser(noisy, step, words, words_mask, real), noisy, t, model.prediction)
        for words, words_mask in ((rows.text, rows.text_mask), (rows.null, rows.null_mask))
    )
    return guide(text, null, guidance)


def _compose(crops: Tensor, x: Tensor, plans: list[Plan], rows: _Rows, run: Run) -> Tensor:
    """Add up the crops by the tiles of the plans, [batch, frames, features]."""
    clean, first = torch.zeros_like(x), 0
    for number, plan in enumerate(plans):
        for tile in plan.tiles:
            start = plan.crops[tile.crop].start
            columns = list(run.columns[tile.part])
            part = crops[first + tile.crop, tile.start - start : tile.end - start][:, columns]
            clean[number, tile.start : tile.end, columns] += tile.weight * part
        first += len(plan.crops)
    return clean
