"""MDM: the motion diffusion model of Tevet et al. (2023), in its two published architectures.

Parameter names and shapes are those of the published checkpoints, but for their tables of positions, which follow from
a formula. Knows nothing of what the features mean, nor of schedules; that zeros tell it of no text is the affair of the
text encoder (`stmc.text.EmptyAsZeros`).
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
"""What a token in front of the frames tells: the step alone (in the published code since 2025), or with the text."""


class _Mdm(Network):
    """What both architectures share. See `MdmEncoder` for the arguments."""

    ends = "input_process.poseEmbedding", "output_process.poseFinal"

    def __init__(
        self, features: int, text_width: int, width: int, heads: int, dropout: float, fixed_length: int | None
    ) -> None:
        super().__init__()
        if width % heads or width % 2:
            raise ValueError(f"width {width} must be even and a multiple of heads ({heads})")
        if fixed_length is not None and not 1 <= fixed_length < POSITIONS:
            raise ValueError(f"fixed_length must be 1 to {POSITIONS - 1} frames, not {fixed_length}")
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
        """The words as tokens."""
        return self.embed_text(text)

    def _step(self, t: Int[Tensor, " batch"]) -> Float[Tensor, "batch 1 width"]:
        return self.embed_timestep["time_embed"](self.positions[t])[:, None]

    def _told(self, step: Tensor, text: Tensor) -> Float[Tensor, "batch 1 width"]:
        """Step and text in one token."""
        if text.shape[1] != 1:
            raise ValueError(f"{type(self).__name__} reads one word a text here, not {text.shape[1]}")
        return step + text

    def _tokens(self, leading: Tensor, x: Tensor) -> Float[Tensor, "batch _ width"]:
        """Tokens in front of the frames (of none to a few), and the frames; with their positions."""
        tokens = torch.cat([leading, self.input_process["poseEmbedding"](x)], dim=1)
        if tokens.shape[1] > POSITIONS:
            raise ValueError(f"{tokens.shape[1]} tokens exceed the {POSITIONS} known positions")
        return self.dropout(tokens + self.positions[: tokens.shape[1]])


class MdmEncoder(_Mdm):
    """MDM's `trans_enc`: one token for step and text together, then one per frame, through post-norm layers.

    `features` numbers per frame, `text_width` numbers in the one word of a text; `width` of a token, `feedforward`
    width inside a layer. `fixed_length`: as published the network was trained on clips padded to 196 frames without
    being told, so that it expects as many of every crop; None is for checkpoints trained with `mask_frames`, which
    attend to a crop's own frames only. The output has no mask applied: padded frames carry arbitrary values.
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
        """See `Denoiser`."""
        tokens = self._tokens(self._told(self._step(t), text), x)
        tokens = self.seqTransEncoder(tokens, _attended(1, mask))
        return self.output_process["poseFinal"](tokens[:, 1:])


class MdmDecoder(_Mdm):
    """MDM's `trans_dec`: one token per frame; each layer attends to the words of the text, the step added to each.

    `leading` is the checkpoints' `emb_trans_dec`: a token in front of the frames that tells the step, or step and text
    (then a text has one word); None has no such token. The other arguments are those of `MdmEncoder`.
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
        """See `Denoiser`."""
        step = self._step(t)
        leading = self._in_front(step, text)
        tokens = self._tokens(leading, x)
        attended = _attended(leading.shape[1], mask)
        tokens = self.seqTransDecoder(tokens, step + text, attended, heads_of(text_mask))
        return self.output_process["poseFinal"](tokens[:, leading.shape[1] :])

    def _in_front(self, step: Float[Tensor, "batch 1 width"], text: Tensor) -> Float[Tensor, "batch _ width"]:
        if self.leading == "step_and_text":
            return self._told(step, text)
        return step if self.leading == "step" else step[:, :0]


def _attended(leading: int, mask: Bool[Tensor, "batch frames"] | None) -> Attended:
    """The mask of the frames, with tokens in front of them that are always there."""
    return None if mask is None else heads_of(torch.nn.functional.pad(mask, (leading, 0), value=True))
