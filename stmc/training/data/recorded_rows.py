"""Rows of several texts as recorded, for denoisers with a text for every frame.

FlowMDM is trained like this on BABEL (Barquero et al. 2024, section 4.1). This module knows clips, and that a content
is one recorded row; it knows no features and no network.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from stmc.settings.records import setting
from stmc.training.data.batches import Draw, Recipe, SplitClips
from stmc.training.data.dataset import NULL, BatchPlan, Crops, Dataset
from stmc.training.data.epoch_batches import Epochs


@dataclass(frozen=True, kw_only=True)
class RecordedRows(Recipe):
    """Draw every content once per epoch, shuffled, with all its clips, whole and in recorded order.

    Each clip has one of its texts, dropped independently with probability `text_dropout`. Clips are not cropped:
    `longest` only limits the motions of the trained model.
    """

    drop_last: bool = setting(False, "leave out the last batch of an epoch if it is smaller than the others")
    several_texts: ClassVar[bool] = True

    def begin(self, clips: SplitClips, seed: int) -> Draw:
        """Prepare the epochs."""
        dataset = clips.dataset
        epochs = Epochs(dataset.clips, clips.described, self.rows, [seed, clips.salt], self.drop_last)
        return lambda number, process, rng: plan_recorded(dataset, epochs(number, process), self.text_dropout, rng)


def plan_recorded(dataset: Dataset, drawn: np.ndarray, dropout: float | int, rng: np.random.Generator) -> BatchPlan:
    """Plan a row of each drawn clip's content.

    Args:
        dataset: Dataset of the clips.
        drawn: Indices of one clip of each content.
        dropout: Probability that a clip has no sentence.
        rng: Random generator.
    """
    places: dict[str, list[int]] = {}
    for place in np.flatnonzero(dataset.described).tolist():
        places.setdefault(dataset.clips[place].content, []).append(place)
    rows = [sorted(places[dataset.clips[place].content], key=lambda each: dataset.clips[each].start) for place in drawn]
    clip, row = np.concatenate(rows), np.repeat(np.arange(len(rows)), [len(each) for each in rows])
    start, end = (np.array([getattr(dataset.clips[place], side) for place in clip]) for side in ("start", "end"))
    sentence = dataset.sentences_of(clip, rng.random(len(clip)))
    sentence = np.where(rng.random(len(clip)) < dropout, NULL, sentence)
    return BatchPlan.plain(Crops(clip, start, end, end - start, np.ones(len(clip))), sentence, row)
