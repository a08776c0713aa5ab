"""Batches in epochs: every content once per epoch, shuffled, like PyTorch's `DataLoader`.

This module knows clips, and that a content is one entry of a data set; it knows no features and no network.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from stmc.data.cache import Clip
from stmc.settings.records import setting
from stmc.training.data.batches import Draw, SplitClips
from stmc.training.data.cropped_rows import CropRecipe, Sources


class Epochs:
    """Function `epochs(step, process)` that returns the indices in `clips` of one step's batch.

    Each process has its own epochs. If a content has several clips, one is drawn in proportion to its annotations.

    Args:
        clips: Clips of the dataset.
        chosen: Indices of the clips that may be drawn.
        rows: Number of rows of a batch.
        seed: Seed of the order.
        drop_last: Whether to leave out the smaller last batch of an epoch, unless it is the only one.
    """

    def __init__(
        self, clips: Sequence[Clip], chosen: np.ndarray, rows: int, seed: Sequence[int], drop_last: bool = False
    ) -> None:
        self.rows, self._seed = rows, tuple(seed)
        names = np.array([clips[index].content for index in chosen])
        contents, inverse = np.unique(names, return_inverse=True)
        order = np.argsort(inverse, kind="stable")
        self._clips = chosen[order]
        weights = np.array([clips[index].annotations for index in self._clips])
        self._last = np.cumsum(weights)  # cumulated annotations of the clips, content by content
        self._annotations = np.bincount(inverse[order], weights).astype(int)
        self._first = np.cumsum(self._annotations) - self._annotations
        self.batches = max(1, len(contents) // rows) if drop_last else -(-len(contents) // rows)
        self._shuffled: tuple[tuple[int, int], np.ndarray] | None = None

    def __call__(self, step: int, process: int = 0) -> np.ndarray:
        epoch, place = divmod(step, self.batches)
        contents = self._order(epoch, process)[place * self.rows : (place + 1) * self.rows]
        rng = np.random.default_rng([*self._seed, 1, process, step])
        annotation = self._first[contents] + rng.integers(self._annotations[contents])
        return self._clips[np.searchsorted(self._last, annotation, side="right")]

    def _order(self, epoch: int, process: int) -> np.ndarray:
        """Return the order of the contents in an epoch; the last result is cached."""
        if self._shuffled is None or self._shuffled[0] != (epoch, process):
            rng = np.random.default_rng([*self._seed, 0, process, epoch])
            self._shuffled = (epoch, process), rng.permutation(len(self._annotations))
        return self._shuffled[1]


@dataclass(frozen=True, kw_only=True)
class EpochBatches(CropRecipe):
    """Draw every content once per epoch, shuffled, for data sets in which every entry is its own content.

    MDM-SMPL and FlowMDM are trained like this on HumanML3D (STMC, appendix D). A clip loses at most `trim` in total. A
    crop without a text comes from the whole recording of the drawn clip. Batches are not sorted by length.
    """

    drop_last: bool = setting(False, "leave out the last batch of an epoch if it is smaller than the others")

    def begin(self, clips: SplitClips, seed: int) -> Draw:
        """Prepare the epochs."""
        epochs = Epochs(clips.dataset.clips, clips.described, self.rows, [seed, clips.salt], self.drop_last)
        return lambda number, process, rng: self.draw_crops(clips, epochs(number, process), rng)

    def _sources(self, clips: SplitClips, clip: np.ndarray, textless: np.ndarray, rng: np.random.Generator) -> Sources:
        begin, length = clips.recording
        return (
            clip,
            np.where(textless, begin[clip], clips.start[clip]),
            np.where(textless, length[clip], clips.length[clip]),
        )

    def _draw_losses(self, most: np.ndarray, u: np.ndarray) -> np.ndarray:
        lost = np.floor(u[0] * (most + 1))
        first = np.floor(u[1] * (lost + 1))
        return np.stack([first, lost - first]).astype(int)
