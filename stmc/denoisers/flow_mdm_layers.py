"""Layers of FlowMDM: windowed attention whose queries alone depend on the condition, and two alternatives.

The cost of the attention is linear in the number of frames (Barquero et al. 2024, sections 3.2 and 3.3). The
alternatives are the baselines of the paper's ablations. Parameter names are those of the published checkpoints. The
layers see frames and visibility; they are independent of texts, steps and features.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Literal

import torch
import torch.nn.functional as F
from einops import rearrange
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

HEAD = 64
"""Channels per head, whatever the width of the network."""
ROTARY_DIM = 32
"""Number of leading channels of a head that rotary positions rotate."""
BASE = 10000.0
"""Base of the wavelengths of both encodings."""

Frames = Float[Tensor, "batch frames width"]
Heads = Float[Tensor, "batch heads frames channels"]
Values = Float[Tensor, "batch heads frames values"]
Attend = Callable[[Heads, Heads, Values], Values]
"""(queries, keys, values) → the attention output of each frame's query."""


@dataclass(frozen=True, eq=False)
class AttentionMask:
    """The visibility between frames, for a batch of sequences.

    A frame attends to unpadded frames at most `window` away in either direction; in rows that are `within_segment` it
    attends to its own segment only. A frame always attends to itself, so that no row of the attention is empty in the
    padding.

    Args:
        frames: Length of the sequences.
        window: Maximum distance of visible frames.
        mask: True at frames, False in the padding, [batch, frames]; None means no padding.
        segment: Index of each frame's segment, [batch, frames]; None means one segment.
        within_segment: True at rows that attend within their segments only, [batch].
    """

    frames: int
    window: int
    mask: Bool[Tensor, "batch frames"] | None
    segment: Int[Tensor, "batch frames"] | None
    within_segment: Bool[Tensor, " batch"]

    def attention(self) -> Attend:
        """Return the attention function for this mask.

        Long sequences are attended to in blocks, each with its two neighbours, so that time and memory grow linearly
        with the frames. Sequences of at most three windows are attended to at once, which costs no more.
        """
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
        """Compute which keys each query sees, in one row for all sequences or one row per sequence.

        Frames may lie outside of the sequence, where nothing is visible.
        """
        near = ((query - key).abs() <= self.window) & (key >= 0) & (key < self.frames)
        visible, row_shape = near[None], [-1, *[1] * near.ndim]
        if self.mask is not None:
            visible = visible & self._at(self.mask, key)
        if self.segment is not None:
            same = self._at(self.segment, query) == self._at(self.segment, key)
            visible = visible & (same | ~self.within_segment.reshape(row_shape))
        return visible | (query == key)

    def _at(self, values: Tensor, frame: Tensor) -> Tensor:
        return values[:, frame.clamp(0, self.frames - 1)]


def _at_once(visible: Bool[Tensor, "_ frames frames"]) -> Attend:
    visible = rearrange(visible, "batch own around -> batch 1 own around")
    return lambda query, key, value: F.scaled_dot_product_attention(query, key, value, attn_mask=visible)


def _in_blocks(visible: Bool[Tensor, "_ blocks own around"], size: int) -> Attend:
    """Attend in blocks of `size` queries, each with the keys and values of its own and the two neighbouring blocks."""
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
        output = F.scaled_dot_product_attention(own, around(key), around(value), attn_mask=mask)
        return rearrange(output, "(batch blocks) heads own channels -> batch heads (blocks own) channels", batch=batch)[
            :, :, :frames
        ]

    return attend


@dataclass(frozen=True, eq=False)
class RotaryEmbedding:
    """Rotary positions (Su et al. 2021): cosines and sines of every frame's angles, one per pair of channels."""

    cosines: Float[Tensor, "batch 1 frames half"]
    sines: Float[Tensor, "batch 1 frames half"]

    @classmethod
    def of(cls, frames: int, relative: Bool[Tensor, " batch"]) -> RotaryEmbedding:
        """Build the embedding of consecutive frames; rows that are not `relative` are not rotated.

        Angles are computed in float64, because they are large after ten minutes.
        """
        frame = torch.arange(frames, dtype=torch.float64, device=relative.device)
        angle = frame[:, None] * frequencies(ROTARY_DIM // 2).to(frame)
        angle = rearrange(relative, "batch -> batch 1 1 1") * angle
        return cls(angle.cos(), angle.sin())

    def __call__(self, values: Heads) -> Heads:
        """Rotate channel i of the first half of the rotary channels together with channel i of the second half."""
        cosines, sines = self.cosines.to(values), self.sines.to(values)
        first, second, rest = values.split([ROTARY_DIM // 2, ROTARY_DIM // 2, HEAD - ROTARY_DIM], dim=-1)
        return torch.cat([first * cosines - second * sines, second * cosines + first * sines, rest], dim=-1)


def absolute_positions(position: Int[Tensor, "batch frames"], width: int) -> Float[Tensor, "batch frames width"]:
    """Encode positions as sines followed by cosines, with wavelengths 2 pi to 20,000 pi."""
    angle = position[..., None] * frequencies(width // 2).to(position.device, torch.float32)
    return torch.cat([angle.sin(), angle.cos()], dim=-1)


def frequencies(count: int) -> Float[Tensor, " count"]:
    """Return `count` frequencies in radians per frame, in float64, decreasing from 1 towards 1 / `BASE`."""
    return BASE ** (-torch.arange(count, dtype=torch.float64) / count)


class Attention(nn.Module, ABC):
    """Attention between frames; subclasses define the sources of queries, keys and values.

    Args:
        width: Width of the frames and of the condition.
        heads: Number of heads, of `HEAD` channels each.
        custom_query_fn: Layer that merges a pose and a condition, if the subclass needs one.
    """

    def __init__(self, width: int, heads: int, custom_query_fn: nn.Linear | None = None) -> None:
        super().__init__()
        self.heads = heads
        if custom_query_fn is not None:  # first: optimiser states depend on the order of the parameters
            self.custom_query_fn = custom_query_fn
        self.to_q = nn.Linear(width, heads * HEAD, bias=False)
        self.to_k = nn.Linear(width, heads * HEAD, bias=False)
        self.to_v = nn.Linear(width, heads * HEAD, bias=False)
        self.to_out = nn.Linear(heads * HEAD, width, bias=False)

    @abstractmethod
    def sources(self, poses: Frames, condition: Frames) -> tuple[Frames, Frames]:
        """Return the source of the queries, and the source of the keys and values."""

    def forward(
        self, poses: Frames, condition: Frames, rotary: RotaryEmbedding, attend: Attend
    ) -> Float[Tensor, "batch frames width"]:
        query_source, key_source = self.sources(poses, condition)
        query, key, value = (
            self._split(tensor) for tensor in (self.to_q(query_source), self.to_k(key_source), self.to_v(key_source))
        )
        output = attend(rotary(query), rotary(key), value)
        return self.to_out(rearrange(output, "batch heads frames channels -> batch frames (heads channels)"))

    def scores(
        self, poses: Frames, condition: Frames, rotary: RotaryEmbedding, attend: Attend
    ) -> Float[Tensor, "batch heads frames frames"]:
        """Compute how much each frame attends to each frame, [batch, heads, frames, frames].

        The scores are the attention output for one-hot values.

        Args:
            poses: Frames, [batch, frames, width].
            condition: Condition of each frame, of the same shape.
            rotary: Rotary positions.
            attend: Attention function of an `AttentionMask`.
        """
        query_source, key_source = self.sources(poses, condition)
        query, key = self._split(self.to_q(query_source)), self._split(self.to_k(key_source))
        one_hot = torch.eye(poses.shape[1], dtype=query.dtype, device=query.device)
        return attend(rotary(query), rotary(key), one_hot.expand(*query.shape[:2], -1, -1))

    def _split(self, values: Tensor) -> Heads:
        return rearrange(values, "batch frames (heads channels) -> batch heads frames channels", heads=self.heads)


class PoseCentricAttention(Attention):
    """Pose-centric cross-attention: the condition influences the query of a frame and nothing else (Eq. 3)."""

    def __init__(self, width: int, heads: int) -> None:
        super().__init__(width, heads, nn.Linear(2 * width, width))

    def sources(self, poses: Frames, condition: Frames) -> tuple[Frames, Frames]:
        """Return the merged pose and condition for queries, and the pose for keys and values."""
        return self.custom_query_fn(torch.cat([poses, condition], dim=-1)), poses


class ConditionedAttention(PoseCentricAttention):
    """Self-attention of merged poses and conditions: both influence query, key and value (Eq. 2)."""

    def sources(self, poses: Frames, condition: Frames) -> tuple[Frames, Frames]:
        """Return the merged pose and condition for queries, keys and values."""
        conditioned, _ = super().sources(poses, condition)
        return conditioned, conditioned


class SelfAttention(Attention):
    """Self-attention of poses, without a condition."""

    def sources(self, poses: Frames, condition: Frames) -> tuple[Frames, Frames]:
        """Return the pose for queries, keys and values."""
        return poses, poses


class CrossAttention(Attention):
    """Cross-attention of poses to the conditions of the frames."""

    def sources(self, poses: Frames, condition: Frames) -> tuple[Frames, Frames]:
        """Return the pose for queries, and the condition for keys and values."""
        return poses, condition


Conditioning = Literal["pccat", "sat", "cat"]
"""The conditioning of frames: pose-centric cross-attention; self-attention of poses and conditions; or self-attention
of poses followed by cross-attention to conditions (section 4.1, "Implementation details")."""

ATTENTION: Mapping[Conditioning, tuple[type[Attention], ...]] = {
    "pccat": (PoseCentricAttention,),
    "sat": (ConditionedAttention,),
    "cat": (SelfAttention, CrossAttention),
}
"""The attention blocks of one layer, in order."""


class Feedforward(nn.Module):
    """Two linear layers with an exact GELU between them, under the published names."""

    def __init__(self, width: int, inner: int) -> None:
        super().__init__()
        first = nn.Sequential(nn.Linear(width, inner), nn.GELU())
        self.ff = nn.Sequential(first, nn.Identity(), nn.Identity(), nn.Linear(inner, width))

    def forward(self, frames: Float[Tensor, "batch frames width"]) -> Float[Tensor, "batch frames width"]:
        return self.ff(frames)


class Layers(nn.Module):
    """Alternating attention and feed-forward blocks with pre-norm and residual connections, and a final norm.

    In training each block is skipped with probability `stochastic_depth`, for the whole batch (Huang et al. 2016).
    """

    def __init__(
        self, width: int, inner: int, count: int, heads: int, stochastic_depth: float, conditioning: Conditioning
    ) -> None:
        super().__init__()
        blocks = [
            block
            for _ in range(count)
            for block in (*(kind(width, heads) for kind in ATTENTION[conditioning]), Feedforward(width, inner))
        ]
        self.layers = nn.ModuleList(nn.ModuleList([nn.ModuleList([nn.LayerNorm(width)]), block]) for block in blocks)
        self.final_norm = nn.LayerNorm(width)
        self.stochastic_depth = stochastic_depth

    def forward(self, frames: Float[Tensor, "batch frames width"], *attention: object) -> Tensor:
        layer: Any  # a `ModuleList` does not declare the types of its modules
        for layer in self.layers:
            (norm,), block = layer
            normed = norm(frames)
            out = block(normed, *attention) if isinstance(block, Attention) else block(normed)
            if self.training and self.stochastic_depth:
                # Multiply by 0 instead of skipping: distributed training needs a gradient for every weight.
                out = out * (torch.rand((), device=out.device) >= self.stochastic_depth)
            frames = frames + out
        return self.final_norm(frames)
