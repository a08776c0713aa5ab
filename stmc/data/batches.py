"""Batches to train on: trims of clips with one of their texts, drawn as a function of (seed, step, process).

Knows a dataset; knows no features and no network.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Literal, get_args

import numpy as np

from stmc.data.dataset import NULL, BatchPlan, Crops, Dataset
from stmc.training.loss import Batch

WHOLE_RECEIVERS = 1 / 3
"""The share of the compositions that are the receiver's whole crop, under its text."""


Receivers = Literal["walking", "any"]
"""Whose bodies compositions are put on: see `Sampling.compose_prob`."""


@dataclass(frozen=True)
class Sampling:
    """What a batch is made of; seconds, of the clips' own time.

    `rows` a batch on average, each content as often as its number of clips to the power of `balance` says (1: as in
    the data; 0: all alike). A clip whose content is cyclic is cut to any crop of at least `shortest`, the others
    lose at most `trim` of their length at either end; nothing is longer than `longest`. A share `uncond_crop_prob` of
    the rows is cut anywhere out of any clip, `crop_shortest` to `crop_longest`, and has no text: transitions. A share
    `text_dropout` of the others loses its text. Of the rows whose content claims no legs, a share `compose_prob` is put
    on the body of another row, as in a collage: an arm is raised while walking. With `receivers` "walking" its content
    is cyclic and claims legs alone; with "any" it claims other parts. Two of three last as long as the arm's clip and
    keep its text; the third is the whole walk, under its own text, and somewhere in it the arm is raised. (Networks
    that never saw an arm raised on walking legs lower it in a collage.) A share `compose_legs_prob` of the rows that do
    claim legs are legs under others' bodies, likewise: a man walks while he drinks.
    `slowest` and `fastest` bound the change of speed. `pool` batches are drawn at once and sorted by length into pieces
    of about as many frames each, `pieces` to a batch: more of either means less padding; more pieces also mean more
    lengths, so more contents, in every batch.
    """

    rows: int = 64
    balance: float = 0.4
    shortest: float = 1.5
    longest: float = 10.0
    trim: float = 0.12
    uncond_crop_prob: float = 0.12
    crop_shortest: float = 0.5
    crop_longest: float = 3.0
    text_dropout: float = 0.1
    compose_prob: float = 0.0
    compose_legs_prob: float = 0.0
    receivers: Receivers = "walking"
    slowest: float = 1.0
    fastest: float = 1.0
    pool: int = 16
    pieces: int = 4

    def __post_init__(self) -> None:
        if min(self.rows, self.pool, self.pieces) < 1 or self.pieces > self.rows:
            raise ValueError(
                f"rows {self.rows}, pool {self.pool}, pieces {self.pieces}: all at least 1, pieces <= rows"
            )
        shares = {
            name: getattr(self, name)
            for name in ("uncond_crop_prob", "text_dropout", "compose_prob", "compose_legs_prob")
        }
        if not (0 <= self.trim < 0.5 and all(0 <= share <= 1 for share in shares.values())):
            raise ValueError(f"trim {self.trim} must be in [0, 0.5), {shares} in [0, 1]")
        if self.receivers not in get_args(Receivers):
            raise ValueError(f"unknown receivers {self.receivers!r}; choose from {', '.join(get_args(Receivers))}")
        if not 0 < self.slowest <= self.fastest:
            raise ValueError(f"slowest {self.slowest} must be above 0 and at most fastest {self.fastest}")
        if not (0 < self.shortest <= self.longest and 0 < self.crop_shortest <= self.crop_longest <= self.longest):
            raise ValueError(f"lengths must rise from shortest to longest: {self}")


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
        self.shares = self._balance()
        self._pool: tuple[tuple[int, int], list[BatchPlan]] | None = None

    def _balance(self) -> np.ndarray:
        """The probability of each clip among those with texts."""
        contents = np.array([self.dataset.clips[index].content for index in self._described])
        _, inverse, counts = np.unique(contents, return_inverse=True, return_counts=True)
        weight = counts[inverse] ** (self.sampling.balance - 1.0)
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
        random = np.random.default_rng([self.seed, number, process, split])
        plan = self._compose(self._draw(sampling.rows * sampling.pool, random), random)
        order = np.argsort(plan.body.frames, kind="stable")
        pieces = _cut_evenly(plan.body.frames[order], sampling.pool * sampling.pieces)
        rows = [order[begin:end] for begin, end in pieces]
        return [plan[rows[index]] for index in random.permutation(len(rows))]

    def _compose(self, plan: BatchPlan, random: np.random.Generator) -> BatchPlan:
        """Puts some rows as donors on the bodies of others that last at least as long."""
        drawn, sentence = plan.body, plan.sentence
        claims = self.dataset.claims[drawn.clip]
        composed = np.where(claims[:, self.dataset.legs], self.sampling.compose_legs_prob, self.sampling.compose_prob)
        moved = (random.random(len(claims)) < composed) & claims.any(axis=1)
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
                receiver[row] = random.choice(receivers)
                whole[row] = random.random() < WHOLE_RECEIVERS
                offset[row] = whole[row] * random.integers(room[receiver[row]] + 1)
        frames = np.where(whole, drawn.frames[receiver], drawn.frames)
        donor = replace(drawn, frames=np.where(receiver == np.arange(len(receiver)), 0, drawn.frames))
        shown = np.where(whole, sentence[receiver], sentence)
        other = np.where(~whole & cyclic[receiver], sentence[receiver], sentence)
        return BatchPlan(replace(drawn[receiver], frames=frames), shown, donor, offset, other)

    def _draw(self, count: int, random: np.random.Generator) -> BatchPlan:
        """So many rows, without compositions."""
        sampling, fps = self.sampling, self.dataset.fps
        clip = random.choice(self._described, count, p=self.shares)
        dropped = random.random(count) < sampling.text_dropout
        chance = random.random(count)
        sentence = np.array([self.dataset.sentence(*pair) for pair in zip(clip.tolist(), chance.tolist(), strict=True)])
        is_crop = random.random(count) < sampling.uncond_crop_prob
        by_time = self._length[self._any] / self._length[self._any].sum()
        clip = np.where(is_crop, random.choice(self._any, count, p=by_time), clip)
        length, longest = self._length[clip], max(1, int(sampling.longest * fps))
        cut = np.floor(random.random((2, count)) * (np.floor(sampling.trim * length) + 1)).astype(int)
        low = np.where(is_crop, sampling.crop_shortest, sampling.shortest) * fps
        high = np.where(is_crop, sampling.crop_longest * fps, length)
        any_length = _between(np.clip(low, 1, length), np.clip(high, 1, length), random.random(count))
        free = is_crop | self._cyclic[clip]
        frames = np.where(free, any_length, length - cut.sum(axis=0))
        speed = np.exp(random.uniform(np.log(sampling.slowest), np.log(sampling.fastest), count))
        source = np.minimum(frames, np.floor(longest * speed).astype(int).clip(1))
        room = np.where(free, length, frames) - source  # where a crop may begin
        offset = _between(np.zeros(count), room, random.random(count)) + np.where(free, 0, cut[0])
        speed = np.minimum(speed, source)  # at least one frame is left
        begin = self._start[clip]
        sentence = np.where(is_crop | dropped, NULL, sentence)
        # Neither the last pose nor the velocity after it may lie beyond the crop; 10 / 1.25 is 8, also in floats.
        frames = np.floor(np.minimum(source / speed, (source - 1) / speed + 1) + 1e-9).astype(int)
        body, none = Crops(clip, begin + offset, begin + length, frames, speed), np.zeros(count, dtype=int)
        return BatchPlan(body, sentence, replace(body, frames=none), none, sentence)


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
