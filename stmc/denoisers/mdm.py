"""MDM: the motion diffusion model of Tevet et al. (2023), in its two published architectures.

Parameter names and shapes are those of the published checkpoints, except for the positional tables, which follow from a
formula. Independent of the meaning of the features and of schedules. The text encoder represents an empty text as zeros
(`stmc.text.EmptyAsZeros`).
"""

from __future__ import annotations

from typing import Literal, get_args

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from stmc.denoisers.layers import POSITIONS, Attended, DecoderLayer, PostNormLayer, Stack, heads_of
from stmc.denoisers.network import Network
from stmc.diffusion.tensors import sinusoids

Leading = Literal["step", "step_and_text"]
"""The token in front of the frames encodes the step alone (published code since 2025) or the step and the text."""


class _Mdm(Network):
    """Common parts of both architectures. See `MdmEncoder` for the arguments."""

    ends = "input_process.poseEmbedding", "output_process.poseFinal"
    positions: Tensor

    def __init__(
        self, features: int, text_width: int, width: int, heads: int, dropout: float, fixed_length: int | None
    ) -> None:
        super().__init__()
        if width % heads or width % 2:
            raise ValueError(f"width {width} must be even and a multiple of heads ({heads})")
        if fixed_length is not None and not 1 <= fixed_length < POSITIONS:
            raise ValueError(f"fixed_length {fixed_length} must be 1 to {POSITIONS - 1} frames")
        self.fixed_length = fixed_length
        self.input_process = nn.ModuleDict({"poseEmbedding": nn.Linear(features, width)})
        time_embed = nn.Sequential(nn.Linear(width, width), nn.SiLU(), nn.Linear(width, width))
        self.embed_timestep = nn.ModuleDict({"time_embed": time_embed})
        self.embed_text = nn.Linear(text_width, width)
        self.output_process = nn.ModuleDict({"poseFinal": nn.Linear(width, features)})
        self.dropout = nn.Dropout(dropout)
        self.register_buffer("positions", sinusoids(POSITIONS, width), persistent=False)

    def encode_text(
        self, text: Float[Tensor, "batch words width"], text_mask: Bool[Tensor, "batch words"] | None = None
    ) -> Float[Tensor, "batch words encoded"]:
        """Project the words to tokens."""
        return self.embed_text(text)

    def _step(self, t: Int[Tensor, " batch"]) -> Float[Tensor, "batch 1 width"]:
        return self.embed_timestep["time_embed"](self.positions[t])[:, None]

    def _merge_step_and_text(self, step: Tensor, text: Tensor) -> Float[Tensor, "batch 1 width"]:
        """Merge step and text into one token."""
        if text.shape[1] != 1:
            raise ValueError(f"{type(self).__name__} reads one word per text here; got {text.shape[1]}")
        return step + text

    def _tokens(self, leading: Tensor, x: Tensor) -> Float[Tensor, "batch _ width"]:
        """Concatenate the leading tokens (none to a few) and the frames, and add their positions."""
        tokens = torch.cat([leading, self.input_process["poseEmbedding"](x)], dim=1)
        if tokens.shape[1] > POSITIONS:
            raise ValueError(f"{tokens.shape[1]} tokens exceed the {POSITIONS} positions of the table")
        return self.dropout(tokens + self.positions[: tokens.shape[1]])


class MdmEncoder(_Mdm):
    """MDM's `trans_enc`: one token for step and text together, then one per frame, through post-norm layers.

    The output is not masked: padded frames carry arbitrary values.

    Args:
        features: Number of features per frame.
        text_width: Width of a text embedding; a text has one word.
        width: Width of a token.
        feedforward: Width of the feed-forward layers.
        layers: Number of layers.
        heads: Number of attention heads.
        dropout: Dropout probability.
        fixed_length: Number of frames that the network expects in every crop. The published networks were trained on
            clips padded to 196 frames without a mask. None is for checkpoints trained with `mask_frames`, which attend
            to a crop's own frames only.

    Raises:
        ValueError: If `width` is odd or not a multiple of `heads`, or `fixed_length` is out of range.
    """

    def __init__(
        self,
        features: int,
        text_width: int,
        width: int = 512,
        feedforward: int = 1024,
        layers: int = 8,
        heads: int = 4,
        dropout: float = 0.1,
        fixed_length: int | None = 196,
    ) -> None:
        super().__init__(features, text_width, width, heads, dropout, fixed_length)
        self.seqTransEncoder = Stack([PostNormLayer(width, feedforward, heads, dropout) for _ in range(layers)])

    def denoise(
        self,
        x: Float[Tensor, "batch frames features"],
        t: Int[Tensor, " batch"],
        text: Float[Tensor, "batch words encoded"],
        text_mask: Bool[Tensor, "batch words"] | None = None,
        mask: Bool[Tensor, "batch frames"] | None = None,
    ) -> Float[Tensor, "batch frames features"]:
        """Predict for noisy crops and an encoded text; see `Denoiser`."""
        tokens = self._tokens(self._merge_step_and_text(self._step(t), text), x)
        tokens = self.seqTransEncoder(tokens, _attention_mask(1, mask))
        return self.output_process["poseFinal"](tokens[:, 1:])


class MdmDecoder(_Mdm):
    """MDM's `trans_dec`: one token per frame; each layer attends to the words of the text, plus the step.

    Args:
        features: Number of features per frame.
        text_width: Width of a word embedding.
        width: Width of a token.
        feedforward: Width of the feed-forward layers.
        layers: Number of layers.
        heads: Number of attention heads.
        dropout: Dropout probability.
        fixed_length: See `MdmEncoder`.
        leading: The checkpoints' `emb_trans_dec`: a token in front of the frames that encodes the step, or step and
            text (then a text has one word). None adds no token.

    Raises:
        ValueError: As `MdmEncoder`, and if `leading` is unknown.
    """

    def __init__(
        self,
        features: int,
        text_width: int,
        width: int = 512,
        feedforward: int = 1024,
        layers: int = 8,
        heads: int = 4,
        dropout: float = 0.1,
        fixed_length: int | None = 196,
        leading: Leading | None = None,
    ) -> None:
        super().__init__(features, text_width, width, heads, dropout, fixed_length)
        if leading is not None and leading not in get_args(Leading):
            raise ValueError(f"unknown leading {leading!r}; choose from {', '.join(get_args(Leading))}, or None")
        self.leading = leading
        self.seqTransDecoder = Stack([DecoderLayer(width, feedforward, heads, dropout) for _ in range(layers)])

    def denoise(
        self,
        x: Float[Tensor, "batch frames features"],
        t: Int[Tensor, " batch"],
        text: Float[Tensor, "batch words encoded"],
        text_mask: Bool[Tensor, "batch words"] | None = None,
        mask: Bool[Tensor, "batch frames"] | None = None,
    ) -> Float[Tensor, "batch frames features"]:
        """Predict for noisy crops and an encoded text; see `Denoiser`."""
        step = self._step(t)
        leading = self._leading_tokens(step, text)
        tokens = self._tokens(leading, x)
        attended = _attention_mask(leading.shape[1], mask)
        tokens = self.seqTransDecoder(tokens, step + text, attended, heads_of(text_mask))
        return self.output_process["poseFinal"](tokens[:, leading.shape[1] :])

    def _leading_tokens(self, step: Float[Tensor, "batch 1 width"], text: Tensor) -> Float[Tensor, "batch _ width"]:
        if self.leading == "step_and_text":
            return self._merge_step_and_text(step, text)
        return step if self.leading == "step" else step[:, :0]


def _attention_mask(leading: int, mask: Bool[Tensor, "batch frames"] | None) -> Attended:
    """Extend the frame mask by leading tokens that are always present."""
    return None if mask is None else heads_of(torch.nn.functional.pad(mask, (leading, 0), value=True))
