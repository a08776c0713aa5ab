"""Rows that are one crop of one clip each: the settings of crops, and how a crop is cut.

Knows the clips of a split; knows not how clips are chosen, and no features.
"""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass

import numpy as np

from stmc.settings.records import SettingError, setting
from stmc.training.data.batches import Recipe, SplitClips
from stmc.training.data.dataset import NULL, BatchPlan, Crops

Sources = tuple[np.ndarray, np.ndarray, np.ndarray]
"""The clips that rows are cut from, the first frame that each may show, and the number of frames."""


@dataclass(frozen=True, kw_only=True)
class CropRecipe(Recipe):
    """The settings of recipes whose rows are crops of one clip each; seconds of the clips' own time.

    A cyclic clip still shows its action in any crop of at least `shortest`; of every other clip at most `trim` is lost.
    A clip that is `from_start` begins where it was recorded to begin and keeps its speed, and unless it is cyclic keeps
    its end, too.
    """

    shortest: float | int = setting(1.5, "shortest crop of a cyclic clip", unit="s", above=0)
    trim: float | int = setting(0.12, "share of a clip that is cut off at most", at_least=0, below=0.5)
    uncond_crop_prob: float | int = setting(
        0.12, "probability of a short crop without a text, as transitions are", at_least=0, at_most=1
    )
    crop_shortest: float | int = setting(0.5, "shortest crop without a text", unit="s", above=0)
    crop_longest: float | int = setting(3.0, "longest crop without a text", unit="s", above=0)
    from_start_prob: float | int = setting(
        0.0,
        "probability that a crop of a cyclic clip begins where the clip does: of few recordings, cut anywhere, a "
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
        """Raise `ValueError` as every recipe does, and for crops without a text."""
        super().check_pairs()
        if self.uncond_crop_prob:
            raise ValueError(f"pairs need texts: uncond_crop_prob ({self.uncond_crop_prob}) must be 0")

    @abstractmethod
    def _sources(self, clips: SplitClips, clip: np.ndarray, textless: np.ndarray, rng: np.random.Generator) -> Sources:
        """The stretches that rows are cut from, for the clips that were drawn."""

    @abstractmethod
    def _lost(self, most: np.ndarray, u: np.ndarray) -> np.ndarray:
        """The frames lost at the beginning and at the end, (2, rows), `most` being `trim` of each clip in frames, for
        `u` (2, rows) uniform in [0, 1)."""

    def draw_crops(self, clips: SplitClips, clip: np.ndarray, rng: np.random.Generator) -> BatchPlan:
        """Cut one row out of each of these clips, or in its place a crop without a text."""
        count = len(clip)
        dropped = rng.random(count) < self.text_dropout
        sentence = clips.dataset.sentences_of(clip, rng.random(count))
        textless = rng.random(count) < self.uncond_crop_prob
        body = self._cut(clips, self._sources(clips, clip, textless, rng), textless, rng)
        return BatchPlan.plain(body, np.where(textless | dropped, NULL, sentence), np.arange(count))

    def _cut(self, clips: SplitClips, sources: Sources, textless: np.ndarray, rng: np.random.Generator) -> Crops:
        (clip, begin, length), fps = sources, clips.dataset.fps
        lost = self._lost(np.floor(self.trim * length), rng.random((2, len(clip))))
        lost[:, clips.from_start[clip]] = 0
        low = np.where(textless, self.crop_shortest, self.shortest) * fps
        high = np.where(textless, self.crop_longest * fps, length)
        any_length = _between(np.clip(low, 1, length), np.clip(high, 1, length), rng.random(len(clip)))
        free = textless | clips.cyclic[clip]
        frames = np.where(free, any_length, length - lost.sum(axis=0))
        speed = np.exp(rng.uniform(np.log(self.slowest), np.log(self.fastest), len(clip)))
        speed = np.where(clips.from_start[clip] & ~textless, 1.0, speed)
        longest = max(1, int(self.longest * fps))
        frames_cut = np.minimum(frames, np.floor(longest * speed).astype(int).clip(1))
        room = np.where(free, length, frames) - frames_cut  # where a crop may begin
        room = np.where(self._begins(clips, clip, rng) & ~textless, 0, room)
        offset = _between(np.zeros(len(clip)), room, rng.random(len(clip))) + np.where(free, 0, lost[0])
        speed = np.minimum(speed, frames_cut)  # at least one frame is left
        # Neither the last pose nor the velocity after it may lie beyond the crop; 10 / 1.25 is 8, also in floats.
        shown = np.floor(np.minimum(frames_cut / speed, (frames_cut - 1) / speed + 1) + 1e-9).astype(int)
        return Crops(clip, begin + offset, begin + length, shown, speed)

    def _begins(self, clips: SplitClips, clip: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """Whether each crop begins where its clip does."""
        begins = clips.from_start[clip]
        if self.from_start_prob:
            begins = begins | (clips.cyclic[clip] & (rng.random(len(clip)) < self.from_start_prob))
        return begins


def _between(low: np.ndarray, high: np.ndarray, u: np.ndarray) -> np.ndarray:
    """Integers, uniform from `low` to `high`, both included, for `u` uniform in [0, 1)."""
    low, high = np.floor(low).astype(int), np.floor(high).astype(int)
    return low + np.floor(u * (np.maximum(high, low) - low + 1)).astype(int)
