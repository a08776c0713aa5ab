"""MDM-SMPL: the transformer denoiser of STMC (section 3.4, appendix D).

Parameter names and shapes are those of the published checkpoint, so that its `denoiser.*` weights load strictly.
Independent of the meaning of the features and of schedules.
"""

from __future__ import annotations

import torch
from einops import repeat
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from stmc.denoisers.layers import POSITIONS, PreNormLayer, Stack, heads_of
from stmc.denoisers.network import Network
from stmc.diffusion.tensors import sinusoids


class MdmSmpl(Network):
    """Transformer over one token for the step, the words of the text, registers, and one token per frame.

    The output is not masked: padded frames carry arbitrary values.

    Args:
        features: Number of features per frame.
        text_width: Width of a word embedding.
        width: Width of a token.
        feedforward: Width of the feed-forward layers.
        layers: Number of layers.
        heads: Number of attention heads.
        dropout: Dropout probability.
        registers: Number of register tokens.
        words: Registers and frames take the positions after this many words, however many words the longest text of the
            batch has, so that a sample does not depend on its batch. None places them after that text, as published
            (the published network reads one word per text).

    Raises:
        ValueError: If `width` is odd or not a multiple of `heads`.
    """

    ends = "skel_embedding", "to_skel_layer"
    positions: Tensor

    def __init__(
        self,
        features: int,
        text_width: int,
        width: int = 512,
        feedforward: int = 2048,
        layers: int = 8,
        heads: int = 8,
        dropout: float = 0.1,
        registers: int = 2,
        words: int | None = None,
    ) -> None:
        super().__init__()
        self.words = words
        self.supports_padding = words is not None  # otherwise the longest text of the batch shifts the frames
        if width % heads or width % 2:
            raise ValueError(f"width {width} must be even and a multiple of heads ({heads})")
        self.tx_embedding = nn.Sequential(
            nn.Linear(text_width, 2 * width), nn.GELU(), nn.Linear(2 * width, width), nn.LayerNorm(width)
        )
        self.skel_embedding = nn.Linear(features, width)
        self.timestep_encoder = _StepEncoder(width)
        self.registers = nn.Parameter(torch.randn(registers, width))
        self.seqTransEncoder = Stack([PreNormLayer(width, feedforward, heads, dropout) for _ in range(layers)])
        self.to_skel_layer = nn.Linear(width, features)
        self.dropout = nn.Dropout(dropout)
        self.register_buffer("positions", sinusoids(POSITIONS, width), persistent=False)

    def encode_text(
        self, text: Float[Tensor, "batch words width"], text_mask: Bool[Tensor, "batch words"] | None = None
    ) -> Float[Tensor, "batch words encoded"]:
        """Project the words to tokens."""
        return self.tx_embedding(text)

    def denoise(
        self,
        x: Float[Tensor, "batch frames features"],
        t: Int[Tensor, " batch"],
        text: Float[Tensor, "batch words encoded"],
        text_mask: Bool[Tensor, "batch words"] | None = None,
        mask: Bool[Tensor, "batch frames"] | None = None,
    ) -> Float[Tensor, "batch frames features"]:
        """Predict for the noisy crops `x` at steps `t`; see `Denoiser`."""
        batch, frames, _ = x.shape
        step = self.timestep_encoder(self.positions[t])
        registers = repeat(self.registers, "words width -> batch words width", batch=batch)
        tokens = torch.cat([step[:, None], text, registers, self.skel_embedding(x)], dim=1)
        tokens = self.dropout(tokens + self._positional_encoding(tokens.shape[1], text.shape[1]))
        tokens = self.seqTransEncoder(tokens, self._attention_mask(text, text_mask, x, mask))
        return self.to_skel_layer(tokens[:, -frames:])

    def _positional_encoding(self, tokens: int, words: int) -> Float[Tensor, "tokens width"]:
        """Return the positional encoding of every token: step and words from 0 on, then registers and frames."""
        rest = tokens - 1 - words
        first = 1 + (words if self.words is None else self.words)
        if max(tokens, first + rest) > POSITIONS:
            raise ValueError(f"{tokens} tokens ({words} words) exceed the {POSITIONS} positions of the table")
        return torch.cat([self.positions[: 1 + words], self.positions[first : first + rest]])

    def _attention_mask(self, text: Tensor, text_mask: Tensor | None, x: Tensor, mask: Tensor | None) -> Tensor | None:
        """Return the mask of tokens that may be attended to, [batch, 1, 1, tokens]; None means all tokens."""
        if heads_of(text_mask) is None and heads_of(mask) is None:
            return None
        text_mask = x.new_ones(text.shape[:2], dtype=torch.bool) if text_mask is None else text_mask
        mask = x.new_ones(x.shape[:2], dtype=torch.bool) if mask is None else mask
        step = mask.new_ones(len(x), 1)
        registers = mask.new_ones(len(x), len(self.registers))
        return heads_of(torch.cat([step, text_mask, registers, mask], dim=1))


class _StepEncoder(nn.Module):
    def __init__(self, width: int) -> None:
        super().__init__()
        self.time_embed = nn.Sequential(nn.Linear(width, width), nn.SiLU(), nn.Linear(width, width))

    def forward(self, row: Float[Tensor, "batch width"]) -> Float[Tensor, "batch width"]:
        return self.time_embed(row)
