"""FlowMDM: denoises a sequence of any length, with a text for every frame, as a whole (Barquero et al. 2024).

Two positional encodings are blended. In the noisier steps a frame is encoded by its absolute position in its segment
and attends to that segment only. In the other steps frames are encoded by their relative distance and attend across
segments. Parameter names and shapes are those of the published checkpoints, except for tables that follow from a
formula. Independent of the meaning of the features, of schedules and of timelines.
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
"""The fraction of training rows with relative instead of absolute positions (blended positional encodings)."""

Positions = Literal["blended", "absolute", "relative"]
""""blended" uses both encodings, at random in training and by step in sampling; the others use one encoding only."""


class FlowMdm(Network):
    """A `Denoiser` of crops with one text each, or of sequences of many segments with one text each (see `denoise`).

    In training each row is relative or absolute at random, whatever its step. `positions` and `conditioning` select the
    ablations of the paper (Tables 3 and 4). "sat" and "cat" follow our reading of section 4.1, because their code is
    not published.

    Args:
        features: Number of features per frame.
        text_width: Width of a text embedding; a text has one word.
        absolute_from: Steps from this one on (0 is the least noisy) use absolute positions, lower steps relative ones;
            0 makes all steps absolute. More absolute steps follow the texts more closely, fewer make smoother
            transitions (Fig. 5).
        width: Width of a frame inside the network.
        feedforward: Width of the feed-forward layers.
        layers: Number of layers.
        heads: Number of attention heads.
        attention_window: A frame attends to at most this many frames on either side.
        dropout: Dropout of the input frames.
        stochastic_depth: Probability of skipping an attention or feed-forward block in training.
        positions: "absolute" or "relative" uses that encoding alone, in training and in sampling, and ignores
            `absolute_from`.
        conditioning: "pccat" is the published method. "sat" also feeds the condition to keys and values, with the same
            weights. "cat" adds cross-attention to the conditions of the visible frames.

    Raises:
        ValueError: If `width` is odd, `attention_window` is below 1, `absolute_from` is negative, or a choice is
            unknown.
    """

    ends = "input_process.poseEmbedding", "output_process.poseFinal"
    per_frame_text = True
    positions: Tensor

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
                f"attention_window {attention_window} must be at least 1 and absolute_from {absolute_from} at least 0"
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
        """Project the texts, one word each, to the width of the network."""
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
        """Predict for noisy sequences; see `Denoiser`.

        Args:
            x: Noisy motion, [batch, frames, features].
            t: Diffusion step of each row, [batch].
            text: Encoded texts: one word per row, or one word per segment if `segment` is given.
            text_mask: Unused; all words are present.
            mask: True at frames, False in the padding, [batch, frames].
            segment: Index of the segment that each frame belongs to, [batch, frames]. None makes each row one segment.
                Other segments may interrupt a segment.
            absolute_from: Overrides the attribute of the network; None keeps it.
        """
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
        """Encode the text and call `denoise`."""
        return self.denoise(x, t, self.encode_text(text), text_mask, mask, segment)

    def _absolute(self, t: Int[Tensor, " batch"], absolute_from: int | None) -> Bool[Tensor, " batch"]:
        """Return a mask of the rows with absolute positions."""
        if self._encodings != "blended":
            return torch.full_like(t, self._encodings == "absolute", dtype=torch.bool)
        if self.training:
            return torch.rand(len(t), device=t.device) >= BPE_TRAINING_RATIO
        lowest = self.absolute_from if absolute_from is None else absolute_from
        assert lowest is not None  # a blended network has it
        return t >= lowest

    def blended(
        self,
        x: Float[Tensor, "batch frames features"],
        t: Int[Tensor, " batch"],
        text: Float[Tensor, "batch words encoded"],
        absolute: Bool[Tensor, " batch"],
        mask: Bool[Tensor, "batch frames"] | None = None,
        segment: Int[Tensor, "batch frames"] | None = None,
    ) -> Float[Tensor, "batch frames features"]:
        """Predict with absolute positions in the rows selected by `absolute`, whatever their steps.

        Args:
            x: Noisy motion, [batch, frames, features].
            t: Diffusion step of each row, [batch].
            text: Encoded texts: one word per row, or one per segment.
            absolute: True at the rows with absolute positions, [batch].
            mask: True at frames, False in the padding, [batch, frames].
            segment: Index of the segment of each frame, [batch, frames]; None makes each row one segment.

        Raises:
            ValueError: If a text has several words and `segment` is None.
        """
        if segment is None and text.shape[1] != 1:
            raise ValueError(f"{text.shape[1]} words per text; FlowMdm reads one word, or one per segment")
        step = self.embed_timestep["time_embed"](self.positions[t])[:, None]
        words = text if segment is None else text.take_along_dim(segment[..., None], dim=1)
        condition = (step + words).expand(-1, x.shape[1], -1)
        row_position = torch.arange(x.shape[1], device=x.device)[None]
        position = row_position if segment is None else _positions(segment, text.shape[1])
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
        encoding = self.pos_emb["absolute"](absolute_positions(position, frames.shape[-1]))
        absolute = rearrange(attention_mask.within_segment, "batch -> batch 1 1")
        frames = self.dropout(frames + torch.where(absolute, encoding, 0.0))
        rotary = RotaryEmbedding.of(frames.shape[1], ~attention_mask.within_segment)
        return self.project_out(self.attn_layers(frames, condition, rotary, attention_mask.attention()))


class _Scale(nn.Module):
    def __init__(self, initial: float) -> None:
        super().__init__()
        self.scale = nn.Parameter(torch.full((1,), initial))

    def forward(self, values: Tensor) -> Tensor:
        return values * self.scale


def _positions(segment: Int[Tensor, "batch frames"], segments: int) -> Int[Tensor, "batch frames"]:
    """Return the position of every frame, counted from the first frame of its segment."""
    frame = torch.arange(segment.shape[1], device=segment.device).expand_as(segment)
    first = segment.new_full((len(segment), segments), segment.shape[1])
    return frame - first.scatter_reduce(1, segment, frame, "amin").take_along_dim(segment, dim=1)
