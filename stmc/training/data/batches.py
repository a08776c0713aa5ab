"""Training batches, drawn by a recipe as a function of (seed, step, process)."""

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
            raise ValueError(f"no clip of split {split!r} has a text; there are {len(dataset.clips)} clips in all")
        self.start = np.array([clip.start for clip in dataset.clips])
        self.length = np.array([clip.end - clip.start for clip in dataset.clips])
        self.cyclic = np.array([clip.cyclic for clip in dataset.clips])
        self.from_start = np.array([clip.from_start for clip in dataset.clips])
        around = np.array([clip.whole or (clip.start, clip.end) for clip in dataset.clips])
        self.recording = around[:, 0], around[:, 1] - around[:, 0]  # first frames and lengths

    @property
    def salt(self) -> int:
        """A number derived from the split's name, so that training and validation draw differently."""
        return sum(self.split.encode())


Draw = Callable[[int, int, np.random.Generator], BatchPlan]
"""`draw(number, process, rng)` → the plan of one pool of batches."""


@dataclass(frozen=True, kw_only=True)
class Recipe(ABC):
    """Recipe for drawing the rows of batches, with its settings.

    Raises `SettingError` for an invalid value.
    """

    rows: int = setting(64, "average number of rows of a batch", at_least=1)
    longest: float | int = setting(
        10.0, "maximum length of crops, and of motions of the trained model", unit="s", above=0
    )
    text_dropout: float | int = setting(0.1, "probability that a text is dropped", at_least=0, at_most=1)

    several_texts: ClassVar[bool] = False
    """Whether a row may have several texts, so that the denoiser needs a text for every frame."""

    def __post_init__(self) -> None:
        check(self)

    @property
    def pooling(self) -> tuple[int, int]:
        """The number of batches that are drawn at once, and of chunks of similar lengths of each batch."""
        return 1, 1

    @abstractmethod
    def begin(self, clips: SplitClips, seed: int) -> Draw:
        """Prepare to draw from `clips`. Raises `ValueError` for settings that do not fit the clips."""

    def check_pairs(self) -> None:
        """Raise `ValueError` if a row may have no text or several; such rows are no pairs of motion and text."""
        if self.several_texts:
            raise ValueError(f"pairs need one text per row: {type(self).__name__} makes rows of several texts")
        if self.text_dropout:
            raise ValueError(f"pairs need texts: text_dropout ({self.text_dropout}) must be 0")


class ClipBatches:
    """Function `batches(step, process)` that returns the chunks of one step's batch, always the same.

    Raises `ValueError` if no clip of the split has a text, or if the recipe does not fit the dataset.

    Args:
        dataset: Dataset to draw from.
        split: Split to draw from, such as "train".
        recipe: Recipe of the rows.
        seed: Seed of the batches.
    """

    def __init__(self, dataset: Dataset, split: str, recipe: Recipe, seed: int = 0) -> None:
        if recipe.several_texts and dataset.words.max() > 1:
            raise ValueError(f"{type(recipe).__name__} needs a text encoder that returns one word per text")
        self.dataset, self.recipe, self.seed = dataset, recipe, seed
        clips = SplitClips(dataset, split)
        self._salt, self._draw = clips.salt, recipe.begin(clips, seed)
        self._pool: tuple[tuple[int, int], list[BatchPlan]] | None = None

    def __call__(self, step: int, process: int = 0) -> list[Batch]:
        return [self.dataset.batch(piece) for piece in self.plans(step, process)]

    def plans(self, step: int, process: int = 0) -> list[BatchPlan]:
        """Return the plans of the chunks of a step's batch."""
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
    """Split sorted `lengths` into `pieces` non-empty ranges of about equal sums."""
    total = np.cumsum(lengths)
    edges = np.searchsorted(total, total[-1] * np.arange(1, pieces) / pieces)
    for index in range(len(edges)):  # at least one row each, and enough rows for the chunks that follow
        lowest = edges[index - 1] + 1 if index else 1
        edges[index] = min(max(edges[index], lowest), len(lengths) - (pieces - 1 - index))
    bounds = [0, *edges.tolist(), len(lengths)]
    return list(pairwise(bounds))
