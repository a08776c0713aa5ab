"""Batches to train on: trims of clips with one of their texts, drawn as a function of (seed, step, process).

Knows a dataset; knows no features and no network.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Literal, get_args

import numpy as np

from stmc.training.data.dataset import NULL, BatchPlan, Crops, Dataset
from stmc.training.data.epochs import Epochs
from stmc.training.data.sequence_rows import Sequences, recorded
from stmc.training.loss import Batch

WHOLE_RECEIVERS = 1 / 3
"""The share of the compositions that are the receiver's whole crop, under its text."""


Receivers = Literal["walking", "any"]
"""Whose bodies compositions are put on: see `Sampling.compose_prob`."""

Order = Literal["balanced", "epochs", "rows"]
"""How rows come out of the data set: see `Sampling.order`."""

Trimmed = Literal["either_end", "in_all"]
"""What `Sampling.trim` is a bound of."""


@dataclass(frozen=True)
class Sampling:
    """What a batch is made of; seconds, of the clips' own time.

    `rows` a batch on average, each content as often as its number of clips to the power of `balance` says (1: as in the
    data; 0: all alike), and those of `emphasis` so many times as often. A clip whose content is cyclic is cut to any
    crop of at least `shortest`, the others lose at most `trim` of their length at either end; nothing is longer than
    `longest`. Of the cyclic crops a share `from_start_prob` begins where the clip does (where there are few clips, a
    network else takes the mean of their phases for the motion: arms that should circle stand still). Clips that are
    `from_start` always begin where they do and keep their speed, and the others of them lose nothing. A share
    `uncond_crop_prob` of the rows is cut anywhere out of any clip, `crop_shortest` to
    `crop_longest`, and has no text: transitions. A share `text_dropout` of the others loses its text. Of the rows whose
    content claims no legs, a share `compose_prob` is put on the body of another row, as in a collage: an arm is raised
    while walking. With `receivers` "walking" its content is cyclic and claims legs alone; with "any" it claims other
    parts. Two of three last as long as the arm's clip and keep its text; the third is the whole walk, under its own
    text, and somewhere in it the arm is raised. (Networks that never saw an arm raised on walking legs lower it in a
    collage.) A share `compose_legs_prob` of the rows that do claim legs are legs under others' bodies, likewise: a man
    walks while he drinks. Of the compositions that show what both texts say, a share `joined_prob` has a sentence about
    both instead ("walk while drinking"), as far as the dataset has one: what a whole text is asked of one network.
    With `trimmed` "in_all" the others lose at most `trim` at both ends together. With `order` "epochs" every content
    comes once an epoch, in shuffled batches (see `Epochs`), and a transition is cut out of the whole recording of the
    very clip that was drawn: for data sets whose every entry is a content of its own, as these are published.
    `drop_last`: an epoch's last batch is left out where it is smaller than the others.
    With `order` "rows" the contents come as in epochs, and a row is all clips of one whole, as they were recorded, each
    with its text, for denoisers that know a text for every frame; nothing else but `rows`, `drop_last` and
    `text_dropout` is then asked.
    `slowest` and `fastest` bound the change of speed. `pool` batches are drawn at once and sorted by length into pieces
    of about as many frames each, `pieces` to a batch: more of either means less padding; more pieces also mean more
    lengths, so more contents, in every batch.

    A row shows `texts_per_row` crops one after the other, at least and at most so many, for denoisers that know a text
    for every frame: then `rows` counts crops. See `Sequences` for which follow each other; where none fits, a row ends.
    """

    rows: int = 64
    balance: float = 0.4
    emphasis: Mapping[str, float | int] = field(default_factory=dict)
    shortest: float = 1.5
    longest: float = 10.0
    trim: float = 0.12
    trimmed: Trimmed = "either_end"
    order: Order = "balanced"
    drop_last: bool = False
    uncond_crop_prob: float = 0.12
    crop_shortest: float = 0.5
    crop_longest: float = 3.0
    text_dropout: float = 0.1
    compose_prob: float = 0.0
    compose_legs_prob: float = 0.0
    joined_prob: float = 0.0
    from_start_prob: float = 0.0
    receivers: Receivers = "walking"
    slowest: float = 1.0
    fastest: float = 1.0
    pool: int = 16
    pieces: int = 4
    texts_per_row: Sequence[int] = (1, 1)

    def __post_init__(self) -> None:
        if min(self.rows, self.pool, self.pieces) < 1 or self.pieces > self.rows:
            raise ValueError(
                f"rows {self.rows}, pool {self.pool}, pieces {self.pieces}: all at least 1, pieces <= rows"
            )
        shares = {
            name: getattr(self, name)
            for name in (
                "uncond_crop_prob",
                "text_dropout",
                "compose_prob",
                "compose_legs_prob",
                "joined_prob",
                "from_start_prob",
            )
        }
        if not (0 <= self.trim < 0.5 and all(0 <= share <= 1 for share in shares.values())):
            raise ValueError(f"trim {self.trim} must be in [0, 0.5), {shares} in [0, 1]")
        if wrong := {name: times for name, times in self.emphasis.items() if times < 0}:
            raise ValueError(f"emphasis {wrong}: a content is drawn at least 0 times as often")
        if len(self.texts_per_row) != 2 or not 1 <= self.texts_per_row[0] <= self.texts_per_row[1]:
            raise ValueError(f"texts_per_row {self.texts_per_row} must be two numbers, from 1 on, that do not fall")
        for name, choices in (("receivers", Receivers), ("order", Order), ("trimmed", Trimmed)):
            if getattr(self, name) not in get_args(choices):
                chosen = getattr(self, name)
                raise ValueError(f"unknown {name} {chosen!r}; choose from {', '.join(get_args(choices))}")
        if self.order != "balanced" and (self.pool, self.pieces) != (1, 1):
            raise ValueError(
                f"order {self.order} has batches as they come: pool {self.pool}, pieces {self.pieces} must be 1"
            )
        if not 0 < self.slowest <= self.fastest:
            raise ValueError(f"slowest {self.slowest} must be above 0 and at most fastest {self.fastest}")
        if not (0 < self.shortest <= self.longest and 0 < self.crop_shortest <= self.crop_longest <= self.longest):
            raise ValueError(f"lengths must rise from shortest to longest: {self}")

    @property
    def several_texts(self) -> bool:
        """Whether a row may have more texts than one."""
        return self.order == "rows" or self.texts_per_row[1] > 1


class ClipBatches:
    """`batches(step, process)`: the pieces of one step's batch, the same whenever they are asked for."""

    def __init__(self, dataset: Dataset, split: str, sampling: Sampling, seed: int = 0) -> None:
        self.dataset, self.sampling, self.seed, self.split = dataset, sampling, seed, split
        chosen = np.array([clip.split == split for clip in dataset.clips])
        self._any, self._described = np.flatnonzero(chosen), np.flatnonzero(chosen & dataset.described)
        if not len(self._described):
            raise ValueError(f"no clip of split {split!r} can be drawn; there are {len(dataset.clips)} clips in all")
        self._start = np.array([clip.start for clip in dataset.clips])
        self._length = np.array([clip.end - clip.start for clip in dataset.clips])
        self._cyclic = np.array([clip.cyclic for clip in dataset.clips])
        self._from_start = np.array([clip.from_start for clip in dataset.clips])
        around = np.array([clip.whole or (clip.start, clip.end) for clip in dataset.clips])
        self._recording = around[:, 0], around[:, 1] - around[:, 0]
        self._epochs = Epochs(
            dataset.clips, self._described, sampling.rows, [seed, sum(split.encode())], sampling.drop_last
        )
        self.shares = self._balance()
        self._sequences = self._in_sequence(chosen & dataset.described)
        self._pool: tuple[tuple[int, int], list[BatchPlan]] | None = None

    def _in_sequence(self, chosen: np.ndarray) -> Sequences | None:
        """How crops are put into rows of several; None where each is a row."""
        (least, most), dataset = self.sampling.texts_per_row, self.dataset
        if self.sampling.several_texts and dataset.words.max() > 1:
            asked = "order rows" if self.sampling.order == "rows" else f"texts_per_row {least} to {most}"
            raise ValueError(f"{asked} needs a text encoder that makes one word of a text")
        if most == 1:
            return None
        return Sequences(dataset, chosen, least, most, max(1, int(self.sampling.longest * dataset.fps)))

    def _balance(self) -> np.ndarray:
        """The probability of each clip among those with texts."""
        contents = np.array([self.dataset.clips[index].content for index in self._described])
        names, inverse, counts = np.unique(contents, return_inverse=True, return_counts=True)
        known = {clip.content for clip in self.dataset.clips}
        if unknown := set(self.sampling.emphasis) - known:
            raise ValueError(f"emphasis of {sorted(unknown)}: the data have {', '.join(sorted(known))}")
        emphasis = np.array([self.sampling.emphasis.get(name, 1.0) for name in names.tolist()])
        weight = emphasis[inverse] * counts[inverse] ** (self.sampling.balance - 1.0)
        if not weight.any():
            raise ValueError("emphasis: no content is left to be drawn")
        return weight / weight.sum()

    def __call__(self, step: int, process: int = 0) -> list[Batch]:
        return [self.dataset.batch(piece) for piece in self.plans(step, process)]

    def plans(self, step: int, process: int = 0) -> list[BatchPlan]:
        """What the pieces of a step's batch are made of."""
        sampling = self.sampling
        number, place = divmod(step, sampling.pool)
        if self._pool is None or self._pool[0] != (number, process):
            self._pool = (number, process), self._draw_pool(number, process)
        return self._pool[1][place * sampling.pieces : (place + 1) * sampling.pieces]

    def _draw_pool(self, number: int, process: int) -> list[BatchPlan]:
        sampling = self.sampling
        split = sum(self.split.encode())  # training and validation draw differently
        rng = np.random.default_rng([self.seed, number, process, split])
        plan = self._plan(self._chosen(number, process, rng), rng)
        frames = plan.arrangement.lengths
        order = np.argsort(frames, kind="stable")
        pieces = _cut_evenly(frames[order], sampling.pool * sampling.pieces)
        rows = [order[begin:end] for begin, end in pieces]
        return [plan.rows(rows[index]) for index in rng.permutation(len(rows))]

    def _plan(self, chosen: np.ndarray, rng: np.random.Generator) -> BatchPlan:
        if self.sampling.order == "rows":
            return recorded(self.dataset, chosen, self.sampling.text_dropout, rng)
        plan = self._compose(self._draw(chosen, rng), rng)
        return self._sequences(plan, rng) if self._sequences else plan

    def _compose(self, plan: BatchPlan, rng: np.random.Generator) -> BatchPlan:
        """Puts some rows as donors on the bodies of others that last at least as long."""
        drawn, sentence = plan.body, plan.sentence
        claims = self.dataset.claims[drawn.clip]
        composed = np.where(claims[:, self.dataset.legs], self.sampling.compose_legs_prob, self.sampling.compose_prob)
        moved = (rng.random(len(claims)) < composed) & claims.any(axis=1)
        cyclic = self._cyclic[drawn.clip]
        walking = cyclic & claims[:, self.dataset.legs] & (claims.sum(axis=1) == 1)
        others = claims.any(axis=1)
        receiver, whole = np.arange(len(claims)), np.zeros(len(claims), dtype=bool)
        offset = np.zeros(len(claims), dtype=int)
        for row in np.flatnonzero(moved):
            room = drawn.frames - drawn.frames[row]
            carrying = walking if self.sampling.receivers == "walking" else others
            receivers = np.flatnonzero(carrying & ~claims[:, claims[row]].any(axis=1) & (room >= 0))
            if len(receivers):
                receiver[row] = rng.choice(receivers)
                whole[row] = rng.random() < WHOLE_RECEIVERS
                offset[row] = whole[row] * rng.integers(room[receiver[row]] + 1)
        frames = np.where(whole, drawn.frames[receiver], drawn.frames)
        donor = replace(drawn, frames=np.where(receiver == np.arange(len(receiver)), 0, drawn.frames))
        shown = np.where(whole, sentence[receiver], sentence)
        other = np.where(~whole & cyclic[receiver], sentence[receiver], sentence)
        body = replace(drawn[receiver], frames=frames)
        both = (donor.frames > 0) & (whole | cyclic[receiver]) & (sentence != NULL) & (sentence[receiver] != NULL)
        composed = replace(plan, body=body, sentence=shown, donor=donor, offset=offset, other=other)
        return self._join(composed, np.flatnonzero(both), rng) if self.sampling.joined_prob else composed

    def _join(self, plan: BatchPlan, both: np.ndarray, rng: np.random.Generator) -> BatchPlan:
        """Gives some of the rows `both`, which show a body's and a donor's content, a sentence about the two."""
        sentence, other = plan.sentence.copy(), plan.other.copy()
        for row, (u, v) in zip(both.tolist(), rng.random((len(both), 2)).tolist(), strict=True):
            joined = self.dataset.joined_sentence(int(plan.body.clip[row]), int(plan.donor.clip[row]), v)
            if u < self.sampling.joined_prob and joined is not None:
                sentence[row] = other[row] = joined
        return replace(plan, sentence=sentence, other=other)

    def _chosen(self, number: int, process: int, rng: np.random.Generator) -> np.ndarray:
        """The clips of a pool's rows."""
        if self.sampling.order != "balanced":
            return self._epochs(number, process)
        return rng.choice(self._described, self.sampling.rows * self.sampling.pool, p=self.shares)

    def _draw(self, clip: np.ndarray, rng: np.random.Generator) -> BatchPlan:
        """A row of each of these clips, without compositions."""
        sampling, fps, count = self.sampling, self.dataset.fps, len(clip)
        dropped = rng.random(count) < sampling.text_dropout
        quantile = rng.random(count)
        sentence = np.array(
            [self.dataset.sentence(*pair) for pair in zip(clip.tolist(), quantile.tolist(), strict=True)]
        )
        is_crop = rng.random(count) < sampling.uncond_crop_prob
        clip, begin, length = self._sources(clip, is_crop, rng)
        longest = max(1, int(sampling.longest * fps))
        cut = _trimmed(np.floor(sampling.trim * length), rng.random((2, count)), sampling.trimmed)
        cut[:, self._from_start[clip]] = 0
        low = np.where(is_crop, sampling.crop_shortest, sampling.shortest) * fps
        high = np.where(is_crop, sampling.crop_longest * fps, length)
        any_length = _between(np.clip(low, 1, length), np.clip(high, 1, length), rng.random(count))
        free = is_crop | self._cyclic[clip]
        frames = np.where(free, any_length, length - cut.sum(axis=0))
        speed = np.exp(rng.uniform(np.log(sampling.slowest), np.log(sampling.fastest), count))
        speed = np.where(self._from_start[clip] & ~is_crop, 1.0, speed)
        source = np.minimum(frames, np.floor(longest * speed).astype(int).clip(1))
        room = np.where(free, length, frames) - source  # where a crop may begin
        begins = self._from_start[clip]
        if sampling.from_start_prob:
            begins = begins | (self._cyclic[clip] & (rng.random(count) < sampling.from_start_prob))
        room = np.where(begins & ~is_crop, 0, room)
        offset = _between(np.zeros(count), room, rng.random(count)) + np.where(free, 0, cut[0])
        speed = np.minimum(speed, source)  # at least one frame is left
        sentence = np.where(is_crop | dropped, NULL, sentence)
        # Neither the last pose nor the velocity after it may lie beyond the crop; 10 / 1.25 is 8, also in floats.
        frames = np.floor(np.minimum(source / speed, (source - 1) / speed + 1) + 1e-9).astype(int)
        body, none = Crops(clip, begin + offset, begin + length, frames, speed), np.zeros(count, dtype=int)
        return BatchPlan(body, sentence, replace(body, frames=none), none, sentence, np.arange(count), none)

    def _sources(
        self, clip: np.ndarray, is_crop: np.ndarray, rng: np.random.Generator
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """What rows are cut from: clips, their first frames, and how many frames there are. Crops without a text come
        from anywhere in the data, or in epochs from the whole recording of the clip that was drawn."""
        if self.sampling.order == "epochs":
            begin, length = (each[clip] for each in self._recording)
            return clip, np.where(is_crop, begin, self._start[clip]), np.where(is_crop, length, self._length[clip])
        by_time = self._length[self._any] / self._length[self._any].sum()
        clip = np.where(is_crop, rng.choice(self._any, len(clip), p=by_time), clip)
        return clip, self._start[clip], self._length[clip]


def _trimmed(most: np.ndarray, u: np.ndarray, trimmed: Trimmed) -> np.ndarray:
    """Frames that are lost at the beginning and at the end, for `u` uniform in [0, 1): so many `most` at either, or
    uniformly many in all, of which uniformly many at the beginning."""
    if trimmed == "either_end":
        return np.floor(u * (most + 1)).astype(int)
    lost = np.floor(u[0] * (most + 1))
    first = np.floor(u[1] * (lost + 1))
    return np.stack([first, lost - first]).astype(int)


def _between(low: np.ndarray, high: np.ndarray, u: np.ndarray) -> np.ndarray:
    """Integers, uniform from `low` to `high`, both included, for `u` uniform in [0, 1)."""
    low, high = np.floor(low).astype(int), np.floor(high).astype(int)
    return low + np.floor(u * (np.maximum(high, low) - low + 1)).astype(int)


def _cut_evenly(lengths: np.ndarray, pieces: int) -> list[tuple[int, int]]:
    """Cuts sorted `lengths` into `pieces` ranges of about the same sum, none of them empty."""
    total = np.cumsum(lengths)
    edges = np.searchsorted(total, total[-1] * np.arange(1, pieces) / pieces)
    for index in range(len(edges)):  # at least one row each, and enough left for the pieces that follow
        lowest = edges[index - 1] + 1 if index else 1
        edges[index] = min(max(edges[index], lowest), len(lengths) - (pieces - 1 - index))
    bounds = [0, *edges.tolist(), len(lengths)]
    return list(pairwise(bounds))
