"""The collage: from a predictor of crops to a predictor of whole timelines (STMC, section 3.3), and SINC.

Crops of several plans share one batch: plan 0's crops first, then plan 1's, each from its first frame, padded to the
longest. Index tensors are built once for a batch of plans; a step is then a handful of tensor operations, whatever the
number of prompts. Independent of networks, texts, samplers and the meaning of the features beyond each part's columns.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import torch
import torch.nn.functional as F
from einops import rearrange
from jaxtyping import Bool, Float
from torch import Tensor

from stmc.diffusion import Predict, Seed
from stmc.diffusion.tensors import PerDevice, mask
from stmc.motion.body import BodyPart
from stmc.timeline.planning import Plan, Tile

Columns = Mapping[BodyPart, Sequence[int]]
"""The columns of the features that each body part owns; every column has exactly one owner."""


def crop_lengths(plans: Sequence[Plan], fixed_length: int | None = None) -> tuple[int, ...]:
    """Return the number of frames that a denoiser sees of every crop of all plans, in batch order.

    This is the crop's own length, or `fixed_length`. Raises `ValueError` if a crop is longer than `fixed_length`.
    """
    lengths = tuple(crop.frames for plan in plans for crop in plan.crops)
    if fixed_length is None:
        return lengths
    if max(lengths, default=0) > fixed_length:
        raise ValueError(
            f"a crop has {max(lengths)} frames, but the denoiser sees {fixed_length}; plan with longest={fixed_length}"
        )
    return (fixed_length,) * len(lengths)


def canvas_lengths(plans: Sequence[Plan], fixed_length: int | None = None) -> tuple[int, ...]:
    """Return the number of frames to sample for every plan: its own, and those after it that its last crops see."""
    return tuple(plan.frames + (fixed_length or 0) for plan in plans)


def crop_seeds(plans: Sequence[Plan], seeds: Sequence[int]) -> tuple[Seed, ...]:
    """Derive a seed for every crop of all plans from one seed per plan, for independent noise."""
    return tuple((seed, crop) for plan, seed in zip(plans, seeds, strict=True) for crop in range(len(plan.crops)))


def crops_of(
    x: Float[Tensor, "batch frames features"], plans: Sequence[Plan], fixed_length: int | None = None
) -> Float[Tensor, "crops _ features"]:
    """Cut the plans' crops from timelines, as `collage` does."""
    return _Cut(plans, fixed_length)(x)


def collage(predict: Predict, plans: Sequence[Plan], columns: Columns, fixed_length: int | None = None) -> Predict:
    r"""Build a predictor of timelines [batch, frames, features] from a predictor of their crops (STMC, section 3.3).

    It cuts the timelines into the plans' crops, predicts those, and adds them up with the weights of the tiles: body
    parts side by side, and in time with the unconditional transitions subtracted (DiffCollage). The batch holds one
    timeline per plan, padded to the longest; the result is zero beyond the end of a timeline. With a `fixed_length`
    every crop is extended to that length: the timelines have `canvas_lengths(plans, fixed_length)` frames, and
    predictions after the end of a crop are dropped.

    Args:
        predict: Predictor of crops.
        plans: Plan of each timeline.
        columns: Columns of each body part.
        fixed_length: Number of frames of every crop, or None for its own length.

    Raises:
        ValueError: If `columns` does not own every feature exactly once, or a crop is longer than `fixed_length`.

    Examples:
        >>> plan = stmc.plan(stmc.Timeline.parse("walk # 0 # 2\njump # 2 # 4"), fps=20, overlap=10)
        >>> columns = {part: [column] for column, part in enumerate(stmc.BodyPart)}
        >>> predict = stmc.collage(lambda crops, t: torch.ones_like(crops), [plan], columns)
        >>> predict(torch.zeros(1, 80, 5), 0).unique()
        tensor([1.])
    """
    cut, stitch = _Cut(plans, fixed_length), _Stitch(plans, columns)
    longest, extra = max(crop_lengths(plans)), fixed_length or 0
    return lambda x, t: F.pad(stitch(predict(cut(x), t)[:, :longest]), (0, 0, 0, extra))


def crops_needed(
    plans: Sequence[Plan], observed: Bool[Tensor, "batch _ features"], columns: Columns
) -> tuple[bool, ...]:
    r"""Return, for every crop of all plans, whether a collage uses any part of it that is not observed.

    Args:
        plans: Plan of each timeline.
        observed: True at observed features, [batch, frames, features].
        columns: Columns of each body part.

    Examples:
        >>> plan = stmc.plan(stmc.Timeline.parse("walk # 0 # 2\njump # 2 # 4"), fps=20, overlap=10)
        >>> observed = torch.zeros(1, 80, 5, dtype=torch.bool)
        >>> observed[:, :60] = True
        >>> columns = {part: [column] for column, part in enumerate(stmc.BodyPart)}
        >>> [crop.text for crop, needed in zip(plan.crops, crops_needed([plan], observed, columns)) if needed]
        ['jump']
    """
    needed = []
    for plan, row in zip(plans, observed.cpu(), strict=True):
        open_frames = {part: ~row[:, list(owned)].all(dim=1) for part, owned in columns.items()}
        tiles = [(tile.crop, bool(open_frames[tile.part][tile.start : tile.end].any())) for tile in plan.tiles]
        used = {crop for crop, is_open in tiles if is_open}
        needed += [crop in used for crop in range(len(plan.crops))]
    return tuple(needed)


def sinc(
    crops: Float[Tensor, "crops _ features"], plans: Sequence[Plan], columns: Columns
) -> Float[Tensor, "batch frames features"]:
    r"""Combine finished, independently sampled crops into timelines (SINC, Athanasiou et al. 2023).

    Every body part of every frame comes from one crop. Frames after the end of the longest crop are dropped.

    Args:
        crops: Finished crops, [crops, frames, features].
        plans: Plans without overlap.
        columns: Columns of each body part.

    Examples:
        >>> plan = stmc.plan(stmc.Timeline.parse("walk # 0 # 1\njump # 1 # 2"), fps=20, overlap=0)
        >>> columns = {part: [column] for column, part in enumerate(stmc.BodyPart)}
        >>> crops = torch.stack([torch.zeros(20, 5), torch.ones(20, 5)])
        >>> stmc.sinc(crops, [plan], columns)[0, 18:22, 0]
        tensor([0., 0., 1., 1.])
    """
    return _Stitch(plans, columns)(crops[:, : max(crop_lengths(plans))])


class _Cut:
    """Timelines [batch, frames, features] → all crops, with zeros after the end of each, or all of one length."""

    def __init__(self, plans: Sequence[Plan], fixed_length: int | None) -> None:
        self._shape = (len(plans), max(canvas_lengths(plans, fixed_length)))
        first = [i * self._shape[1] + crop.start for i, plan in enumerate(plans) for crop in plan.crops]
        valid = mask(torch.tensor(crop_lengths(plans, fixed_length)))
        rows = (torch.tensor(first)[:, None] + torch.arange(valid.shape[1])).where(valid, 0)
        self._indexes = PerDevice(lambda x: (rows.to(x.device), ~valid[..., None].to(x.device)))

    def __call__(self, x: Tensor) -> Tensor:
        assert x.shape[:2] == self._shape, f"timelines of shape {tuple(x.shape[:2])}, but the plans have {self._shape}"
        rows, outside = self._indexes.at(x)
        return rearrange(x, "batch frames features -> (batch frames) features")[rows].masked_fill(outside, 0)


class _Stitch:
    """All crops [crops, frames, features] → timelines, by the plans' tiles, with zeros after the end of each."""

    def __init__(self, plans: Sequence[Plan], columns: Columns) -> None:
        owned = sorted(column for part in columns.values() for column in part)
        if owned != list(range(len(owned))):
            raise ValueError(
                f"the columns of the body parts must be 0 to {len(owned) - 1}, each exactly once; got {owned}"
            )
        self._features = len(owned)
        self._timelines = (len(plans), max(plan.frames for plan in plans))
        self._crops = (len(crop_lengths(plans)), max(crop_lengths(plans)))
        parts = [(list(columns[part]), *self._sources(plans, part)) for part in columns]
        self._parts = PerDevice(
            lambda x: [
                (torch.tensor(owned_columns, device=x.device), source.to(x.device), weight.to(x)[..., None])
                for owned_columns, source, weight in parts
            ]
        )

    def _sources(self, plans: Sequence[Plan], part: BodyPart) -> tuple[Tensor, Tensor]:
        """Compute, for every frame of every timeline, the crop rows that make up `part`, and their weights.

        Both results have shape [batch * frames, most]. A gather from a fixed number of sources adds in the same order
        on any device.
        """
        tiles = list(self._locate_tiles(plans, part))
        count = np.zeros(self._timelines[0] * self._timelines[1], dtype=np.int64)
        for tile, _, target in tiles:
            count[target : target + tile.end - tile.start] += 1
        source = np.zeros((len(count), max(1, count.max())), dtype=np.int64)
        weight = np.zeros(source.shape)
        count[:] = 0
        for tile, first, target in tiles:
            frames = np.arange(tile.end - tile.start)
            index = (target + frames, count[target + frames])
            source[index], weight[index] = first + frames, tile.weight
            count[target + frames] += 1
        return torch.from_numpy(source), torch.from_numpy(weight)

    def _locate_tiles(self, plans: Sequence[Plan], part: BodyPart) -> list[tuple[Tile, int, int]]:
        """Return the tiles of `part`, each with its first row in the flat crops and its first flat frame."""
        tiles, crops = [], 0
        for i, plan in enumerate(plans):
            for tile in plan.tiles:
                if tile.part == part:
                    first = (crops + tile.crop) * self._crops[1] + tile.start - plan.crops[tile.crop].start
                    tiles.append((tile, first, i * self._timelines[1] + tile.start))
            crops += len(plan.crops)
        return tiles

    def __call__(self, crops: Tensor) -> Tensor:
        expected = (*self._crops, self._features)
        assert crops.shape == expected, f"crops of shape {tuple(crops.shape)}, but plans and columns need {expected}"
        flat = rearrange(crops, "crops frames features -> (crops frames) features")
        timelines = flat.new_empty(self._timelines[0] * self._timelines[1], self._features)
        for owned, source, weight in self._parts.at(crops):
            timelines[:, owned] = (flat[:, owned][source] * weight).sum(dim=1)
        return rearrange(timelines, "(batch frames) features -> batch frames features", batch=self._timelines[0])
