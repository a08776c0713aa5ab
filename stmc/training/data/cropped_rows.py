"""Rows that are one crop of one clip each: their settings, and the cutting of crops."""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass

import numpy as np

from stmc.settings.records import SettingError, setting
from stmc.training.data.batches import Recipe, SplitClips
from stmc.training.data.dataset import NULL, BatchPlan, Crops

Sources = tuple[np.ndarray, np.ndarray, np.ndarray]
"""Clips to cut rows from, with the first frame and the number of frames that each row may show."""


@dataclass(frozen=True, kw_only=True)
class CropRecipe(Recipe):
    """Settings of recipes whose rows are crops of one clip each; times are those of the clips.

    A cyclic clip shows its action in any crop of at least `shortest`; other clips lose at most `trim`. A clip with
    `from_start` keeps its beginning and its speed, and also its end unless it is cyclic.
    """

    shortest: float | int = setting(1.5, "minimum length of crops of cyclic clips", unit="s", above=0)
    trim: float | int = setting(0.12, "maximum fraction of a clip to cut off", at_least=0, below=0.5)
    uncond_crop_prob: float | int = setting(
        0.12, "probability of a short crop without a text, like a transition", at_least=0, at_most=1
    )
    crop_shortest: float | int = setting(0.5, "minimum length of crops without a text", unit="s", above=0)
    crop_longest: float | int = setting(3.0, "maximum length of crops without a text", unit="s", above=0)
    from_start_prob: float | int = setting(
        0.0,
        "probability that a crop of a cyclic clip begins with the clip; given few recordings and arbitrary crops, a "
        "network learns the mean of all phases",
        at_least=0,
        at_most=1,
    )
    slowest: float | int = setting(1.0, "lowest speed, relative to the recording", above=0)
    fastest: float | int = setting(1.0, "highest speed, relative to the recording", above=0)

    def __post_init__(self) -> None:
        super().__post_init__()
        for low, high in (
            ("slowest", "fastest"),
            ("shortest", "longest"),
            ("crop_shortest", "crop_longest"),
            ("crop_longest", "longest"),
        ):
            if getattr(self, low) > getattr(self, high):
                raise SettingError(f"{low}={getattr(self, low)}: must be at most {high} ({getattr(self, high)})")

    def check_pairs(self) -> None:
        """Raise the errors of every recipe, and `ValueError` for crops without a text."""
        super().check_pairs()
        if self.uncond_crop_prob:
            raise ValueError(f"pairs need texts: uncond_crop_prob ({self.uncond_crop_prob}) must be 0")

    @abstractmethod
    def _sources(self, clips: SplitClips, clip: np.ndarray, textless: np.ndarray, rng: np.random.Generator) -> Sources:
        """Return the ranges to cut rows from, for the drawn clips."""

    @abstractmethod
    def _draw_losses(self, most: np.ndarray, u: np.ndarray) -> np.ndarray:
        """Return the frames lost at the beginning and the end, (2, rows).

        `most` is `trim` of each clip in frames; `u`, (2, rows), is uniform in [0, 1).
        """

    def draw_crops(self, clips: SplitClips, clip: np.ndarray, rng: np.random.Generator) -> BatchPlan:
        """Cut one row out of each clip, or a crop without a text instead."""
        count = len(clip)
        dropped = rng.random(count) < self.text_dropout
        sentence = clips.dataset.sentences_of(clip, rng.random(count))
        textless = rng.random(count) < self.uncond_crop_prob
        body = self._cut(clips, self._sources(clips, clip, textless, rng), textless, rng)
        return BatchPlan.plain(body, np.where(textless | dropped, NULL, sentence), np.arange(count))

    def _cut(self, clips: SplitClips, sources: Sources, textless: np.ndarray, rng: np.random.Generator) -> Crops:
        (clip, begin, length), fps = sources, clips.dataset.fps
        lost = self._draw_losses(np.floor(self.trim * length), rng.random((2, len(clip))))
        lost[:, clips.from_start[clip]] = 0
        low = np.where(textless, self.crop_shortest, self.shortest) * fps
        high = np.where(textless, self.crop_longest * fps, length)
        any_length = _scale_uniform(np.clip(low, 1, length), np.clip(high, 1, length), rng.random(len(clip)))
        free = textless | clips.cyclic[clip]
        frames = np.where(free, any_length, length - lost.sum(axis=0))
        speed = np.exp(rng.uniform(np.log(self.slowest), np.log(self.fastest), len(clip)))
        speed = np.where(clips.from_start[clip] & ~textless, 1.0, speed)
        longest = max(1, int(self.longest * fps))
        frames_cut = np.minimum(frames, np.floor(longest * speed).astype(int).clip(1))
        room = np.where(free, length, frames) - frames_cut  # range of offsets
        room = np.where(self._begins(clips, clip, rng) & ~textless, 0, room)
        offset = _scale_uniform(np.zeros(len(clip)), room, rng.random(len(clip))) + np.where(free, 0, lost[0])
        speed = np.minimum(speed, frames_cut)  # leaves at least one frame
        # Neither the last pose nor the velocity after it may lie beyond the crop; 10 / 1.25 is 8, also in floats.
        shown = np.floor(np.minimum(frames_cut / speed, (frames_cut - 1) / speed + 1) + 1e-9).astype(int)
        return Crops(clip, begin + offset, begin + length, shown, speed)

    def _begins(self, clips: SplitClips, clip: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """Return whether each crop begins with its clip."""
        begins = clips.from_start[clip]
        if self.from_start_prob:
            begins = begins | (clips.cyclic[clip] & (rng.random(len(clip)) < self.from_start_prob))
        return begins


def _scale_uniform(low: np.ndarray, high: np.ndarray, u: np.ndarray) -> np.ndarray:
    """Map `u`, uniform in [0, 1), to uniform integers from `low` to `high`, both included."""
    low, high = np.floor(low).astype(int), np.floor(high).astype(int)
    return low + np.floor(u * (np.maximum(high, low) - low + 1)).astype(int)
