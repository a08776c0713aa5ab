"""A prepared cache with its texts, normalised for training, and plans of its batches."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Literal, get_args

import numpy as np
import torch
from jaxtyping import Bool, Float, Shaped
from torch import Tensor

from stmc.data.cache import Cache, Clip
from stmc.diffusion import tensors
from stmc.diffusion.statistics import Statistics
from stmc.motion.body import BodyPart
from stmc.motion.geometry import orthonormal_rows
from stmc.motion.representation.layout import Layout
from stmc.text import TextEncoder
from stmc.training.data.joining import Arrangement
from stmc.training.data.leaving_out import leave_out
from stmc.training.loss import Batch

NULL = 0
"""Index of the empty text among the sentences, which stands for "no text"."""
SEAM = 6
"""Number of frames over which the donor of a composition fades in and out."""
FLOOR = 1e-3
"""Minimum divisor of the values of words, and of features whose field has no floor."""
MeansOver = Literal["clips", "entries"]
"""Samples of the statistics: see `Dataset`."""


class Dataset:
    """A cache with its texts, normalised, on one device.

    The statistics `motion` come from the cache, or from its training clips; `skeleton` is that of the cache, or None.
    Raises `ValueError` if the layout does not fit the cache, nothing is left to train on, or nothing moves.

    Args:
        cache: Prepared data.
        encoder: Text encoder.
        layout: Layout of the features.
        floor: Minimum divisors of features by field; features that hardly vary in most clips may vary in some.
        min_clips: Contents with fewer training clips have no texts, since one clip of several actions teaches no word.
        limit: Features are clamped to this many standard deviations from the mean.
        text: Statistics of texts; None: those of the words of the training sentences.
        statistics_over: "clips": statistics over all training clips and distinct texts. "entries": over the first clip
            and the first text of each content, counting repeated texts, as in STMC, where every entry is a content.
        device: Device of the data.
        joined: Sentences about two contents at once by the contents' names, for compositions (see `BalancedBatches`);
            pairs with an unknown content are ignored.
        without: Patterns of names of recordings that are not trained on; see `leave_out`.
        without_texts: Sentences that are not trained on.
    """

    def __init__(
        self,
        cache: Cache,
        encoder: TextEncoder,
        layout: Layout,
        floor: Mapping[str, float] | None = None,
        min_clips: int = 5,
        limit: float = math.inf,
        text: Statistics | None = None,
        statistics_over: MeansOver = "clips",
        device: torch.device | str = "cpu",
        joined: Mapping[frozenset[str], Sequence[str]] = MappingProxyType({}),
        without: Sequence[str] = (),
        without_texts: Sequence[str] = (),
    ) -> None:
        if without or without_texts:
            cache = leave_out(cache, without, without_texts)
        if cache.features.shape[1] != layout.width:
            raise ValueError(f"the cache has {cache.features.shape[1]} features, but the layout has {layout.width}")
        self.fps, self.layout, self.clips, self.skeleton = cache.fps, layout, cache.clips, cache.skeleton
        self.min_clips = min_clips
        training = [clip for clip in cache.clips if clip.split == "train"]
        counts = Counter(clip.content for clip in training)
        self.described = np.array([counts[c.content] >= min_clips and any(cache.texts[c.texts]) for c in cache.clips])
        if not training or not self.described.any():
            raise ValueError(
                f"no content has {min_clips} training clips among the {len(cache.clips)} clips of the cache"
            )
        parts = list(layout.columns)
        self.claims = np.array([[part in clip.parts for part in parts] for clip in cache.clips], dtype=bool)
        self.legs, self._owned = parts.index(BodyPart.LEGS), _columns_of_parts(layout).to(device)
        self.features = cache.features.to(device)
        first = _first_of_entries(training, statistics_over)
        frames = torch.cat([torch.arange(clip.start, clip.end) for clip in first or training])
        moving = cache.features[frames]
        if (moving.amax(dim=0) == moving.amin(dim=0)).all():
            raise ValueError(f"all {len(frames)} training frames are the same, so there is nothing to learn")
        floors = torch.tensor(layout.filled(floor or {}, FLOOR))
        self.motion, self._limit = (cache.statistics or Statistics.of(moving, floors)).to(device), limit
        described = {clip.content for clip, known in zip(cache.clips, self.described, strict=True) if known}
        joined = {pair: texts for pair, texts in joined.items() if pair <= described}
        self._embed(cache, encoder, text, first, joined, device)
        # Cumulated velocities change the speed of a clip without losing distance; float64, since they sum hours.
        self.velocity = [c for name, s in layout.slices.items() if "velocit" in name for c in range(s.start, s.stop)]
        travelled = self.features[:, self.velocity].double().cumsum(dim=0)
        self._travelled = torch.cat([torch.zeros_like(travelled[:1]), travelled])

    def _embed(
        self,
        cache: Cache,
        encoder: TextEncoder,
        text: Statistics | None,
        first: Sequence[Clip],
        joined: Mapping[frozenset[str], Sequence[str]],
        device: torch.device | str,
    ) -> None:
        keys = {clip.texts for clip, known in zip(cache.clips, self.described, strict=True) if known}
        own = {text for key in keys for text, _ in cache.texts[key]}
        pairs = {text for texts in joined.values() for text in texts} - own
        self.sentences, self.joined = ["", *sorted(own - {""}), *sorted(pairs)], frozenset(pairs)
        words, lengths = encoder.encode(self.sentences)
        self.words = lengths.cpu().numpy()
        exists = tensors.mask(lengths, words.shape[1])
        place = {text: index for index, text in enumerate(self.sentences)}
        trained = {clip.texts for clip in cache.clips if clip.split == "train"} & keys
        trained_sentences = sorted({place[text] for key in trained for text, _ in cache.texts[key]})
        rows = [place[cache.texts[clip.texts][0][0]] for clip in first if clip.texts in keys] or trained_sentences
        self.text = (text or Statistics.of(words[rows][exists[rows]].float(), FLOOR)).to(device)
        self._text = torch.where(exists[..., None].to(device), self.text.normalise(words.to(device).float()), 0.0)
        self.choices = {
            key: (
                np.array([place[text] for text, _ in cache.texts[key]]),
                np.cumsum([share for _, share in cache.texts[key]]),
            )
            for key in keys
        }
        self._joined = {pair: [place[text] for text in texts] for pair, texts in joined.items()}

    @property
    def features_width(self) -> int:
        """The number of features per frame."""
        return self.features.shape[1]

    @property
    def text_width(self) -> int:
        """The width of the embedding of a word."""
        return self._text.shape[2]

    def sentence(self, clip: int, u: float) -> int:
        """Choose a sentence of a clip by `u` in [0, 1) and the sentences' probabilities; return its index."""
        if not self.described[clip]:
            return NULL
        places, cumulated = self.choices[self.clips[clip].texts]
        return int(places[min(int(np.searchsorted(cumulated, u, side="right")), len(places) - 1)])

    def sentences_of(self, clips: np.ndarray, u: np.ndarray) -> np.ndarray:
        """Choose a sentence of each clip as `sentence` does; return their indices."""
        return np.array([self.sentence(*pair) for pair in zip(clips.tolist(), u.tolist(), strict=True)], dtype=int)

    def joined_sentence(self, clip: int, other: int, u: float) -> int | None:
        """Choose a sentence about the contents of two clips by `u` in [0, 1); return its index, or None."""
        places = self._joined.get(frozenset((self.clips[clip].content, self.clips[other].content)), [])
        return places[int(u * len(places))] if places else None

    def batch(self, plan: BatchPlan) -> Batch:
        """Build the batch of `plan`, with motions and texts padded to the longest."""
        arrangement, words, device = plan.arrangement, self.words[plan.sentence], self.features.device
        frames = arrangement.lengths
        lengths = torch.from_numpy(frames).to(device)
        mask = None if (frames == frames.max()).all() else tensors.mask(lengths, int(frames.max()))
        raw = arrangement.cross_fade(self._compose(self._cut(plan.body), plan), self._rotating)
        motion = self.motion.normalise(raw).clamp(-self._limit, self._limit)
        if mask is not None:
            motion = torch.where(mask[..., None], motion, 0.0)
        sentence = torch.from_numpy(plan.sentence).to(device)
        text, sentence, segment, text_mask = self._text[sentence][:, : int(words.max())], sentence[:, None], None, None
        if len(frames) < len(words):
            text, sentence = (self._in_rows(each, plan) for each in (text, sentence))
            segment = torch.from_numpy(arrangement.segments()).to(device)
        elif (words != words.max()).any():
            text_mask = tensors.mask(torch.from_numpy(words).to(device), int(words.max()))
        return Batch(motion, mask, text, text_mask, int(frames.sum()), segment=segment, sentence=sentence)

    def _in_rows(self, of_crops: Shaped[Tensor, "crops 1 *width"], plan: BatchPlan) -> Shaped[Tensor, "rows _ *width"]:
        """Arrange one item per crop, such as the single word of its text, in rows, padded with zeros."""
        rows, device = plan.arrangement, of_crops.device
        row, place = (torch.from_numpy(each).to(device) for each in (plan.row, rows.place))
        in_rows = of_crops.new_zeros(len(rows.lengths), int(rows.place.max()) + 1, *of_crops.shape[2:])
        return in_rows.index_put((row, place), of_crops[:, 0])

    def poses(self, plan: BatchPlan, frame: np.ndarray) -> np.ndarray:
        """Return normalised features of each crop at its frame `frame`, (crops, features), without interpolation."""
        donor, own = plan.donor, frame - plan.offset
        inside = torch.from_numpy((own >= 0) & (own < donor.frames)).to(self.features.device)
        claimed = torch.from_numpy(self.claims[donor.clip]).to(self.features.device)
        owned = (claimed[:, :, None] & self._owned).any(dim=1) & inside[:, None]
        raw = torch.where(owned, self._at(donor, own.clip(0)), self._at(plan.body, frame))
        return self.motion.normalise(raw).clamp(-self._limit, self._limit).cpu().numpy()

    def _at(self, crops: Crops, frame: np.ndarray) -> Tensor:
        place = np.minimum(crops.start + np.rint(frame * crops.speed).astype(int), crops.end - 1)
        return self.features[torch.from_numpy(place).to(self.features.device)]

    def _compose(self, motion: Float[Tensor, "batch frames features"], plan: BatchPlan) -> Tensor:
        """Blend each row with its donor, if any, in the columns of the parts that the donor claims."""
        rows = np.flatnonzero(plan.donor.frames)
        if not len(rows):
            return motion
        donor, device = plan.donor[rows], motion.device
        moved, offset = self._cut(donor), plan.offset[rows]
        frame = np.arange(motion.shape[1])[None] - offset[:, None]  # of the donor
        share = torch.from_numpy(_shares(frame, donor.frames, offset, plan.body.frames[rows])).to(device)
        inside = torch.from_numpy(frame.clip(0, moved.shape[1] - 1)).to(device)
        moved = moved.gather(1, inside[..., None].expand(-1, -1, moved.shape[2]))
        claimed = torch.from_numpy(self.claims[donor.clip]).to(device)
        owned = (claimed[:, :, None] & self._owned).any(dim=1)
        chosen = torch.from_numpy(rows).to(device)
        blended = torch.lerp(motion[chosen], moved, share[..., None] * owned[:, None])
        return motion.index_copy(0, chosen, self._rotating(blended))

    def _cut(self, crops: Crops) -> Float[Tensor, "batch frames features"]:
        """Return raw features of crops; frames after the end of a crop repeat its last one."""
        device = self.features.device
        bounds = (crops.start, crops.end, crops.frames - 1)
        start, end, last = (torch.from_numpy(bound).to(device)[:, None] for bound in bounds)
        frame = torch.arange(int(crops.frames.max()), device=device)
        if (crops.speed == 1).all():
            return self.features[start + torch.minimum(frame, last)]
        speed = torch.from_numpy(crops.speed).to(device)[:, None]
        position = torch.minimum(frame, last) * speed
        before = (start + position.long()).clamp(max=end - 1)
        share = (position - position.floor())[..., None].float()
        raw = torch.lerp(self.features[before], self.features[(before + 1).clamp(max=end - 1)], share)
        raw[..., self.velocity] = (self._distance(start, position + speed) - self._distance(start, position)).float()
        return self._rotating(raw)

    def _rotating(self, raw: Float[Tensor, "*batch features"]) -> Tensor:
        """Restore valid rotations in blended features, in place."""
        raw[..., self.layout["rotations"]] = orthonormal_rows(raw[..., self.layout["rotations"]])
        return raw

    def _distance(self, start: Tensor, position: Tensor) -> Tensor:
        """Return the cumulated velocity up to `position` (float, in frames) after `start`."""
        whole = start + position.long()
        after = (whole + 1).clamp(max=len(self._travelled) - 1)
        return torch.lerp(self._travelled[whole], self._travelled[after], (position - position.floor())[..., None])


@dataclass(frozen=True)
class Crops:
    """Crops of clips.

    Args:
        clip: Index of each clip.
        start: First frame of each crop among all features.
        end: End of each clip; crops contain no frame at or after it.
        frames: Number of frames of each crop.
        speed: Number of source frames per frame.
    """

    clip: np.ndarray
    start: np.ndarray
    end: np.ndarray
    frames: np.ndarray
    speed: np.ndarray

    def __getitem__(self, rows: np.ndarray) -> Crops:
        return Crops(*(getattr(self, name)[rows] for name in self.__dataclass_fields__))

    def concatenate(self, others: Crops) -> Crops:
        """Append other crops."""
        pairs = ((getattr(self, name), getattr(others, name)) for name in self.__dataclass_fields__)
        return Crops(*map(np.concatenate, pairs))


@dataclass(frozen=True)
class BatchPlan:
    """Plan of a batch, with one entry per crop.

    Args:
        body: Source crop of the body.
        sentence: Index of the sentence among the dataset's sentences.
        donor: Source crop of a composition, whose claimed parts replace those of the body; empty if there is none.
        offset: Frame of the body at which the donor begins.
        other: Sentence of the other clip of a composition if its action is visible, else `sentence`.
        row: Row of each crop: see `Arrangement`.
        fade: Number of frames shared with the previous crop of the row: see `Arrangement`.
    """

    body: Crops
    sentence: np.ndarray
    donor: Crops
    offset: np.ndarray
    other: np.ndarray
    row: np.ndarray
    fade: np.ndarray

    @classmethod
    def plain(cls, body: Crops, sentence: np.ndarray, row: np.ndarray) -> BatchPlan:
        """Plan crops without compositions and cross-fades."""
        none = np.zeros(len(sentence), dtype=int)
        return cls(body, sentence, replace(body, frames=none), none, sentence, row, none)

    def __getitem__(self, crops: np.ndarray) -> BatchPlan:
        """Select some of the crops; the rows keep their numbers."""
        return BatchPlan(*(getattr(self, name)[crops] for name in self.__dataclass_fields__))

    @property
    def arrangement(self) -> Arrangement:
        """The positions of the crops in their rows."""
        return Arrangement(self.row, self.body.frames, self.fade)

    def rows(self, rows: np.ndarray) -> BatchPlan:
        """Select whole rows, in this order."""
        crops = np.concatenate([np.flatnonzero(self.row == row) for row in rows])
        chosen = self[crops]
        return replace(chosen, row=np.cumsum(np.diff(chosen.row, prepend=chosen.row[0]) != 0))


def _columns_of_parts(layout: Layout) -> Bool[Tensor, "parts features"]:
    """Return which features belong to each body part, in the order of the layout."""
    owned = torch.zeros(len(layout.columns), layout.width, dtype=torch.bool)
    for row, columns in enumerate(layout.columns.values()):
        owned[row, list(columns)] = True
    return owned


def _first_of_entries(training: Sequence[Clip], over: MeansOver) -> list[Clip]:
    """Return the first clip of each content for statistics over entries, or an empty list for those over clips."""
    if over not in get_args(MeansOver):
        raise ValueError(f"unknown statistics_over {over!r}; choose from {', '.join(get_args(MeansOver))}")
    return list({clip.content: clip for clip in reversed(training)}.values()) if over == "entries" else []


def _shares(frame: np.ndarray, frames: np.ndarray, offset: np.ndarray, of_row: np.ndarray) -> np.ndarray:
    """Return the weight of the donor at its frame `frame`: 1, with ramps at ends within the row, and 0 beyond them."""
    come = np.where(offset == 0, SEAM + 1, 0)[:, None] + frame + 1
    go = np.where(offset + frames == of_row, SEAM + 1, 0)[:, None] + frames[:, None] - frame
    return (np.minimum(come, go) / (SEAM + 1)).clip(0, 1).astype(np.float32)
