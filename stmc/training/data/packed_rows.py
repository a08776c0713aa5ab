"""Rows of several texts, packed from balanced crops, for denoisers that know a text for every frame.

Knows a dataset and drawn crops; knows no features (see `joining` for how they become one motion) and no network.
FlowMDM is trained on rows of BABEL (Barquero et al. 2024; see `recorded_rows`); here a row is a recording that passes
from one clip to the next, or crops of any clips, put together where the poses fit.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from stmc.data.cache import TOUCHING, Clip
from stmc.settings.records import SettingError, setting
from stmc.training.data.balanced_batches import BalancedBatches
from stmc.training.data.batches import Draw, SplitClips
from stmc.training.data.dataset import NULL, BatchPlan, Crops, Dataset

FADE = 0.5
"""Seconds over which two crops of different recordings fade into one another."""

CANDIDATES = 32
"""Crops of which the one comes next whose pose is nearest."""

FARTHEST = 1.0
"""Distance of two poses, in standard deviations (root mean square over features), that are too unlike to be faded."""


@dataclass(frozen=True, kw_only=True)
class PackedRows(BalancedBatches):
    """Draw balanced crops, and put them into rows of several texts, for denoisers that know a text for every frame.

    A row has as many texts as `texts_per_row` says, or ends where no crop fits: see `Sequences`. `rows` counts crops.
    """

    texts_per_row: Sequence = setting((1, 4), "least and most texts of a row, two whole numbers from 1 on")
    several_texts: ClassVar[bool] = True

    def __post_init__(self) -> None:
        super().__post_init__()
        numbers = list(self.texts_per_row)
        whole = len(numbers) == 2 and all(isinstance(number, int) for number in numbers)
        if not whole or not 1 <= numbers[0] <= numbers[1] or numbers[1] < 2:
            raise SettingError(
                f"texts_per_row={numbers}: a least and a most number of texts needed, such as [1, 4]; "
                "rows of one text each are BalancedBatches"
            )

    def begin(self, clips: SplitClips, seed: int) -> Draw:
        """Prepare to draw, as `BalancedBatches`, and to pack."""
        (least, most), dataset = self.texts_per_row, clips.dataset
        longest = max(1, int(self.longest * dataset.fps))
        pack = Sequences(dataset, clips.chosen & dataset.described, least, most, longest)
        draw = super().begin(clips, seed)
        return lambda number, process, rng: pack(draw(number, process, rng), rng)


class Sequences:
    """Puts drawn crops into rows of `least` to `most` texts each, as far as there are crops that fit.

    Where a clip passes into another of its recording (see `following`; `chosen` may be drawn), that one comes next, but
    for what is beyond `longest` frames; else the one of `CANDIDATES` drawn crops of other contents that begins most
    nearly in the pose in which the last one ends. Rows with texts and rows without do not mix.
    """

    def __init__(self, dataset: Dataset, chosen: np.ndarray, least: int, most: int, longest: int) -> None:
        self.dataset, self.least, self.most, self.longest = dataset, least, most, longest
        self.fade, self.next = round(FADE * dataset.fps), following(dataset.clips, chosen, dataset.fps)
        self._start = np.array([clip.start for clip in dataset.clips])
        self._end = np.array([clip.end for clip in dataset.clips])
        _, self._content = np.unique([clip.content for clip in dataset.clips], return_inverse=True)

    def __call__(self, plan: BatchPlan, rng: np.random.Generator) -> BatchPlan:
        """`plan`, whose rows are one crop each, in rows of several; with the crops that recordings pass into."""
        drawn = len(plan.sentence)
        plan, after = self._passing(plan, rng)
        links = self._links(plan, after)
        links.free[drawn:] = False  # these come after their own alone
        rows = []
        for first in rng.permutation(drawn).tolist():
            if links.free[first]:
                rows.append(links.row(first, int(rng.integers(self.least, self.most + 1)), self.fade, rng))
        crops, fade = (np.concatenate([row[column] for row in rows]) for column in (0, 1))
        row = np.repeat(np.arange(len(rows)), [len(row[0]) for row in rows])
        return replace(plan[crops], row=row, fade=fade)

    def _passing(self, plan: BatchPlan, rng: np.random.Generator) -> tuple[BatchPlan, np.ndarray]:
        """The plan with the crops behind its own that these pass into, and of every crop the place of that one, or -1.

        A crop that passes into another lasts until that one begins, at the recording's own speed.
        """
        asked, after = np.flatnonzero((plan.sentence != NULL) & (plan.donor.frames == 0)), np.full(len(plan.row), -1)
        for number in range(1, self.most):
            next_clip = self.next[plan.body.clip[asked]]
            begin, change = plan.body.start[asked], self._start[next_clip]
            begin = np.maximum(begin, change - self.longest) if number == 1 else begin
            passing = (next_clip >= 0) & (change - begin > 2 * self.fade) & (change - begin <= self.longest)
            asked, next_clip, begin, change = (each[passing] for each in (asked, next_clip, begin, change))
            own, end = np.ones(len(asked)), self._end[next_clip]
            here = Crops(plan.body.clip[asked], begin, change, change - begin, own)
            there = Crops(next_clip, change, end, np.minimum(end - change, self.longest), own)
            sentence = self.dataset.sentences_of(next_clip, rng.random(len(asked)))
            plan, passed = _with_more(plan, asked, here, there, sentence), np.arange(len(asked)) + len(after)
            after[asked] = passed
            asked, after = passed, np.append(after, np.full(len(passed), -1))
        return plan, after

    def _links(self, plan: BatchPlan, after: np.ndarray) -> _Links:
        frames = plan.body.frames
        starts = self.dataset.poses(plan, np.minimum(self.fade // 2, frames - 1))
        ends = self.dataset.poses(plan, np.maximum(frames - 1 - self.fade // 2, 0))
        content = np.where(plan.sentence == NULL, -1, self._content[plan.body.clip])
        return _Links(after, starts, ends, content, frames > 2 * self.fade, np.ones(len(after), dtype=bool))


@dataclass(frozen=True)
class _Links:
    """What may come after what, crop by crop: the crop that it passes into (-1: none), the poses in which it begins and
    ends, its content (-1: it has no text), whether it is long enough to fade in and out, whether it is still free."""

    after: np.ndarray
    starts: np.ndarray
    ends: np.ndarray
    content: np.ndarray
    fits: np.ndarray
    free: np.ndarray

    def row(self, first: int, texts: int, fade: int, rng: np.random.Generator) -> tuple[list[int], list[int]]:
        """The crops of a row of at most so many texts, and over how many frames each fades in."""
        crops, fades = [first], [0]
        self.free[first] = False
        while len(crops) < texts:
            passed = self.after[crops[-1]]
            nearest = self._nearest(crops[-1], rng) if passed < 0 else -1
            if passed < 0 and nearest < 0:
                break
            crops.append(int(max(passed, nearest)))
            fades.append(0 if passed >= 0 else fade)
            self.free[crops[-1]] = False
        return crops, fades

    def _nearest(self, last: int, rng: np.random.Generator) -> int:
        silent, content = self.content[last] < 0, self.content
        fitting = content < 0 if silent else (content >= 0) & (content != content[last])
        free = np.flatnonzero(self.free & self.fits & fitting & self.fits[last])
        if not len(free):
            return -1
        candidates = rng.choice(free, min(CANDIDATES, len(free)), replace=False)
        distance = np.sqrt(np.square(self.starts[candidates] - self.ends[last]).mean(axis=1))
        return int(candidates[distance.argmin()]) if distance.min() <= FARTHEST else -1


def following(clips: Sequence[Clip], chosen: np.ndarray, fps: float | int) -> np.ndarray:
    """For every clip, which of the `chosen` ones its recording passes into, or -1: the one that begins nearest to its
    end, within `TOUCHING` seconds."""
    recordings: dict[str, list[int]] = {}
    for place in np.flatnonzero(chosen).tolist():
        if clips[place].recording:
            recordings.setdefault(clips[place].recording, []).append(place)
    found = np.full(len(clips), -1)
    for places in recordings.values():
        for place in places:
            clip = clips[place]
            later = [other for other in places if clips[other].start > clip.start and clips[other].end > clip.end]
            gaps = [abs(clips[other].start - clip.end) for other in later]
            if gaps and min(gaps) <= TOUCHING * fps:
                found[place] = later[gaps.index(min(gaps))]
    return found


def _with_more(plan: BatchPlan, places: np.ndarray, here: Crops, there: Crops, sentence: np.ndarray) -> BatchPlan:
    """The plan with the crops `here` at these places, and those `there` behind it, which are no compositions."""
    none = np.zeros(len(sentence), dtype=int)
    kept, body = np.setdiff1d(np.arange(len(plan.row)), places), plan.body
    order = np.argsort(np.concatenate([kept, places]))
    body = body[kept].followed_by(here)[order].followed_by(there)
    donor = plan.donor.followed_by(replace(there, frames=none))
    plain = (np.append(plan.sentence, sentence), donor, np.append(plan.offset, none), np.append(plan.other, sentence))
    return BatchPlan(body, *plain, np.arange(len(body.clip)), np.zeros(len(body.clip), dtype=int))
