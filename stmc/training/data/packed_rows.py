"""Rows of several texts, packed from balanced crops, for denoisers with a text for every frame.

FlowMDM is trained on rows of BABEL (Barquero et al. 2024; see `recorded_rows`). Here a row is a recording that passes
from one clip to the next, or a sequence of crops of any clips with matching poses. This module knows a dataset and
drawn crops; it knows no features (`joining` cross-fades them) and no network.
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
"""Length in seconds of the cross-fade between crops of different recordings."""
CANDIDATES = 32
"""Number of random crops from which the one with the nearest pose comes next."""
FARTHEST = 1.0
"""Maximum distance of two cross-faded poses, in standard deviations (root mean square over features)."""


@dataclass(frozen=True, kw_only=True)
class PackedRows(BalancedBatches):
    """Draw balanced crops and pack them into rows of several texts, for denoisers with a text for every frame.

    A row has `texts_per_row` texts, or fewer if no crop fits: see `Sequences`. `rows` counts crops.
    """

    texts_per_row: Sequence = setting((1, 4), "minimum and maximum number of texts of a row")
    several_texts: ClassVar[bool] = True

    def __post_init__(self) -> None:
        super().__post_init__()
        numbers = list(self.texts_per_row)
        whole = len(numbers) == 2 and all(isinstance(number, int) for number in numbers)
        if not whole or not 1 <= numbers[0] <= numbers[1] or numbers[1] < 2:
            raise SettingError(
                f"texts_per_row={numbers}: must be a minimum and a maximum number of texts, such as [1, 4]; "
                "for rows of one text use BalancedBatches"
            )

    def begin(self, clips: SplitClips, seed: int) -> Draw:
        """Prepare to draw, as in `BalancedBatches`, and to pack."""
        (least, most), dataset = self.texts_per_row, clips.dataset
        longest = max(1, int(self.longest * dataset.fps))
        pack = Sequences(dataset, clips.chosen & dataset.described, least, most, longest)
        draw = super().begin(clips, seed)
        return lambda number, process, rng: pack(draw(number, process, rng), rng)


class Sequences:
    """Packing of drawn crops into rows of several texts.

    If a clip passes into another one of its recording (see `following`), that one comes next, up to `longest` frames.
    Otherwise the next crop is the one of `CANDIDATES` crops of other contents whose first pose is nearest to the last
    pose. Crops with and without texts are not mixed.

    Args:
        dataset: Dataset of the crops.
        chosen: Mask of the clips that may be drawn.
        least: Minimum number of texts of a row, if enough crops fit.
        most: Maximum number of texts of a row.
        longest: Maximum number of frames of a crop.
    """

    def __init__(self, dataset: Dataset, chosen: np.ndarray, least: int, most: int, longest: int) -> None:
        self.dataset, self.least, self.most, self.longest = dataset, least, most, longest
        self.fade, self.next = round(FADE * dataset.fps), following(dataset.clips, chosen, dataset.fps)
        self._start = np.array([clip.start for clip in dataset.clips])
        self._end = np.array([clip.end for clip in dataset.clips])
        _, self._content = np.unique([clip.content for clip in dataset.clips], return_inverse=True)

    def __call__(self, plan: BatchPlan, rng: np.random.Generator) -> BatchPlan:
        """Pack a plan with one crop per row into rows of several, and add the crops that recordings pass into."""
        drawn = len(plan.sentence)
        plan, after = self._passing(plan, rng)
        links = self._links(plan, after)
        links.free[drawn:] = False  # added crops follow only their predecessors
        rows = []
        for first in rng.permutation(drawn).tolist():
            if links.free[first]:
                rows.append(links.row(first, int(rng.integers(self.least, self.most + 1)), self.fade, rng))
        crops, fade = (np.concatenate([row[column] for row in rows]) for column in (0, 1))
        row = np.repeat(np.arange(len(rows)), [len(row[0]) for row in rows])
        return replace(plan[crops], row=row, fade=fade)

    def _passing(self, plan: BatchPlan, rng: np.random.Generator) -> tuple[BatchPlan, np.ndarray]:
        """Append the crops that recordings pass into; return the plan and each crop's successor, or -1.

        A crop with a successor lasts until the successor begins, at the recording's own speed.
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
    """Possible successors of crops.

    For each crop: the successor in its recording `after` (-1: none), its first and last poses, its `content` (-1: no
    text), whether it is long enough to fade in and out (`fits`), and whether it is still `free`.
    """

    after: np.ndarray
    starts: np.ndarray
    ends: np.ndarray
    content: np.ndarray
    fits: np.ndarray
    free: np.ndarray

    def row(self, first: int, texts: int, fade: int, rng: np.random.Generator) -> tuple[list[int], list[int]]:
        """Return the crops of a row of at most `texts` texts, and the number of frames over which each fades in."""
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
    """Return for every clip the index of the clip that its recording passes into, or -1.

    That is the clip that begins nearest to its end, within `TOUCHING` seconds.

    Args:
        clips: Clips of the dataset.
        chosen: Mask of the clips that may follow.
        fps: Frames per second.
    """
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
    """Replace the crops at these places by `here` and append the crops `there`; none of them is a composition."""
    none = np.zeros(len(sentence), dtype=int)
    kept, body = np.setdiff1d(np.arange(len(plan.row)), places), plan.body
    order = np.argsort(np.concatenate([kept, places]))
    body = body[kept].concatenate(here)[order].concatenate(there)
    donor = plan.donor.concatenate(replace(there, frames=none))
    plain = (np.append(plan.sentence, sentence), donor, np.append(plan.offset, none), np.append(plan.other, sentence))
    return BatchPlan(body, *plain, np.arange(len(body.clip)), np.zeros(len(body.clip), dtype=int))
