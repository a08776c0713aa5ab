"""Clips for any duration: what is cyclic goes round again, what happens once is followed by rest, or by walking on.

A network that never saw ten seconds of a run makes a walk of them. Knows prepared caches and layouts, and that features
are seen from the body, so that frames of other places and headings can follow each other; knows no text and no network.
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
"""Seconds over which one moment's course goes over into that of another one."""

CYCLE = 0.6
"""Seconds of the shortest cycle: two steps of a run."""

NEAR = 0.10
"""Metres between the joints of two moments, on average, beyond which neither may go on as the other does."""

SPEED = 0.15
"""Metres that a difference of one metre per second of the root counts as."""

REST = (0.5, 4.0)
"""Seconds of what follows what happens once, between these."""

CANDIDATES = 60
"""Clips of each content at most that are looked through for what may follow."""

TOGETHER = 64
"""Clips for which what may follow is looked for at once."""

Features = Float[Tensor, "_ features"]


@dataclass(frozen=True)
class Prolonging:
    """How clips are prolonged. Cyclic ones to `seconds`; of the others there are two, as it is and followed by a clip
    of one of the contents `followed_by`: whoever has turned walks on, whoever has bowed stands. Where no moment
    resembles another one closely enough, a clip stays as it is."""

    seconds: float | int
    followed_by: tuple[str, ...] = ("stand", "sit", "walk", "run")
    seed: int = 0

    def __call__(self, cache: Cache, layout: Layout) -> Cache:
        """`cache` with its clips prolonged. Raises `KeyError` for a layout without positions or root velocities."""
        joining = _Joining(cache.fps, layout)
        frames, rng = round(self.seconds * cache.fps), np.random.default_rng(self.seed)
        once = [
            clip
            for clip in cache.clips
            if not clip.cyclic and clip.end - clip.start >= joining.fade and any(cache.texts[clip.texts])
        ]
        rests = [round(rng.uniform(*REST) * cache.fps) for _ in once]
        followed: dict[Clip, Features | None] = {}
        if following := [joining.looped(_features(cache, clip), frames) for clip in self._next(cache)]:
            ended = _Following(joining, following).after([_features(cache, clip) for clip in once], rests)
            followed = dict(zip(once, ended, strict=True))

        def rows() -> Iterator[tuple[Clip, Features]]:
            for clip in track(cache.clips, "prolonging clips", transient=True):
                features = _features(cache, clip)
                yield clip, joining.looped(features, frames) if clip.cyclic else features
                if (longer := followed.get(clip)) is not None:
                    yield replace(clip, name=f"{clip.name}/followed"), longer

        clips, features = assemble(list(rows()))
        return replace(cache, clips=clips, features=features)

    def _next(self, cache: Cache) -> list[Clip]:
        """The clips that may follow, evenly chosen where there are many."""
        chosen = []
        for content in self.followed_by:
            clips = [clip for clip in cache.clips if clip.content == content and clip.split == "train"]
            chosen += clips[:: -(-len(clips) // CANDIDATES) or 1]
        return chosen


def _features(cache: Cache, clip: Clip) -> Features:
    return cache.features[clip.start : clip.end]


class _Joining:
    """How alike moments are, and what leads from one to another, for features at `fps` frames a second."""

    def __init__(self, fps: float | int, layout: Layout) -> None:
        self.fps, self.layout = fps, layout
        self.fade = 2 * max(1, round(FADE * fps / 2))

    def looped(self, features: Features, frames: int) -> Features:
        """As many frames, if `features` are fewer and have a cycle. Of the cycles about as close as the closest the
        longest is taken, so that little repeats; it turns as the clip does on average: who walks straight goes on
        straight."""
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
        once = self.joined(lap, lap)[end - begin : 2 * (end - begin)]
        lap[:, turning] += features[:, turning].mean(dim=0) - once[:, turning].mean(dim=0)
        longer = features[: end + self.fade]
        while len(longer) < frames:
            longer = self.joined(longer, lap)
        return longer[:frames]

    def distances(self, features: Features, others: Features) -> Float[Tensor, "windows others"]:
        """Metres between the joints, on average, at the beginnings and ends of windows of a fade's length, and the
        difference of the roots' velocities as metres."""
        apart, last = self.apart(features, others), self.fade - 1
        return (apart[: len(features) - last, : len(others) - last] + apart[last:, last:]) / 2

    def apart(self, features: Features, others: Features) -> Float[Tensor, "frames others"]:
        """The same of single frames."""
        positions, velocity = self.layout["positions"], self.layout["root_velocity"]
        joints = [rearrange(each[:, positions], "n (joint xyz) -> joint n xyz", xyz=3) for each in (features, others)]
        apart = SPEED * self.fps * torch.cdist(features[:, velocity], others[:, velocity])
        for one, other in zip(*joints, strict=True):
            apart += torch.cdist(one, other) / len(joints[0])
        return apart

    def joined(self, features: Features, others: Features) -> Features:
        """One after the other, the end of the first faded into the beginning of the second."""
        fade = self.fade
        share = torch.linspace(0, 1, fade + 2)[1:-1, None]
        between = torch.lerp(features[-fade:], others[:fade], share)
        between[:, self.layout["rotations"]] = orthonormal_rows(between[:, self.layout["rotations"]])
        return torch.cat([features[:-fade], between, others[fade:]])


class _Following:
    """Clips that go on, and which moment of them a motion can end in."""

    def __init__(self, joining: _Joining, clips: list[Features]) -> None:
        self.joining, self.features = joining, torch.cat(clips)
        self.left = torch.cat([torch.arange(len(clip), 0, -1) for clip in clips])

    def after(self, clips: list[Features], frames: list[int]) -> Iterator[Features | None]:
        """Each clip, of a fade's length at least, and then so many frames of one that goes on; None where none has as
        many that are near its end. Many are looked for at once: distances from one frame to tens of thousands wait for
        memory, not for arithmetic."""
        last = self.joining.fade - 1
        for first in track(range(0, len(clips), TOGETHER), "looking for what may follow", transient=True):
            ends = clips[first : first + TOGETHER]
            begun = self.joining.apart(torch.stack([clip[-last - 1] for clip in ends]), self.features[:-last])
            ended = self.joining.apart(torch.stack([clip[-1] for clip in ends]), self.features[last:])
            for clip, count, distance in zip(ends, frames[first:], (begun + ended) / 2, strict=False):
                yield self._joined(clip, count, distance)

    def _joined(self, clip: Features, frames: int, distance: Float[Tensor, " others"]) -> Features | None:
        fade = self.joining.fade
        distance = distance.masked_fill(self.left[: len(distance)] < frames + fade, torch.inf)
        start = int(distance.argmin())
        if distance[start] > NEAR:
            return None
        return self.joining.joined(clip, self.features[start : start + fade + frames])
