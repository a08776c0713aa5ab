"""Crops one after the other in the rows of a batch: where each begins, and how one fades into the next.

Knows how many frames crops have and how many they share; knows no data set and what no feature means.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor


@dataclass(frozen=True)
class Arrangement:
    """Which `row` each crop of so many `frames` stands in, ascending from 0 without a gap, and how many frames it
    shares with the one before it in its row (`fade`; 0 of the first). A crop's two fades never overlap."""

    row: np.ndarray
    frames: np.ndarray
    fade: np.ndarray

    @cached_property
    def begin(self) -> np.ndarray:
        """Of each crop in its row."""
        own = self.frames - self.fade
        ends = np.cumsum(own)
        return ends - own - (ends - own)[self.first][self.row] - self.fade

    @cached_property
    def first(self) -> np.ndarray:
        """Each row's first crop."""
        return np.flatnonzero(np.diff(self.row, prepend=-1))

    @cached_property
    def place(self) -> np.ndarray:
        """Of each crop among those of its row."""
        return np.arange(len(self.row)) - self.first[self.row]

    @cached_property
    def lengths(self) -> np.ndarray:
        """Frames of each row."""
        last = np.append(self.first[1:], len(self.row)) - 1
        return (self.begin + self.frames)[last]

    def segments(self) -> np.ndarray:
        """The place in its row of the crop that each frame of a row belongs to, (rows, frames): two that fade into each
        other meet in the middle. Frames after a row's end belong to its last."""
        changes = np.zeros((len(self.lengths), int(self.lengths.max())), dtype=int)
        later = self.place > 0
        changes[self.row[later], (self.begin + self.fade // 2)[later]] = 1
        return changes.cumsum(axis=1)

    def shares(self) -> np.ndarray:
        """How much each frame of a crop counts, (crops, frames): those of two crops that meet add up to 1."""
        frame, fade = np.arange(int(self.frames.max())), self.fade[:, None]
        leave = np.append(np.where(self.place[1:] > 0, self.fade[1:], 0), 0)[:, None]
        come, go = (frame + 1) / (fade + 1), (self.frames[:, None] - frame) / (leave + 1)
        return np.minimum(come, go).clip(0, 1)

    def joined(
        self, crops: Float[Tensor, "crops frames features"], blended: Callable[[Tensor], Tensor]
    ) -> Float[Tensor, "rows _ features"]:
        """The rows, zeros after their ends. `blended` mends frames (any number, features) that are means of two."""
        if len(self.lengths) == len(self.row):
            return crops
        device, shares = crops.device, self.shares()
        crop, frame = np.nonzero(shares)
        inside = torch.from_numpy(shares[crop, frame]).to(crops)[:, None]
        length = int(self.lengths.max())
        place = self.row[crop] * length + self.begin[crop] + frame
        rows = crops.new_zeros(len(self.lengths) * length, crops.shape[2])
        chosen = crops[torch.from_numpy(crop).to(device), torch.from_numpy(frame).to(device)]
        rows = rows.index_add(0, torch.from_numpy(place).to(device), chosen * inside)
        mixed = torch.from_numpy(np.unique(place[shares[crop, frame] < 1])).to(device)
        return rows.index_copy(0, mixed, blended(rows[mixed])).unflatten(0, (len(self.lengths), length))
