"""What FlowMDM is built from: attention within a window, at a cost linear in the frames, whose queries alone know the
condition (Barquero et al. 2024, sections 3.2 and 3.3); and the two kinds of attention that it is compared with.

Parameter names are those of the published checkpoints. Knows frames and which of them may see each other; knows no
texts, no steps and no features.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Literal

import torch
import torch.nn.functional as F
from einops import rearrange
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

HEAD = 64
"""Channels of a head, whatever the network's width."""
ROTARY_DIM = 32
"""How many of them, the first ones, rotary positions turn."""
BASE = 10000.0
"""Of the wavelengths of both encodings."""

Frames = Float[Tensor, "batch frames width"]
Heads = Float[Tensor, "batch heads frames channels"]
Values = Float[Tensor, "batch heads frames found"]
Attend = Callable[[Heads, Heads, Values], Values]
"""(queries, keys, values) → the values that each frame's query finds."""


@dataclass(frozen=True, eq=False)
class AttentionMask:
    """Which of `frames` see which, for a batch of sequences: those at most `window` away, in both directions, unless
    they are padding; in rows that stay `within_segment`, those of the same segment only. A frame always sees itself,
    so that padding has something to look at."""

    frames: int
    window: int
    mask: Bool[Tensor, "batch frames"] | None
    segment: Int[Tensor, "batch frames"] | None
    within_segment: Bool[Tensor, " batch"]

    def attention(self) -> Attend:
        """All frames at once where that is no more work than blocks with their two neighbours; else in blocks, so that
        time and memory grow with the frames and not with their square."""
        device, window = self.within_segment.device, self.window
        if self.frames > 3 * window:
            first = torch.arange(0, self.frames, window, device=device)[:, None, None]
            own, around = torch.arange(window, device=device), torch.arange(-window, 2 * window, device=device)
            return _in_blocks(self._visible(first + own[:, None], first + around), window)
        frame = torch.arange(self.frames, device=device)
        return _at_once(self._visible(frame[:, None], frame[None]))

    def _visible(
        self, query: Int[Tensor, "*blocks own 1"], key: Int[Tensor, "*blocks 1 around"]
    ) -> Bool[Tensor, "_ *blocks own around"]:
        """For frames that may also lie outside of the sequence, where nothing is seen; one row for all or for each."""
        near = ((query - key).abs() <= self.window) & (key >= 0) & (key < self.frames)
        visible, each = near[None], [-1, *[1] * near.ndim]
        if self.mask is not None:
            visible = visible & self._at(self.mask, key)
        if self.segment is not None:
            same = self._at(self.segment, query) == self._at(self.segment, key)
            visible = visible & (same | ~self.within_segment.reshape(each))
        return visible | (query == key)

    def _at(self, values: Tensor, frame: Tensor) -> Tensor:
        return values[:, frame.clamp(0, self.frames - 1)]


def _at_once(visible: Bool[Tensor, "_ frames frames"]) -> Attend:
    visible = rearrange(visible, "batch own around -> batch 1 own around")
    return lambda query, key, value: F.scaled_dot_product_attention(query, key, value, attn_mask=visible)


def _in_blocks(visible: Bool[Tensor, "_ blocks own around"], size: int) -> Attend:
    """Queries in blocks of `size` frames, each with the keys and values of its own block and of the two beside it."""
    blocks = visible.shape[1]

    def around(values: Tensor) -> Tensor:
        behind = blocks * size - values.shape[2]
        windows = F.pad(values, (0, 0, size, size + behind)).unfold(2, 3 * size, size)
        return rearrange(windows, "batch heads blocks channels around -> (batch blocks) heads around channels")

    def attend(query: Heads, key: Heads, value: Values) -> Values:
        batch, _, frames, _ = query.shape
        own = F.pad(query, (0, 0, 0, blocks * size - frames))
        own = rearrange(own, "batch heads (blocks own) channels -> (batch blocks) heads own channels", blocks=blocks)
        mask = rearrange(visible.expand(batch, -1, -1, -1), "batch blocks own around -> (batch blocks) 1 own around")
        mixed = F.scaled_dot_product_attention(own, around(key), around(value), attn_mask=mask)
        return rearrange(mixed, "(batch blocks) heads own channels -> batch heads (blocks own) channels", batch=batch)[
            :, :, :frames
        ]

    return attend


@dataclass(frozen=True, eq=False)
class RotaryEmbedding:
    """Rotary positions (Su et al. 2021): cosines and sines of every frame's angles, one for each pair of channels."""

    cosines: Float[Tensor, "batch 1 frames half"]
    sines: Float[Tensor, "batch 1 frames half"]

    @classmethod
    def of(cls, frames: int, relative: Bool[Tensor, " batch"]) -> RotaryEmbedding:
        """Of consecutive frames, for the rows that are `relative`; the others are not turned.

        Angles are float64 until their sines are known: after ten minutes they are large.
        """
        frame = torch.arange(frames, dtype=torch.float64, device=relative.device)
        angle = frame[:, None] * frequencies(ROTARY_DIM // 2).to(frame)
        angle = rearrange(relative, "batch -> batch 1 1 1") * angle
        return cls(angle.cos(), angle.sin())

    def __call__(self, values: Heads) -> Heads:
        """Channel i of the first half of the turned ones is turned with channel i of the second."""
        cosines, sines = self.cosines.to(values), self.sines.to(values)
        first, second, rest = values.split([ROTARY_DIM // 2, ROTARY_DIM // 2, HEAD - ROTARY_DIM], dim=-1)
        return torch.cat([first * cosines - second * sines, second * cosines + first * sines, rest], dim=-1)


def absolute_positions(position: Int[Tensor, "batch frames"], width: int) -> Float[Tensor, "batch frames width"]:
    """Sines of the positions, then their cosines, with wavelengths 2 pi to 20,000 pi."""
    angle = position[..., None] * frequencies(width // 2).to(position.device, torch.float32)
    return torch.cat([angle.sin(), angle.cos()], dim=-1)


def frequencies(count: int) -> Float[Tensor, " count"]:
    """Radians a frame, in float64: 1, and falling towards 1 / `BASE`."""
    return BASE ** (-torch.arange(count, dtype=torch.float64) / count)


class Attention(nn.Module, ABC):
    """Attention of frames to each other, of which a subclass says what their queries, keys and values are made of.

    `width` of the frames and of the condition; each of `heads` has `HEAD` channels. `custom_query_fn`: what makes one
    of a pose and a condition, where there is such a thing.
    """

    def __init__(self, width: int, heads: int, custom_query_fn: nn.Linear | None = None) -> None:
        super().__init__()
        self.heads = heads
        if custom_query_fn is not None:  # first: the order of the parameters is that of optimisers' states
            self.custom_query_fn = custom_query_fn
        self.to_q = nn.Linear(width, heads * HEAD, bias=False)
        self.to_k = nn.Linear(width, heads * HEAD, bias=False)
        self.to_v = nn.Linear(width, heads * HEAD, bias=False)
        self.to_out = nn.Linear(heads * HEAD, width, bias=False)

    @abstractmethod
    def sources(self, poses: Frames, condition: Frames) -> tuple[Frames, Frames]:
        """What makes a frame's query, and what makes its key and its value."""

    def forward(
        self, poses: Frames, condition: Frames, rotary: RotaryEmbedding, attend: Attend
    ) -> Float[Tensor, "batch frames width"]:
        asking, asked = self.sources(poses, condition)
        query, key, value = (self._split(each) for each in (self.to_q(asking), self.to_k(asked), self.to_v(asked)))
        mixed = attend(rotary(query), rotary(key), value)
        return self.to_out(rearrange(mixed, "batch heads frames channels -> batch frames (heads channels)"))

    def scores(
        self, poses: Frames, condition: Frames, rotary: RotaryEmbedding, attend: Attend
    ) -> Float[Tensor, "batch heads frames frames"]:
        """How much each frame attends to each: what it finds where every frame's value is the frame itself."""
        asking, asked = self.sources(poses, condition)
        query, key = self._split(self.to_q(asking)), self._split(self.to_k(asked))
        itself = torch.eye(poses.shape[1], dtype=query.dtype, device=query.device)
        return attend(rotary(query), rotary(key), itself.expand(*query.shape[:2], -1, -1))

    def _split(self, values: Tensor) -> Heads:
        return rearrange(values, "batch frames (heads channels) -> batch heads frames channels", heads=self.heads)


class PoseCentricAttention(Attention):
    """Pose-centric cross-attention: the condition makes a frame's query, and nothing else (Eq. 3)."""

    def __init__(self, width: int, heads: int) -> None:
        super().__init__(width, heads, nn.Linear(2 * width, width))

    def sources(self, poses: Frames, condition: Frames) -> tuple[Frames, Frames]:
        """The frame's pose and condition in one; its pose."""
        return self.custom_query_fn(torch.cat([poses, condition], dim=-1)), poses


class ConditionedAttention(PoseCentricAttention):
    """Self-attention of poses and conditions in one: both make query, key and value (Eq. 2)."""

    def sources(self, poses: Frames, condition: Frames) -> tuple[Frames, Frames]:
        """The frame's pose and condition in one, twice."""
        conditioned, _ = super().sources(poses, condition)
        return conditioned, conditioned


class SelfAttention(Attention):
    """Self-attention of poses, which know no condition."""

    def sources(self, poses: Frames, condition: Frames) -> tuple[Frames, Frames]:
        """The frame's pose, twice."""
        return poses, poses


class CrossAttention(Attention):
    """Attention of poses to conditions, each where its frame is."""

    def sources(self, poses: Frames, condition: Frames) -> tuple[Frames, Frames]:
        """The frame's pose; its condition."""
        return poses, condition


Conditioning = Literal["pccat", "sat", "cat"]
"""How the condition comes to the frames: pose-centric cross-attention; self-attention of poses and conditions; or
self-attention of poses, then cross-attention to conditions (section 4.1, "Implementation details")."""

ATTENTION: Mapping[Conditioning, tuple[type[Attention], ...]] = {
    "pccat": (PoseCentricAttention,),
    "sat": (ConditionedAttention,),
    "cat": (SelfAttention, CrossAttention),
}
"""The attention of one layer, one after the other."""


class Feedforward(nn.Module):
    """Two linear layers with an exact GELU between them, under the published names."""

    def __init__(self, width: int, inner: int) -> None:
        super().__init__()
        first = nn.Sequential(nn.Linear(width, inner), nn.GELU())
        self.ff = nn.Sequential(first, nn.Identity(), nn.Identity(), nn.Linear(inner, width))

    def forward(self, frames: Float[Tensor, "batch frames width"]) -> Float[Tensor, "batch frames width"]:
        return self.ff(frames)


class Layers(nn.Module):
    """Attention and feed-forward in turn, each behind a norm and beside a residual stream; a norm at the end.

    In training each of them is left out with probability `stochastic_depth`, for the whole batch (Huang et al. 2016).
    """

    def __init__(
        self, width: int, inner: int, count: int, heads: int, stochastic_depth: float, conditioning: Conditioning
    ) -> None:
        super().__init__()
        inside = [
            block
            for _ in range(count)
            for block in (*(kind(width, heads) for kind in ATTENTION[conditioning]), Feedforward(width, inner))
        ]
        self.layers = nn.ModuleList(nn.ModuleList([nn.ModuleList([nn.LayerNorm(width)]), block]) for block in inside)
        self.final_norm = nn.LayerNorm(width)
        self.stochastic_depth = stochastic_depth

    def forward(self, frames: Float[Tensor, "batch frames width"], *attention: object) -> Tensor:
        for (norm,), block in self.layers:
            normed = norm(frames)
            out = block(normed, *attention) if isinstance(block, Attention) else block(normed)
            if self.training and self.stochastic_depth:
                # Multiplied by 0, not left out of the graph: distributed training wants a gradient for every weight.
                out = out * (torch.rand((), device=out.device) >= self.stochastic_depth)
            frames = frames + out
        return self.final_norm(frames)
