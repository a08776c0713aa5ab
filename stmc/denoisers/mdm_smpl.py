"""MDM-SMPL: the transformer denoiser of STMC (section 3.4, appendix D).

Parameter names and shapes are those of the published checkpoint, so that its `denoiser.*` weights load strictly.
Knows nothing of what the features mean, nor of schedules.
"""

from __future__ import annotations

import math

import torch
import torch.nn.functional as F
from einops import rearrange, repeat
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

POSITIONS = 5000
"""Rows of the sinusoidal table: an upper bound of steps and of tokens."""


class MdmSmpl(nn.Module):
    """Transformer over one token for the step, the words of the text, registers, and one token per frame.

    `features` numbers per frame, `text_width` numbers per word of text; `width` of a token, `feedforward` width inside
    a layer. The output has no mask applied: padded frames carry arbitrary values.

    `words`: registers and frames take the positions behind this many words, however many the batch's longest text has,
    so that a sample does not depend on its batch; None: behind that text, as published (which reads one word a text).
    """

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
        if width % heads or width % 2:
            raise ValueError(f"width {width} must be even and a multiple of heads ({heads})")
        self.tx_embedding = nn.Sequential(
            nn.Linear(text_width, 2 * width), nn.GELU(), nn.Linear(2 * width, width), nn.LayerNorm(width)
        )
        self.skel_embedding = nn.Linear(features, width)
        self.timestep_encoder = _StepEncoder(width)
        self.registers = nn.Parameter(torch.randn(registers, width))
        self.seqTransEncoder = _Encoder(width, feedforward, layers, heads, dropout)
        self.to_skel_layer = nn.Linear(width, features)
        self.dropout = nn.Dropout(dropout)
        self.register_buffer("positions", _sinusoids(POSITIONS, width), persistent=False)

    def forward(
        self,
        x: Float[Tensor, "batch frames features"],
        t: Int[Tensor, " batch"],
        text: Float[Tensor, "batch words width"],
        text_mask: Bool[Tensor, "batch words"] | None = None,
        mask: Bool[Tensor, "batch frames"] | None = None,
    ) -> Float[Tensor, "batch frames features"]:
        """The prediction for the noisy crops `x` at steps `t`; see `Denoiser`."""
        batch, frames, _ = x.shape
        step = self.timestep_encoder(self.positions[t])
        registers = repeat(self.registers, "words width -> batch words width", batch=batch)
        tokens = torch.cat([step[:, None], self.tx_embedding(text), registers, self.skel_embedding(x)], dim=1)
        tokens = self.dropout(tokens + self._placed(tokens.shape[1], text.shape[1]))
        tokens = self.seqTransEncoder(tokens, self._attended(text, text_mask, x, mask))
        return self.to_skel_layer(tokens[:, -frames:])

    def _placed(self, tokens: int, words: int) -> Float[Tensor, "tokens width"]:
        """Rows of the table for every token: step and words from 0 on, then registers and frames."""
        rest = tokens - 1 - words
        first = 1 + (words if self.words is None else self.words)
        if max(tokens, first + rest) > POSITIONS:
            raise ValueError(f"{tokens} tokens ({words} words) exceed the {POSITIONS} known positions")
        return torch.cat([self.positions[: 1 + words], self.positions[first : first + rest]])

    def _attended(self, text: Tensor, text_mask: Tensor | None, x: Tensor, mask: Tensor | None) -> Tensor | None:
        """Which tokens may be attended to, [batch, 1, 1, tokens]; None where it is all of them: that is much faster."""
        text_mask, mask = _unless_full(text_mask), _unless_full(mask)
        if text_mask is None and mask is None:
            return None
        text_mask = torch.ones_like(text[..., 0], dtype=torch.bool) if text_mask is None else text_mask
        mask = torch.ones_like(x[..., 0], dtype=torch.bool) if mask is None else mask
        step = mask.new_ones(len(x), 1)
        registers = mask.new_ones(len(x), len(self.registers))
        attended = torch.cat([step, text_mask, registers, mask], dim=1)
        return rearrange(attended, "batch words -> batch 1 1 words")


class _StepEncoder(nn.Module):
    def __init__(self, width: int) -> None:
        super().__init__()
        self.time_embed = nn.Sequential(nn.Linear(width, width), nn.SiLU(), nn.Linear(width, width))

    def forward(self, row: Float[Tensor, "batch width"]) -> Float[Tensor, "batch width"]:
        return self.time_embed(row)


class _Encoder(nn.Module):
    def __init__(self, width: int, feedforward: int, layers: int, heads: int, dropout: float) -> None:
        super().__init__()
        self.layers = nn.ModuleList(_Layer(width, feedforward, heads, dropout) for _ in range(layers))

    def forward(self, tokens: Float[Tensor, "batch words width"], attended: Tensor | None) -> Tensor:
        for layer in self.layers:
            tokens = layer(tokens, attended)
        return tokens


class _Layer(nn.Module):
    """A pre-norm transformer layer with the parameter names of `nn.TransformerEncoderLayer`."""

    def __init__(self, width: int, feedforward: int, heads: int, dropout: float) -> None:
        super().__init__()
        self.self_attn = _Attention(width, heads)
        self.linear1 = nn.Linear(width, feedforward)
        self.linear2 = nn.Linear(feedforward, width)
        self.norm1 = nn.LayerNorm(width)
        self.norm2 = nn.LayerNorm(width)
        self.dropout = nn.Dropout(dropout)

    def forward(self, tokens: Float[Tensor, "batch words width"], attended: Tensor | None) -> Tensor:
        tokens = tokens + self.dropout(self.self_attn(self.norm1(tokens), attended))
        hidden = self.dropout(F.gelu(self.linear1(self.norm2(tokens))))
        return tokens + self.dropout(self.linear2(hidden))


class _Attention(nn.Module):
    """Self-attention with the parameter names of `nn.MultiheadAttention`.

    The attention weights have no dropout of their own: it would rule out the fused kernels.
    """

    def __init__(self, width: int, heads: int) -> None:
        super().__init__()
        self.heads = heads
        self.in_proj_weight = nn.Parameter(torch.empty(3 * width, width))
        self.in_proj_bias = nn.Parameter(torch.zeros(3 * width))
        self.out_proj = nn.Linear(width, width)
        nn.init.xavier_uniform_(self.in_proj_weight)
        nn.init.zeros_(self.out_proj.bias)

    def forward(self, tokens: Float[Tensor, "batch words width"], attended: Tensor | None) -> Tensor:
        projected = F.linear(tokens, self.in_proj_weight, self.in_proj_bias)
        query, key, value = rearrange(
            projected, "batch words (three heads width) -> three batch heads words width", three=3, heads=self.heads
        )
        mixed = F.scaled_dot_product_attention(query, key, value, attn_mask=attended)
        return self.out_proj(rearrange(mixed, "batch heads words width -> batch words (heads width)"))


def _unless_full(mask: Tensor | None) -> Tensor | None:
    # Looking into a mask on an accelerator would wait for everything queued there; callers say None instead.
    return None if mask is None or (mask.device.type == "cpu" and bool(mask.all())) else mask


def _sinusoids(rows: int, width: int) -> Float[Tensor, "_ width"]:
    """Positional table: sines in the even columns, cosines in the odd ones, wavelengths 2 pi to 20,000 pi."""
    frequency = torch.exp(torch.arange(0, width, 2).float() * (-math.log(10000.0) / width))
    angle = torch.arange(rows).float()[:, None] * frequency
    return rearrange([angle.sin(), angle.cos()], "two rows half -> rows (half two)")
