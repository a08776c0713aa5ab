"""FlowMDM: a sequence of any length, with a text for every frame, denoised as one (Barquero et al. 2024).

Two encodings of time are blended: in the noisier steps a frame knows its place in its own segment and sees that segment
alone; in the others it knows the distance to its neighbours and sees across. Parameter names and shapes are those of
the published checkpoints, but for tables that follow from a formula. Knows nothing of what the features mean, nor of
schedules and timelines.
"""

from __future__ import annotations

from typing import Literal, get_args

import torch
from einops import rearrange
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from stmc.denoisers.flow_mdm_layers import (
    ATTENTION,
    AttentionMask,
    Conditioning,
    Layers,
    RotaryEmbedding,
    absolute_positions,
)
from stmc.denoisers.layers import POSITIONS
from stmc.denoisers.network import Network
from stmc.diffusion.tensors import sinusoids

BPE_TRAINING_RATIO = 0.5
"""The share of the rows in training that have relative positions, not absolute ones (blended positional encodings)."""

Positions = Literal["blended", "absolute", "relative"]
"""Both encodings of time, in training by chance and in sampling by the step; or one of them alone."""


class FlowMdm(Network):
    """A `Denoiser` of crops with one text each, or of sequences of many segments with a text each: see `denoise`.

    `features` numbers per frame, `text_width` numbers in the one word of a text; `width` of a frame inside,
    `feedforward` width inside a layer. A frame sees at most `attention_window` frames to either side. The steps from
    `absolute_from` on (0 is the least noisy) are taken with absolute positions, those below with relative ones; 0: all
    absolute. More absolute steps keep more to the texts, fewer make smoother transitions (Fig. 5). In training each row
    is relative or absolute by chance, whatever its step. `dropout` acts on the frames where they come in,
    `stochastic_depth` is the probability to skip a layer's half.

    Two settings are the paper's ablations (Tables 3 and 4). `positions`: with "absolute" or "relative" there is no
    other encoding, in training or in sampling, and `absolute_from` means nothing. `conditioning`: "pccat" is the
    method; "sat" lets the condition into keys and values, too, with the same weights; "cat" has a cross-attention to
    the conditions of the frames that a frame sees. These two are our reading of section 4.1: their code is not
    published.
    """

    ends = "input_process.poseEmbedding", "output_process.poseFinal"
    per_frame_text = True

    def __init__(
        self,
        features: int,
        text_width: int,
        absolute_from: int,
        width: int = 512,
        feedforward: int = 1024,
        layers: int = 8,
        heads: int = 4,
        attention_window: int = 150,
        dropout: float = 0.1,
        stochastic_depth: float = 0.1,
        positions: Positions = "blended",
        conditioning: Conditioning = "pccat",
    ) -> None:
        super().__init__()
        if width % 2:
            raise ValueError(f"width {width} must be even")
        if attention_window < 1 or absolute_from < 0:
            raise ValueError(
                f"attention_window {attention_window} must be at least 1, absolute_from {absolute_from} at least 0"
            )
        if positions not in get_args(Positions) or conditioning not in ATTENTION:
            choices = f"positions from {', '.join(get_args(Positions))}, conditioning from {', '.join(ATTENTION)}"
            raise ValueError(f"unknown positions {positions!r} or conditioning {conditioning!r}; choose {choices}")
        self.attention_window, self._encodings = attention_window, positions
        self.absolute_from = absolute_from if positions == "blended" else None
        self.input_process = nn.ModuleDict({"poseEmbedding": nn.Linear(features, width)})
        time_embed = nn.Sequential(nn.Linear(width, width), nn.SiLU(), nn.Linear(width, width))
        self.embed_timestep = nn.ModuleDict({"time_embed": time_embed})
        self.embed_text = nn.Linear(text_width, width)
        self.seqTransEncoder = _Encoder(width, feedforward, layers, heads, dropout, stochastic_depth, conditioning)
        self.output_process = nn.ModuleDict({"poseFinal": nn.Linear(width, features)})
        self.register_buffer("positions", sinusoids(POSITIONS, width), persistent=False)

    def encode_text(
        self, text: Float[Tensor, "batch words width"], text_mask: Bool[Tensor, "batch words"] | None = None
    ) -> Float[Tensor, "batch words encoded"]:
        """The texts, each of them one word, as the network's own."""
        return self.embed_text(text)

    def denoise(
        self,
        x: Float[Tensor, "batch frames features"],
        t: Int[Tensor, " batch"],
        text: Float[Tensor, "batch words encoded"],
        text_mask: Bool[Tensor, "batch words"] | None = None,
        mask: Bool[Tensor, "batch frames"] | None = None,
        segment: Int[Tensor, "batch frames"] | None = None,
        absolute_from: int | None = None,
    ) -> Float[Tensor, "batch frames features"]:
        """See `Denoiser`. With `segment`, which says of every frame to which segment it belongs, `text` has a word for
        each of a row's segments; without it, a row is one segment. A segment may be interrupted by others.
        `absolute_from`: None is the network's own."""
        return self.blended(x, t, text, self._absolute(t, absolute_from), mask, segment)

    def forward(
        self,
        x: Float[Tensor, "batch frames features"],
        t: Int[Tensor, " batch"],
        text: Float[Tensor, "batch words width"],
        text_mask: Bool[Tensor, "batch words"] | None = None,
        mask: Bool[Tensor, "batch frames"] | None = None,
        segment: Int[Tensor, "batch frames"] | None = None,
    ) -> Float[Tensor, "batch frames features"]:
        """See `denoise`, for a text that is not encoded yet."""
        return self.denoise(x, t, self.encode_text(text), text_mask, mask, segment)

    def _absolute(self, t: Int[Tensor, " batch"], absolute_from: int | None) -> Bool[Tensor, " batch"]:
        """Which rows have absolute positions."""
        if self._encodings != "blended":
            return torch.full_like(t, self._encodings == "absolute", dtype=torch.bool)
        if self.training:
            return torch.rand(len(t), device=t.device) >= BPE_TRAINING_RATIO
        return t >= (self.absolute_from if absolute_from is None else absolute_from)

    def blended(
        self,
        x: Float[Tensor, "batch frames features"],
        t: Int[Tensor, " batch"],
        text: Float[Tensor, "batch words encoded"],
        absolute: Bool[Tensor, " batch"],
        mask: Bool[Tensor, "batch frames"] | None = None,
        segment: Int[Tensor, "batch frames"] | None = None,
    ) -> Float[Tensor, "batch frames features"]:
        """The prediction where `absolute` says which rows are taken with absolute positions, and not their steps."""
        if segment is None and text.shape[1] != 1:
            raise ValueError(f"{text.shape[1]} words a text: FlowMdm reads one, or one for each segment")
        step = self.embed_timestep["time_embed"](self.positions[t])[:, None]
        words = text if segment is None else text.take_along_dim(segment[..., None], dim=1)
        condition = (step + words).expand(-1, x.shape[1], -1)
        alone = torch.arange(x.shape[1], device=x.device)[None]
        position = alone if segment is None else _positions(segment, text.shape[1])
        attention_mask = AttentionMask(x.shape[1], self.attention_window, mask, segment, absolute)
        frames = self.input_process["poseEmbedding"](x)
        return self.output_process["poseFinal"](self.seqTransEncoder(frames, condition, position, attention_mask))


class _Encoder(nn.Module):
    def __init__(
        self,
        width: int,
        feedforward: int,
        layers: int,
        heads: int,
        dropout: float,
        stochastic_depth: float,
        conditioning: Conditioning,
    ) -> None:
        super().__init__()
        self.project_in = nn.Linear(width, width)
        self.pos_emb = nn.ModuleDict({"absolute": _Scale(width**-0.5)})
        self.dropout = nn.Dropout(dropout)
        self.attn_layers = Layers(width, feedforward, layers, heads, stochastic_depth, conditioning)
        self.project_out = nn.Linear(width, width)

    def forward(self, frames: Tensor, condition: Tensor, position: Tensor, attention_mask: AttentionMask) -> Tensor:
        frames = self.project_in(frames)
        place = self.pos_emb["absolute"](absolute_positions(position, frames.shape[-1]))
        absolute = rearrange(attention_mask.within_segment, "batch -> batch 1 1")
        frames = self.dropout(frames + torch.where(absolute, place, 0.0))
        rotary = RotaryEmbedding.of(frames.shape[1], ~attention_mask.within_segment)
        return self.project_out(self.attn_layers(frames, condition, rotary, attention_mask.attention()))


class _Scale(nn.Module):
    def __init__(self, initial: float) -> None:
        super().__init__()
        self.scale = nn.Parameter(torch.full((1,), initial))

    def forward(self, values: Tensor) -> Tensor:
        return values * self.scale


def _positions(segment: Int[Tensor, "batch frames"], segments: int) -> Int[Tensor, "batch frames"]:
    """Of every frame, counted from the first one of its segment."""
    frame = torch.arange(segment.shape[1], device=segment.device).expand_as(segment)
    first = segment.new_full((len(segment), segments), segment.shape[1])
    return frame - first.scatter_reduce(1, segment, frame, "amin").take_along_dim(segment, dim=1)
