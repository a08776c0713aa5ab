"""Packing of crops into the rows of a batch, with cross-fades between them."""

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
    """Positions of crops in rows. The two cross-fades of a crop never overlap.

    Args:
        row: Row of each crop, ascending from 0 without gaps.
        frames: Number of frames of each crop.
        fade: Number of frames that each crop shares with its predecessor in the row; 0 for the first.
    """

    row: np.ndarray
    frames: np.ndarray
    fade: np.ndarray

    @cached_property
    def begin(self) -> np.ndarray:
        """The first frame of each crop in its row."""
        own = self.frames - self.fade
        ends = np.cumsum(own)
        return ends - own - (ends - own)[self.first][self.row] - self.fade

    @cached_property
    def first(self) -> np.ndarray:
        """The index of each row's first crop."""
        return np.flatnonzero(np.diff(self.row, prepend=-1))

    @cached_property
    def place(self) -> np.ndarray:
        """The index of each crop within its row."""
        return np.arange(len(self.row)) - self.first[self.row]

    @cached_property
    def lengths(self) -> np.ndarray:
        """The number of frames of each row."""
        last = np.append(self.first[1:], len(self.row)) - 1
        return (self.begin + self.frames)[last]

    def segments(self) -> np.ndarray:
        """Return the index within its row of each frame's crop, (rows, frames).

        The boundary is in the middle of a cross-fade. Frames after a row's end belong to its last crop.
        """
        changes = np.zeros((len(self.lengths), int(self.lengths.max())), dtype=int)
        later = self.place > 0
        changes[self.row[later], (self.begin + self.fade // 2)[later]] = 1
        return changes.cumsum(axis=1)

    def shares(self) -> np.ndarray:
        """Return the weight of each frame of a crop, (crops, frames); weights of overlapping crops sum to 1."""
        frame, fade = np.arange(int(self.frames.max())), self.fade[:, None]
        leave = np.append(np.where(self.place[1:] > 0, self.fade[1:], 0), 0)[:, None]
        come, go = (frame + 1) / (fade + 1), (self.frames[:, None] - frame) / (leave + 1)
        return np.minimum(come, go).clip(0, 1)

    def cross_fade(
        self, crops: Float[Tensor, "crops frames features"], blended: Callable[[Tensor], Tensor]
    ) -> Float[Tensor, "rows _ features"]:
        """Cross-fade crops into rows, with zeros after their ends.

        `blended` corrects frames, (any number, features), that are means of two.
        """
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
