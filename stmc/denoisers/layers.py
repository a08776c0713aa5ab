"""Building blocks of transformer denoisers, with the parameter names of PyTorch.

Names and shapes are those of `nn.MultiheadAttention`, `nn.TransformerEncoderLayer` and `nn.TransformerDecoderLayer`, so
that published weights load. Independent of motion and texts.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from einops import rearrange
from jaxtyping import Bool, Float
from torch import Tensor, nn

POSITIONS = 5000
"""Rows of the positional table: the maximum number of steps and of tokens."""

Attended = Bool[Tensor, "batch 1 1 _"] | None
"""Mask of the tokens that may be attended to; None, which is much faster, means all tokens."""


class Attention(nn.Module):
    """Self-attention of tokens, or cross-attention to a memory, with the parameter names of `nn.MultiheadAttention`.

    The attention weights have no dropout, because dropout would rule out the fused kernels.
    """

    def __init__(self, width: int, heads: int) -> None:
        super().__init__()
        self.heads = heads
        self.in_proj_weight = nn.Parameter(torch.empty(3 * width, width))
        self.in_proj_bias = nn.Parameter(torch.zeros(3 * width))
        self.out_proj = nn.Linear(width, width)
        nn.init.xavier_uniform_(self.in_proj_weight)
        nn.init.zeros_(self.out_proj.bias)

    def forward(
        self, tokens: Float[Tensor, "batch _ width"], attended: Attended = None, memory: Tensor | None = None
    ) -> Float[Tensor, "batch _ width"]:
        if memory is None:
            query, key, value = self._project(tokens, slice(None))
        else:
            width = tokens.shape[-1]
            [query] = self._project(tokens, slice(width))
            key, value = self._project(memory, slice(width, None))
        output = F.scaled_dot_product_attention(query, key, value, attn_mask=attended)
        return self.out_proj(rearrange(output, "batch heads words width -> batch words (heads width)"))

    def _project(self, tokens: Tensor, rows: slice) -> Tensor:
        projected = F.linear(tokens, self.in_proj_weight[rows], self.in_proj_bias[rows])
        width = tokens.shape[-1] // self.heads
        return rearrange(
            projected, "batch words (kind heads width) -> kind batch heads words width", heads=self.heads, width=width
        )


class PreNormLayer(nn.Module):
    """`nn.TransformerEncoderLayer` with norm_first=True and an exact GELU."""

    def __init__(self, width: int, feedforward: int, heads: int, dropout: float) -> None:
        super().__init__()
        self.self_attn = Attention(width, heads)
        self.linear1 = nn.Linear(width, feedforward)
        self.linear2 = nn.Linear(feedforward, width)
        self.norm1 = nn.LayerNorm(width)
        self.norm2 = nn.LayerNorm(width)
        self.dropout = nn.Dropout(dropout)

    def forward(self, tokens: Float[Tensor, "batch words width"], attended: Attended = None) -> Tensor:
        tokens = tokens + self.dropout(self.self_attn(self.norm1(tokens), attended))
        hidden = self.dropout(F.gelu(self.linear1(self.norm2(tokens))))
        return tokens + self.dropout(self.linear2(hidden))


class PostNormLayer(PreNormLayer):
    """`nn.TransformerEncoderLayer` with norm_first=False and an exact GELU."""

    def forward(self, tokens: Float[Tensor, "batch words width"], attended: Attended = None) -> Tensor:
        tokens = self.norm1(tokens + self.dropout(self.self_attn(tokens, attended)))
        hidden = self.dropout(F.gelu(self.linear1(tokens)))
        return self.norm2(tokens + self.dropout(self.linear2(hidden)))


class DecoderLayer(nn.Module):
    """`nn.TransformerDecoderLayer` with norm_first=False and an exact GELU."""

    def __init__(self, width: int, feedforward: int, heads: int, dropout: float) -> None:
        super().__init__()
        self.self_attn = Attention(width, heads)
        self.multihead_attn = Attention(width, heads)
        self.linear1 = nn.Linear(width, feedforward)
        self.linear2 = nn.Linear(feedforward, width)
        self.norm1 = nn.LayerNorm(width)
        self.norm2 = nn.LayerNorm(width)
        self.norm3 = nn.LayerNorm(width)
        self.dropout = nn.Dropout(dropout)

    def forward(
        self,
        tokens: Float[Tensor, "batch _ width"],
        memory: Float[Tensor, "batch _ width"],
        attended: Attended = None,
        memory_attended: Attended = None,
    ) -> Tensor:
        tokens = self.norm1(tokens + self.dropout(self.self_attn(tokens, attended)))
        tokens = self.norm2(tokens + self.dropout(self.multihead_attn(tokens, memory_attended, memory)))
        hidden = self.dropout(F.gelu(self.linear1(tokens)))
        return self.norm3(tokens + self.dropout(self.linear2(hidden)))


class Stack(nn.Module):
    """A sequence of layers that share all other arguments, without a final norm."""

    def __init__(self, layers: list[nn.Module]) -> None:
        super().__init__()
        self.layers = nn.ModuleList(layers)

    def forward(self, tokens: Float[Tensor, "batch words width"], *others: Tensor | None) -> Tensor:
        for layer in self.layers:
            tokens = layer(tokens, *others)
        return tokens


def heads_of(mask: Bool[Tensor, "batch words"] | None) -> Attended:
    """Convert a mask to the form of `Attention`: [batch, 1, 1, words], or None if all words may be attended to.

    A full mask is detected on the CPU only, because reading a mask on an accelerator would wait for all queued work;
    callers on an accelerator pass None instead.
    """
    if mask is None or (mask.device.type == "cpu" and bool(mask.all())):
        return None
    return rearrange(mask, "batch words -> batch 1 1 words")
