"""Batches to train on, drawn by a recipe as a function of (seed, step, process).

Knows a dataset and what all recipes share; knows no recipe, no features and no network.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from typing import ClassVar

import numpy as np

from stmc.settings.records import check, setting
from stmc.training.data.dataset import BatchPlan, Dataset
from stmc.training.loss import Batch


class SplitClips:
    """The clips of one split of a dataset: the indices of all and of those with texts, and the table as arrays.

    Raises `ValueError` if no clip of the split has a text.
    """

    def __init__(self, dataset: Dataset, split: str) -> None:
        self.dataset, self.split = dataset, split
        self.chosen = np.array([clip.split == split for clip in dataset.clips])
        self.all, self.described = np.flatnonzero(self.chosen), np.flatnonzero(self.chosen & dataset.described)
        if not len(self.described):
            raise ValueError(f"no clip of split {split!r} can be drawn; there are {len(dataset.clips)} clips in all")
        self.start = np.array([clip.start for clip in dataset.clips])
        self.length = np.array([clip.end - clip.start for clip in dataset.clips])
        self.cyclic = np.array([clip.cyclic for clip in dataset.clips])
        self.from_start = np.array([clip.from_start for clip in dataset.clips])
        around = np.array([clip.whole or (clip.start, clip.end) for clip in dataset.clips])
        self.recording = around[:, 0], around[:, 1] - around[:, 0]  # first frames and lengths

    @property
    def salt(self) -> int:
        """A number of the split's name: training and validation draw differently."""
        return sum(self.split.encode())


Draw = Callable[[int, int, np.random.Generator], BatchPlan]
"""`draw(number, process, rng)`: the plan of the rows of one pool of batches."""


@dataclass(frozen=True, kw_only=True)
class Recipe(ABC):
    """How the rows of batches are drawn. A recipe has the settings that it uses and no others.

    Raises `SettingError` for a value that does not fit.
    """

    rows: int = setting(64, "rows of a batch, on average", at_least=1)
    longest: float | int = setting(10.0, "longest crop, and longest motion of the trained model", unit="s", above=0)
    text_dropout: float | int = setting(0.1, "probability that a text is dropped", at_least=0, at_most=1)

    several_texts: ClassVar[bool] = False
    """Whether a row may have more texts than one, so that a denoiser needs a text for every frame."""

    def __post_init__(self) -> None:
        check(self)

    @property
    def pooling(self) -> tuple[int, int]:
        """The batches that are drawn at once, and the pieces of similar length that each batch has."""
        return 1, 1

    @abstractmethod
    def begin(self, clips: SplitClips, seed: int) -> Draw:
        """Prepare to draw from `clips`. Raises `ValueError` for settings that do not fit these."""

    def check_pairs(self) -> None:
        """Raise `ValueError` if a row may lack a text or have several: such rows make no pairs of motion and text."""
        if self.several_texts:
            raise ValueError(f"pairs are of one text each: {type(self).__name__} makes rows of several")
        if self.text_dropout:
            raise ValueError(f"pairs need texts: text_dropout ({self.text_dropout}) must be 0")


class ClipBatches:
    """`batches(step, process)`: the pieces of one step's batch, the same whenever they are asked for.

    Raises `ValueError` if no clip of the split has a text, and if the recipe does not fit the dataset.
    """

    def __init__(self, dataset: Dataset, split: str, recipe: Recipe, seed: int = 0) -> None:
        if recipe.several_texts and dataset.words.max() > 1:
            raise ValueError(f"{type(recipe).__name__} needs a text encoder that makes one word of a text")
        self.dataset, self.recipe, self.seed = dataset, recipe, seed
        clips = SplitClips(dataset, split)
        self._salt, self._draw = clips.salt, recipe.begin(clips, seed)
        self._pool: tuple[tuple[int, int], list[BatchPlan]] | None = None

    def __call__(self, step: int, process: int = 0) -> list[Batch]:
        return [self.dataset.batch(piece) for piece in self.plans(step, process)]

    def plans(self, step: int, process: int = 0) -> list[BatchPlan]:
        """The plans of the pieces of a step's batch."""
        pool, pieces = self.recipe.pooling
        number, place = divmod(step, pool)
        if self._pool is None or self._pool[0] != (number, process):
            self._pool = (number, process), self._draw_pool(number, process)
        return self._pool[1][place * pieces : (place + 1) * pieces]

    def _draw_pool(self, number: int, process: int) -> list[BatchPlan]:
        rng = np.random.default_rng([self.seed, number, process, self._salt])
        plan = self._draw(number, process, rng)
        frames = plan.arrangement.lengths
        order = np.argsort(frames, kind="stable")
        pool, pieces = self.recipe.pooling
        rows = [order[begin:end] for begin, end in _cut_evenly(frames[order], pool * pieces)]
        return [plan.rows(rows[index]) for index in rng.permutation(len(rows))]


def _cut_evenly(lengths: np.ndarray, pieces: int) -> list[tuple[int, int]]:
    """Cuts sorted `lengths` into `pieces` ranges of about the same sum, none of them empty."""
    total = np.cumsum(lengths)
    edges = np.searchsorted(total, total[-1] * np.arange(1, pieces) / pieces)
    for index in range(len(edges)):  # at least one row each, and enough left for the pieces that follow
        lowest = edges[index - 1] + 1 if index else 1
        edges[index] = min(max(edges[index], lowest), len(lengths) - (pieces - 1 - index))
    bounds = [0, *edges.tolist(), len(lengths)]
    return list(pairwise(bounds))
