"""Batches that oversample rare contents, and whose rows may be compositions."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Literal, get_args

import numpy as np

from stmc.settings.records import SettingError, setting
from stmc.training.data.batches import Draw, SplitClips
from stmc.training.data.cropped_rows import CropRecipe, Sources
from stmc.training.data.dataset import NULL, BatchPlan, Dataset

WHOLE_RECEIVERS = 1 / 3
"""Fraction of compositions that show the receiver's whole crop, with its own text."""
Receivers = Literal["walking", "any"]
"""Choice of the receivers of compositions: see `BalancedBatches.receivers`."""


@dataclass(frozen=True, kw_only=True)
class BalancedBatches(CropRecipe):
    """Draw contents with replacement, balanced by `balance`, and compose some rows with the bodies of others.

    The weight of a content is its number of clips to the power of `balance`, times its `emphasis`. A crop loses at most
    `trim` at either end. Crops without a text come from any clip of the split, in proportion to its length.

    A composition combines body parts of one row (the donor) with the body of another row (the receiver), like a
    collage. A network that has never seen an arm raised above walking legs would lower it in a collage. A row that does
    not claim the legs is a donor with probability `compose_prob`, other rows with `compose_legs_prob`. The receiver
    claims other parts and lasts at least as long. Two of three compositions last as long as the donor and have its
    text; the third is the receiver's whole crop with the receiver's text, and the donor at a random offset. If a
    composition shows the actions of both texts, it has with probability `joined_prob` a sentence about both, such as
    "walk while drinking", provided that the dataset has one.

    `pool` batches are drawn at once, sorted by length, and split into chunks of about equally many frames. A larger
    `pool` and more `pieces` mean less padding; more `pieces` also mean more different lengths, so more contents, in
    every batch.
    """

    balance: float | int = setting(0.4, "exponent of a content's number of clips: 1 as in the data, 0 uniform")
    emphasis: Mapping = setting({}, "factors on the probability of contents, such as {squat: 3}")
    compose_prob: float | int = setting(
        0.0, "probability that a row without legs becomes a donor", at_least=0, at_most=1
    )
    compose_legs_prob: float | int = setting(
        0.0, "probability that a row with legs becomes a donor", at_least=0, at_most=1
    )
    uncomposed: tuple[str, ...] = setting(
        (), "contents that are never composed, such as bows: their pelvis bends, too, but belongs to the legs"
    )
    joined_prob: float | int = setting(
        0.0, "probability that a composition has a sentence about both actions", at_least=0, at_most=1
    )
    receivers: Receivers = setting(
        "walking",
        "receivers of compositions: cyclic clips that claim only the legs, or any clip of other parts",
        choices=get_args(Receivers),
    )
    pool: int = setting(16, "number of batches that are drawn and sorted by length at once", at_least=1)
    pieces: int = setting(4, "number of chunks of a batch, each of similar lengths", at_least=1)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.pieces > self.rows:
            raise SettingError(f"pieces={self.pieces}: must be at most rows ({self.rows})")
        if wrong := {name: times for name, times in self.emphasis.items() if times < 0}:
            raise SettingError(f"emphasis={wrong}: factors must be at least 0")

    def check_pairs(self) -> None:
        """Raise the errors of every recipe, and `ValueError` for sentences about two contents."""
        super().check_pairs()
        if self.joined_prob:
            raise ValueError(f"pairs need texts of one content each: joined_prob ({self.joined_prob}) must be 0")

    @property
    def pooling(self) -> tuple[int, int]:
        """The number of batches that are drawn at once, and of chunks of each batch."""
        return self.pool, self.pieces

    def begin(self, clips: SplitClips, seed: int) -> Draw:
        """Prepare to draw.

        Raises `ValueError` if `emphasis` or `uncomposed` names unknown contents, or if no content is left to draw.
        """
        probabilities = self._probabilities(clips)

        def draw(number: int, process: int, rng: np.random.Generator) -> BatchPlan:
            clip = rng.choice(clips.described, self.rows * self.pool, p=probabilities)
            return self._compose(clips, self.draw_crops(clips, clip, rng), rng)

        return draw

    def _probabilities(self, clips: SplitClips) -> np.ndarray:
        """Return the probability of each clip with texts."""
        table = clips.dataset.clips
        names, inverse, counts = np.unique(
            [table[index].content for index in clips.described], return_inverse=True, return_counts=True
        )
        known = {clip.content for clip in table}
        for name, named in (("emphasis", self.emphasis), ("uncomposed", self.uncomposed)):
            if unknown := set(named) - known:
                choices = ", ".join(sorted(known))
                raise ValueError(f"{name}: unknown contents {sorted(unknown)}; choose from {choices}")
        emphasis = np.array([self.emphasis.get(name, 1.0) for name in names.tolist()])
        weight = emphasis[inverse] * counts[inverse] ** (self.balance - 1.0)
        if not weight.any():
            raise ValueError("emphasis: no content is left to draw")
        return weight / weight.sum()

    def _sources(self, clips: SplitClips, clip: np.ndarray, textless: np.ndarray, rng: np.random.Generator) -> Sources:
        by_time = clips.length[clips.all] / clips.length[clips.all].sum()
        clip = np.where(textless, rng.choice(clips.all, len(clip), p=by_time), clip)
        return clip, clips.start[clip], clips.length[clip]

    def _draw_losses(self, most: np.ndarray, u: np.ndarray) -> np.ndarray:
        return np.floor(u * (most + 1)).astype(int)

    def _compose(self, clips: SplitClips, plan: BatchPlan, rng: np.random.Generator) -> BatchPlan:
        """Compose some rows, as donors, with the bodies of others."""
        drawn, sentence, cyclic = plan.body, plan.sentence, clips.cyclic[plan.body.clip]
        receiver, whole, offset = self._receivers(clips, plan, rng)
        alone = receiver == np.arange(len(receiver))
        frames = np.where(whole, drawn.frames[receiver], drawn.frames)
        composed = replace(
            plan,
            body=replace(drawn[receiver], frames=frames),
            sentence=np.where(whole, sentence[receiver], sentence),
            donor=replace(drawn, frames=np.where(alone, 0, drawn.frames)),
            offset=offset,
            other=np.where(~whole & cyclic[receiver], sentence[receiver], sentence),
        )
        if not self.joined_prob:
            return composed
        texts = (sentence != NULL) & (sentence[receiver] != NULL)
        both = (composed.donor.frames > 0) & (whole | cyclic[receiver]) & texts
        return self._join(clips.dataset, composed, np.flatnonzero(both), rng)

    def _receivers(
        self, clips: SplitClips, plan: BatchPlan, rng: np.random.Generator
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Choose each row's receiver (itself: no composition), whether it is shown whole, and the donor's offset."""
        claims, legs, drawn = clips.dataset.claims[plan.body.clip], clips.dataset.legs, plan.body
        composed = np.where(claims[:, legs], self.compose_legs_prob, self.compose_prob)
        free = np.array([clips.dataset.clips[index].content not in self.uncomposed for index in drawn.clip.tolist()])
        moved = (rng.random(len(claims)) < composed) & claims.any(axis=1) & free
        walking = clips.cyclic[drawn.clip] & claims[:, legs] & (claims.sum(axis=1) == 1)
        carrying = (walking if self.receivers == "walking" else claims.any(axis=1)) & free
        receiver, whole = np.arange(len(claims)), np.zeros(len(claims), dtype=bool)
        offset = np.zeros(len(claims), dtype=int)
        for row in np.flatnonzero(moved):
            room = drawn.frames - drawn.frames[row]
            fitting = np.flatnonzero(carrying & ~claims[:, claims[row]].any(axis=1) & (room >= 0))
            if len(fitting):
                receiver[row] = rng.choice(fitting)
                whole[row] = rng.random() < WHOLE_RECEIVERS
                offset[row] = whole[row] * rng.integers(room[receiver[row]] + 1)
        return receiver, whole, offset

    def _join(self, dataset: Dataset, plan: BatchPlan, both: np.ndarray, rng: np.random.Generator) -> BatchPlan:
        """Give some of the rows `both`, which show two contents, a sentence about both."""
        sentence, other = plan.sentence.copy(), plan.other.copy()
        for row, (u, v) in zip(both.tolist(), rng.random((len(both), 2)).tolist(), strict=True):
            joined = dataset.joined_sentence(int(plan.body.clip[row]), int(plan.donor.clip[row]), v)
            if u < self.joined_prob and joined is not None:
                sentence[row] = other[row] = joined
        return replace(plan, sentence=sentence, other=other)
