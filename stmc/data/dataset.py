"""Batches to train on: trims of clips with one of their texts, drawn as a function of (seed, step, process).

Knows prepared caches and layouts; knows no particular data set, no body and no network.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Literal, get_args

import numpy as np
import torch
from einops import rearrange
from jaxtyping import Float
from torch import Tensor

from stmc import tensors
from stmc.body import BodyPart
from stmc.data.cache import Cache
from stmc.geometry import matrix_to_rows, rows_to_matrix
from stmc.representation.layout import Layout
from stmc.statistics import Statistics
from stmc.text import TextEncoder
from stmc.training.loss import Batch

NULL = 0
"""The empty text's place among the sentences: what the network gets for "no text"."""

SEAM = 6
"""Frames over which a composition's guest comes and goes within a row."""

FLOOR = 1e-3
"""What a feature of no field's own floor, or a number of a word, is divided by at least."""

WHOLE_HOSTS = 1 / 3
"""The share of the compositions that are the host's whole stretch, under its text."""


Hosts = Literal["walking", "any"]
"""Whose bodies compositions are put on: see `Sampling.composed`."""


class Corpus:
    """A cache and its texts, normalised and ready to draw from, on one device.

    `motion` are the statistics that come with the cache, or those over the training clips; `text` those over their
    sentences' words, unless they are given; `skeleton` is the cache's, if it has its own. Features that vary by less
    than their field's `floor` are divided by it: what hardly varies in most clips may in some. What is more than
    `limit` standard deviations from the mean is put there. Contents with fewer than `least` training clips have no
    texts: one clip of several actions teaches no word.
    Raises `ValueError` where the layout is not the cache's or nothing is left to train on.
    """

    def __init__(
        self,
        cache: Cache,
        encoder: TextEncoder,
        layout: Layout,
        floor: Mapping[str, float] | None = None,
        least: int = 5,
        limit: float = math.inf,
        text: Statistics | None = None,
        device: torch.device | str = "cpu",
    ) -> None:
        if cache.features.shape[1] != layout.width:
            raise ValueError(f"the cache has {cache.features.shape[1]} features, the layout {layout.width}")
        self.fps, self.layout, self.clips, self.skeleton = cache.fps, layout, cache.clips, cache.skeleton
        counts: dict[str, int] = {}
        for clip in cache.clips:
            counts[clip.content] = counts.get(clip.content, 0) + (clip.split == "train")
        self.described = np.array(
            [counts[clip.content] >= least and any(cache.texts[clip.texts]) for clip in cache.clips]
        )
        training = [clip for clip in cache.clips if clip.split == "train"]
        if not training or not self.described.any():
            raise ValueError(f"no content has {least} training clips among the {len(cache.clips)} clips of the cache")
        parts = list(layout.columns)
        self.claims = np.array([[part in clip.parts for part in parts] for clip in cache.clips], dtype=bool)
        owned = torch.zeros(len(parts), layout.width, dtype=torch.bool)
        for row, part in enumerate(parts):
            owned[row, list(layout.columns[part])] = True
        self.legs, self._owned = parts.index(BodyPart.LEGS), owned.to(device)
        self.features = cache.features.to(device)
        frames = torch.cat([torch.arange(clip.start, clip.end) for clip in training])
        floors = torch.tensor(layout.filled(floor or {}, FLOOR))
        self.motion, self._limit = (cache.statistics or Statistics.of(cache.features[frames], floors)).to(device), limit
        self._embed(cache, encoder, text, device)
        # Summed velocities, to change the speed of a clip without losing distance; float64, since it sums hours.
        self.velocity = [c for name, s in layout.slices.items() if "velocit" in name for c in range(s.start, s.stop)]
        travelled = self.features[:, self.velocity].double().cumsum(dim=0)
        self._travelled = torch.cat([torch.zeros_like(travelled[:1]), travelled])

    def _embed(self, cache: Cache, encoder: TextEncoder, text: Statistics | None, device: torch.device | str) -> None:
        keys = {clip.texts for clip, known in zip(cache.clips, self.described, strict=True) if known}
        self.sentences = ["", *sorted({text for key in keys for text, _ in cache.texts[key]} - {""})]
        words, lengths = encoder.encode(self.sentences)
        self.words = lengths.cpu().numpy()
        exists = tensors.mask(lengths, words.shape[1])
        trained = {clip.texts for clip in cache.clips if clip.split == "train"} & keys
        said = {text for key in trained for text, _ in cache.texts[key]}
        rows = torch.tensor([text in said for text in self.sentences], device=words.device)
        self.text = (text or Statistics.of(words[exists & rows[:, None]].float(), FLOOR)).to(device)
        self._text = torch.where(exists[..., None].to(device), self.text.normalise(words.to(device).float()), 0.0)
        place = {text: index for index, text in enumerate(self.sentences)}
        self.choices = {
            key: (
                np.array([place[text] for text, _ in cache.texts[key]]),
                np.cumsum([share for _, share in cache.texts[key]]),
            )
            for key in keys
        }

    @property
    def features_width(self) -> int:
        """Numbers per frame."""
        return self.features.shape[1]

    @property
    def text_width(self) -> int:
        """Numbers per word."""
        return self._text.shape[2]

    def sentence(self, clip: int, u: float) -> int:
        """The place of the sentence of a clip that `u` in [0, 1) chooses, by the sentences' probabilities."""
        if not self.described[clip]:
            return NULL
        places, cumulated = self.choices[self.clips[clip].texts]
        return int(places[min(np.searchsorted(cumulated, u, side="right"), len(places) - 1)])

    def batch(self, draws: Draws) -> Batch:
        """The motion and the texts of `draws`, padded to the longest of each."""
        frames, words = draws.body.frames, self.words[draws.sentence]
        device = self.features.device
        lengths = torch.from_numpy(frames).to(device)
        text_lengths = torch.from_numpy(words).to(device)
        mask = None if (frames == frames.max()).all() else tensors.mask(lengths, int(frames.max()))
        text_mask = None if (words == words.max()).all() else tensors.mask(text_lengths, int(words.max()))
        motion = self.motion.normalise(self._composed(self._cut(draws.body), draws)).clamp(-self._limit, self._limit)
        if mask is not None:
            motion = torch.where(mask[..., None], motion, 0.0)
        text = self._text[torch.from_numpy(draws.sentence).to(device)][:, : int(words.max())]
        return Batch(motion, mask, text, text_mask, int(frames.sum()))

    def _composed(self, motion: Float[Tensor, "batch frames features"], draws: Draws) -> Tensor:
        """Each row with its guest, if it has one, in the columns of the parts that the guest claims."""
        rows = np.flatnonzero(draws.guest.frames)
        if not len(rows):
            return motion
        guest, device = draws.guest[rows], motion.device
        moved, offset = self._cut(guest), draws.offset[rows]
        frame = np.arange(motion.shape[1])[None] - offset[:, None]  # of the guest
        share = torch.from_numpy(_shares(frame, guest.frames, offset, draws.body.frames[rows])).to(device)
        inside = torch.from_numpy(frame.clip(0, moved.shape[1] - 1)).to(device)
        moved = moved.gather(1, inside[..., None].expand(-1, -1, moved.shape[2]))
        claimed = torch.from_numpy(self.claims[guest.clip]).to(device)
        owned = (claimed[:, :, None] & self._owned).any(dim=1)
        chosen = torch.from_numpy(rows).to(device)
        blended = torch.lerp(motion[chosen], moved, share[..., None] * owned[:, None])
        return motion.index_copy(0, chosen, self._rotating(blended))

    def _cut(self, stretches: Stretches) -> Float[Tensor, "batch frames features"]:
        """Raw features; frames after a row's end repeat its last one."""
        device = self.features.device
        bounds = (stretches.start, stretches.end, stretches.frames - 1)
        start, end, last = (torch.from_numpy(bound).to(device)[:, None] for bound in bounds)
        frame = torch.arange(int(stretches.frames.max()), device=device)
        if (stretches.speed == 1).all():
            return self.features[start + torch.minimum(frame, last)]
        speed = torch.from_numpy(stretches.speed).to(device)[:, None]
        position = torch.minimum(frame, last) * speed
        before = (start + position.long()).clamp(max=end - 1)
        share = (position - position.floor())[..., None].float()
        raw = torch.lerp(self.features[before], self.features[(before + 1).clamp(max=end - 1)], share)
        raw[..., self.velocity] = (self._gone(start, position + speed) - self._gone(start, position)).float()
        return self._rotating(raw)

    def _rotating(self, raw: Float[Tensor, "batch frames features"]) -> Tensor:
        """`raw` after blending in place: with rotations again."""
        rows = rearrange(raw[..., self.layout["rotations"]], "... (joints six) -> ... joints six", six=6)
        rotations = matrix_to_rows(rows_to_matrix(rows))
        raw[..., self.layout["rotations"]] = rearrange(rotations, "... joints six -> ... (joints six)")
        return raw

    def _gone(self, start: Tensor, position: Tensor) -> Tensor:
        """Summed velocity from the first frame of all to `position` (float, in frames) after `start`."""
        whole = start + position.long()
        after = (whole + 1).clamp(max=len(self._travelled) - 1)
        return torch.lerp(self._travelled[whole], self._travelled[after], (position - position.floor())[..., None])


@dataclass(frozen=True)
class Stretches:
    """Of clips: `frames` frames each from frame `start` of all features on, at `speed` source frames a frame, none at
    or after `end` (where the clip ends)."""

    clip: np.ndarray
    start: np.ndarray
    end: np.ndarray
    frames: np.ndarray
    speed: np.ndarray

    def __getitem__(self, rows: np.ndarray) -> Stretches:
        return Stretches(*(getattr(self, name)[rows] for name in self.__dataclass_fields__))


@dataclass(frozen=True)
class Draws:
    """Rows to be: the stretch that each is, and the place of its sentence; for a composition the `guest` whose claimed
    parts it takes over from its frame `offset` on (else a stretch of no frames), and the sentence of the `other` of the
    two where the row shows it, too (else the row's own): see `Sampling.composed`."""

    body: Stretches
    sentence: np.ndarray
    guest: Stretches
    offset: np.ndarray
    other: np.ndarray

    def __getitem__(self, rows: np.ndarray) -> Draws:
        return Draws(self.body[rows], self.sentence[rows], self.guest[rows], self.offset[rows], self.other[rows])


@dataclass(frozen=True)
class Sampling:
    """What a batch is made of; seconds, of the clips' own time.

    `rows` a batch on average, each content as often as its number of clips to the power of `balance` says (1: as in
    the data; 0: all alike). A clip whose content is cyclic is cut to any stretch of at least `shortest`, the others
    lose at most `trim` of their length at either end; nothing is longer than `longest`. A share `crops` of the rows is
    cut anywhere out of any clip, `crop_shortest` to `crop_longest`, and has no text: transitions. A share `silent` of
    the others loses its text. Of the rows whose content claims no legs, a share `composed` is put on the body of
    another row, as in a collage: an arm is raised while walking. With `hosts` "walking" its content is cyclic and
    claims legs alone; with "any" it claims other parts. Two of three last as long as the arm's clip and keep its text;
    the third is the whole walk, under its own text, and somewhere in it the arm is raised. (Networks that never saw an
    arm raised on walking legs lower it in a collage.) A share `composed_legs` of the rows that do claim legs are legs
    under others' bodies, likewise: a man walks while he drinks.
    `slowest` and `fastest` bound the change of speed. `pool` batches are drawn at once and sorted by length into pieces
    of about as many frames each, `pieces` to a batch: more of either means less padding; more pieces also mean more
    lengths, so more contents, in every batch.
    """

    rows: int = 64
    balance: float = 0.4
    shortest: float = 1.5
    longest: float = 10.0
    trim: float = 0.12
    crops: float = 0.12
    crop_shortest: float = 0.5
    crop_longest: float = 3.0
    silent: float = 0.1
    composed: float = 0.0
    composed_legs: float = 0.0
    hosts: Hosts = "walking"
    slowest: float = 1.0
    fastest: float = 1.0
    pool: int = 16
    pieces: int = 4

    def __post_init__(self) -> None:
        if min(self.rows, self.pool, self.pieces) < 1 or self.pieces > self.rows:
            raise ValueError(
                f"rows {self.rows}, pool {self.pool}, pieces {self.pieces}: all at least 1, pieces <= rows"
            )
        shares = {name: getattr(self, name) for name in ("crops", "silent", "composed", "composed_legs")}
        if not (0 <= self.trim < 0.5 and all(0 <= share <= 1 for share in shares.values())):
            raise ValueError(f"trim {self.trim} must be in [0, 0.5), {shares} in [0, 1]")
        if self.hosts not in get_args(Hosts):
            raise ValueError(f"unknown hosts {self.hosts!r}; choose from {', '.join(get_args(Hosts))}")
        if not 0 < self.slowest <= self.fastest:
            raise ValueError(f"slowest {self.slowest} must be above 0 and at most fastest {self.fastest}")
        if not (0 < self.shortest <= self.longest and 0 < self.crop_shortest <= self.crop_longest <= self.longest):
            raise ValueError(f"lengths must rise from shortest to longest: {self}")


class ClipBatches:
    """`batches(step, process)`: the pieces of one step's batch, the same whenever they are asked for."""

    def __init__(self, corpus: Corpus, split: str, sampling: Sampling, seed: int = 0) -> None:
        self.corpus, self.sampling, self.seed, self.split = corpus, sampling, seed, split
        chosen = np.array([clip.split == split for clip in corpus.clips])
        self._any, self._described = np.flatnonzero(chosen), np.flatnonzero(chosen & corpus.described)
        if not len(self._described):
            raise ValueError(f"no clip of split {split!r} can be drawn; there are {len(corpus.clips)} clips in all")
        self._start = np.array([clip.start for clip in corpus.clips])
        self._length = np.array([clip.end - clip.start for clip in corpus.clips])
        self._cyclic = np.array([clip.cyclic for clip in corpus.clips])
        self.shares = self._balance()
        self._pool: tuple[tuple[int, int], list[Draws]] | None = None

    def _balance(self) -> np.ndarray:
        """The probability of each clip among those with texts."""
        contents = np.array([self.corpus.clips[index].content for index in self._described])
        _, inverse, counts = np.unique(contents, return_inverse=True, return_counts=True)
        weight = counts[inverse] ** (self.sampling.balance - 1.0)
        return weight / weight.sum()

    def __call__(self, step: int, process: int = 0) -> list[Batch]:
        return [self.corpus.batch(piece) for piece in self.draws(step, process)]

    def draws(self, step: int, process: int = 0) -> list[Draws]:
        """What the pieces of a step's batch are made of."""
        sampling = self.sampling
        number, place = divmod(step, sampling.pool)
        if self._pool is None or self._pool[0] != (number, process):
            self._pool = (number, process), self._draw_pool(number, process)
        return self._pool[1][place * sampling.pieces : (place + 1) * sampling.pieces]

    def _draw_pool(self, number: int, process: int) -> list[Draws]:
        sampling = self.sampling
        split = sum(self.split.encode())  # training and validation draw differently
        random = np.random.default_rng([self.seed, number, process, split])
        draws = self._compose(self._draw(sampling.rows * sampling.pool, random), random)
        order = np.argsort(draws.body.frames, kind="stable")
        pieces = _cut_evenly(draws.body.frames[order], sampling.pool * sampling.pieces)
        rows = [order[begin:end] for begin, end in pieces]
        return [draws[rows[index]] for index in random.permutation(len(rows))]

    def _compose(self, draws: Draws, random: np.random.Generator) -> Draws:
        """Makes some rows guests on the bodies of others that last at least as long."""
        drawn, sentence = draws.body, draws.sentence
        claims = self.corpus.claims[drawn.clip]
        composed = np.where(claims[:, self.corpus.legs], self.sampling.composed_legs, self.sampling.composed)
        moved = (random.random(len(claims)) < composed) & claims.any(axis=1)
        cyclic = self._cyclic[drawn.clip]
        walking = cyclic & claims[:, self.corpus.legs] & (claims.sum(axis=1) == 1)
        others = claims.any(axis=1)
        host, whole = np.arange(len(claims)), np.zeros(len(claims), dtype=bool)
        offset = np.zeros(len(claims), dtype=int)
        for row in np.flatnonzero(moved):
            room = drawn.frames - drawn.frames[row]
            carrying = walking if self.sampling.hosts == "walking" else others
            hosts = np.flatnonzero(carrying & ~claims[:, claims[row]].any(axis=1) & (room >= 0))
            if len(hosts):
                host[row] = random.choice(hosts)
                whole[row] = random.random() < WHOLE_HOSTS
                offset[row] = whole[row] * random.integers(room[host[row]] + 1)
        frames = np.where(whole, drawn.frames[host], drawn.frames)
        guest = replace(drawn, frames=np.where(host == np.arange(len(host)), 0, drawn.frames))
        told = np.where(whole, sentence[host], sentence)
        other = np.where(~whole & cyclic[host], sentence[host], sentence)
        return Draws(replace(drawn[host], frames=frames), told, guest, offset, other)

    def _draw(self, count: int, random: np.random.Generator) -> Draws:
        """So many rows, without compositions."""
        sampling, fps = self.sampling, self.corpus.fps
        clip = random.choice(self._described, count, p=self.shares)
        silent = random.random(count) < sampling.silent
        chance = random.random(count)
        sentence = np.array([self.corpus.sentence(*pair) for pair in zip(clip.tolist(), chance.tolist(), strict=True)])
        is_crop = random.random(count) < sampling.crops
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
        room = np.where(free, length, frames) - source  # where a stretch may begin
        offset = _between(np.zeros(count), room, random.random(count)) + np.where(free, 0, cut[0])
        speed = np.minimum(speed, source)  # at least one frame is left
        begin = self._start[clip]
        sentence = np.where(is_crop | silent, NULL, sentence)
        # Neither the last pose nor the velocity after it may lie beyond the stretch; 10 / 1.25 is 8, also in floats.
        frames = np.floor(np.minimum(source / speed, (source - 1) / speed + 1) + 1e-9).astype(int)
        body, none = Stretches(clip, begin + offset, begin + length, frames, speed), np.zeros(count, dtype=int)
        return Draws(body, sentence, replace(body, frames=none), none, sentence)


def _shares(frame: np.ndarray, frames: np.ndarray, offset: np.ndarray, of_row: np.ndarray) -> np.ndarray:
    """How much of the guest shows in its frame `frame`: all, but for ramps at its ends and nothing beyond them, where
    these lie within the row."""
    come = np.where(offset == 0, SEAM + 1, 0)[:, None] + frame + 1
    go = np.where(offset + frames == of_row, SEAM + 1, 0)[:, None] + frames[:, None] - frame
    return (np.minimum(come, go) / (SEAM + 1)).clip(0, 1).astype(np.float32)


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
