"""Extend clips: cyclic clips are repeated, other clips are followed by rest or by walking on.

A network that has never seen ten seconds of running turns them into a walk. This module knows prepared caches and
layouts, and that features are relative to the body, so that frames of other positions and headings can follow each
other; it knows no text and no network.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
import torch
from einops import rearrange
from jaxtyping import Float
from rich.progress import track
from torch import Tensor

from stmc.data.cache import Cache, Clip, assemble
from stmc.motion.geometry import orthonormal_rows
from stmc.motion.representation.layout import Layout

FADE = 0.4
"""Length in seconds of cross-fades between two moments."""
CYCLE = 0.6
"""Length in seconds of the shortest cycle: two steps of a run."""
NEAR = 0.10
"""Maximum mean distance in metres between the joints of two moments that are cross-faded."""
SPEED = 0.15
"""Distance in metres that equals a difference of one metre per second in the velocity of the root."""
REST = (0.5, 4.0)
"""Minimum and maximum length in seconds of the motion that follows a non-cyclic clip."""
CANDIDATES = 60
"""Maximum number of clips of each content among which to search for a successor."""
CLIPS_AT_ONCE = 64
"""Number of clips for which to search for successors at once."""
Features = Float[Tensor, "_ features"]


@dataclass(frozen=True)
class Prolonging:
    """Extension of clips. A clip without a sufficiently similar moment to continue from is unchanged.

    Args:
        seconds: Duration to which cyclic clips are extended.
        followed_by: Contents that may follow a non-cyclic clip; the cache then has the clip alone and with its
            successor, such as walking on after a turn, or standing after a bow.
        seed: Seed of the durations of successors.
    """

    seconds: float | int
    followed_by: tuple[str, ...] = ("stand", "sit", "walk", "run")
    seed: int = 0

    def __call__(self, cache: Cache, layout: Layout) -> Cache:
        """Extend the clips of a cache. Raises `KeyError` for a layout without positions or root velocities."""
        joining = _Joining(cache.fps, layout)
        frames, rng = round(self.seconds * cache.fps), np.random.default_rng(self.seed)
        once = [
            clip
            for clip in cache.clips
            if not clip.cyclic and clip.end - clip.start >= joining.fade and any(cache.texts[clip.texts])
        ]
        rests = [round(rng.uniform(*REST) * cache.fps) for _ in once]
        followed: dict[Clip, Features | None] = {}
        if following := [joining.extend_cyclic(_features(cache, clip), frames) for clip in self._next(cache)]:
            ended = _Following(joining, following).find([_features(cache, clip) for clip in once], rests)
            followed = dict(zip(once, ended, strict=True))

        def rows() -> Iterator[tuple[Clip, Features]]:
            for clip in track(cache.clips, "extending clips", transient=True):
                features = _features(cache, clip)
                yield clip, joining.extend_cyclic(features, frames) if clip.cyclic else features
                if (longer := followed.get(clip)) is not None:
                    yield replace(clip, name=f"{clip.name}/followed"), longer

        clips, features = assemble(list(rows()))
        return replace(cache, clips=clips, features=features)

    def _next(self, cache: Cache) -> list[Clip]:
        """Return the clips that may follow, evenly spaced if there are many."""
        chosen = []
        for content in self.followed_by:
            clips = [clip for clip in cache.clips if clip.content == content and clip.split == "train"]
            chosen += clips[:: -(-len(clips) // CANDIDATES) or 1]
        return chosen


def _features(cache: Cache, clip: Clip) -> Features:
    return cache.features[clip.start : clip.end]


class _Joining:
    """Distances and cross-fades between moments, for features at `fps` frames per second."""

    def __init__(self, fps: float | int, layout: Layout) -> None:
        self.fps, self.layout = fps, layout
        self.fade = 2 * max(1, round(FADE * fps / 2))

    def extend_cyclic(self, features: Features, frames: int) -> Features:
        """Repeat a cycle of `features` up to `frames` frames; return shorter features unchanged if they have no cycle.

        The cycle is the longest among those that close about as well as the best one, so that little is repeated. It
        turns as the whole clip does on average, so a straight walk stays straight.
        """
        windows = len(features) - self.fade + 1
        if len(features) >= frames or windows <= CYCLE * self.fps:
            return features
        apart = torch.arange(windows)[None] - torch.arange(windows)[:, None]
        distance = self.distances(features, features).masked_fill(apart < CYCLE * self.fps, torch.inf)
        if (closest := float(distance.min())) > NEAR:
            return features
        close = distance <= min(NEAR, 1.3 * closest + 0.01)
        begin, end = divmod(int(apart.masked_fill(~close, -1).argmax()), windows)
        turning, lap = self.layout["yaw_velocity"], features[begin : end + self.fade].clone()
        once = self.cross_fade(lap, lap)[end - begin : 2 * (end - begin)]
        lap[:, turning] += features[:, turning].mean(dim=0) - once[:, turning].mean(dim=0)
        longer = features[: end + self.fade]
        while len(longer) < frames:
            longer = self.cross_fade(longer, lap)
        return longer[:frames]

    def distances(self, features: Features, others: Features) -> Float[Tensor, "windows others"]:
        """Return distances in metres of windows of a fade's length, as the mean of their first and last frames."""
        apart, last = self.apart(features, others), self.fade - 1
        return (apart[: len(features) - last, : len(others) - last] + apart[last:, last:]) / 2

    def apart(self, features: Features, others: Features) -> Float[Tensor, "frames others"]:
        """Return distances of frames: the mean over joints, plus the difference of root velocities, in metres."""
        positions, velocity = self.layout["positions"], self.layout["root_velocity"]
        joints = [rearrange(each[:, positions], "n (joint xyz) -> joint n xyz", xyz=3) for each in (features, others)]
        apart = SPEED * self.fps * torch.cdist(features[:, velocity], others[:, velocity])
        for one, other in zip(*joints, strict=True):
            apart += torch.cdist(one, other) / len(joints[0])
        return apart

    def cross_fade(self, features: Features, others: Features) -> Features:
        """Concatenate two motions with a cross-fade."""
        fade = self.fade
        share = torch.linspace(0, 1, fade + 2)[1:-1, None]
        between = torch.lerp(features[-fade:], others[:fade], share)
        between[:, self.layout["rotations"]] = orthonormal_rows(between[:, self.layout["rotations"]])
        return torch.cat([features[:-fade], between, others[fade:]])


class _Following:
    """Possible successors, and the search for a moment at which to continue."""

    def __init__(self, joining: _Joining, clips: list[Features]) -> None:
        self.joining, self.features = joining, torch.cat(clips)
        self.left = torch.cat([torch.arange(len(clip), 0, -1) for clip in clips])

    def find(self, clips: list[Features], frames: list[int]) -> Iterator[Features | None]:
        """Yield each clip with `frames` frames of a successor, or None if none is near enough and long enough.

        Clips must have at least a fade's length. The search handles many clips at once, since distances from single
        frames to tens of thousands are bound by memory.
        """
        last = self.joining.fade - 1
        for first in track(range(0, len(clips), CLIPS_AT_ONCE), "searching for successors", transient=True):
            ends = clips[first : first + CLIPS_AT_ONCE]
            begun = self.joining.apart(torch.stack([clip[-last - 1] for clip in ends]), self.features[:-last])
            ended = self.joining.apart(torch.stack([clip[-1] for clip in ends]), self.features[last:])
            for clip, count, distance in zip(ends, frames[first:], (begun + ended) / 2, strict=False):
                yield self._continue(clip, count, distance)

    def _continue(self, clip: Features, frames: int, distance: Float[Tensor, " others"]) -> Features | None:
        fade = self.joining.fade
        distance = distance.masked_fill(self.left[: len(distance)] < frames + fade, torch.inf)
        start = int(distance.argmin())
        if distance[start] > NEAR:
            return None
        return self.joining.cross_fade(clip, self.features[start : start + fade + frames])
