"""MotionDiffuse: the denoiser of Zhang et al. (2022), with linear attention and its own text transformer.

Parameter names and shapes are those of the published checkpoint without its copy of CLIP. The network predicts the
noise. Independent of the meaning of the features and of schedules.
"""

from __future__ import annotations

import math

import torch
import torch.nn.functional as F
from einops import rearrange
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from stmc.denoisers.layers import PostNormLayer, Stack, heads_of
from stmc.denoisers.network import Network


class MotionDiffuse(Network):
    """Blocks of self-attention, cross-attention to the text and feed-forward, each stylized by step and text.

    The first word represents the whole text: it must be the embedding at the end of the text (`stmc.text.ClipTokens`
    puts it there). The order of the other words is free, because the text transformer has no positions.

    Args:
        features: Number of features per frame.
        text_width: Width of a word embedding.
        width: Width of a frame's token.
        feedforward: Width of the feed-forward layers.
        layers: Number of blocks.
        heads: Number of attention heads.
        frames: Number of learned positions, the maximum length of a crop.
        text_latent_width: Width of the text transformer.
        text_feedforward: Width of the feed-forward layers of the text transformer.
        text_layers: Number of layers of the text transformer.
        text_heads: Number of heads of the text transformer.
        dropout: Dropout probability.

    Raises:
        ValueError: If `width` is odd or not a multiple of `heads`.
    """

    ends = "joint_embed", "out"

    def __init__(
        self,
        features: int,
        text_width: int,
        width: int = 512,
        feedforward: int = 1024,
        layers: int = 8,
        heads: int = 8,
        frames: int = 196,
        text_latent_width: int = 256,
        text_feedforward: int = 2048,
        text_layers: int = 4,
        text_heads: int = 4,
        dropout: float = 0.0,
    ) -> None:
        super().__init__()
        if width % heads or width % 2:
            raise ValueError(f"width {width} must be even and a multiple of heads ({heads})")
        self.sequence_embedding = nn.Parameter(torch.randn(frames, width))
        self.text_pre_proj = nn.Linear(text_width, text_latent_width)
        self.textTransEncoder = Stack(
            [PostNormLayer(text_latent_width, text_feedforward, text_heads, dropout) for _ in range(text_layers)]
        )
        self.text_ln = nn.LayerNorm(text_latent_width)
        stylization_width = 4 * width
        self.text_proj = nn.Sequential(nn.Linear(text_latent_width, stylization_width))
        self.joint_embed = nn.Linear(features, width)
        self.time_embed = nn.Sequential(
            nn.Linear(width, stylization_width), nn.SiLU(), nn.Linear(stylization_width, stylization_width)
        )
        self.temporal_decoder_blocks = nn.ModuleList(
            _Block(width, feedforward, heads, text_latent_width, stylization_width, dropout) for _ in range(layers)
        )
        self.out = nn.Linear(width, features)

    def encode_text(
        self, text: Float[Tensor, "batch words width"], text_mask: Bool[Tensor, "batch words"] | None = None
    ) -> Float[Tensor, "batch words encoded"]:
        """Encode the words with the text transformer."""
        return self.text_ln(self.textTransEncoder(self.text_pre_proj(text), heads_of(text_mask)))

    def denoise(
        self,
        x: Float[Tensor, "batch frames features"],
        t: Int[Tensor, " batch"],
        text: Float[Tensor, "batch words encoded"],
        text_mask: Bool[Tensor, "batch words"] | None = None,
        mask: Bool[Tensor, "batch frames"] | None = None,
    ) -> Float[Tensor, "batch frames features"]:
        """Predict the noise; see `Denoiser`.

        Raises `ValueError` if there are more frames than learned positions.
        """
        frames, positions = x.shape[1], len(self.sequence_embedding)
        if frames > positions:
            raise ValueError(f"{frames} frames exceed the {positions} learned positions of MotionDiffuse")
        stylization = self.time_embed(self._waves(t).to(x)) + self.text_proj(text[:, 0])
        tokens = self.joint_embed(x) + self.sequence_embedding[:frames]
        for block in self.temporal_decoder_blocks:
            tokens = block(tokens, text, stylization[:, None], text_mask, mask)
        return self.out(tokens)

    def _waves(self, t: Int[Tensor, " batch"]) -> Float[Tensor, "batch width"]:
        """Encode steps as cosines followed by sines, with wavelengths 2 pi to nearly 20,000 pi."""
        half = self.sequence_embedding.shape[1] // 2
        frequency = torch.exp(torch.arange(half, device=t.device).float() * (-math.log(10000.0) / half))
        angle = t[:, None].float() * frequency
        return torch.cat([angle.cos(), angle.sin()], dim=-1)


class _Block(nn.Module):
    def __init__(
        self, width: int, feedforward: int, heads: int, text_latent_width: int, stylization_width: int, dropout: float
    ) -> None:
        super().__init__()
        self.sa_block = _LinearAttention(width, width, heads, stylization_width, dropout)
        self.ca_block = _LinearAttention(width, text_latent_width, heads, stylization_width, dropout)
        self.ca_block.text_norm = nn.LayerNorm(text_latent_width)
        self.ffn = _FeedForward(width, feedforward, stylization_width, dropout)

    def forward(
        self, tokens: Tensor, text: Tensor, stylization: Tensor, text_mask: Tensor | None, mask: Tensor | None
    ) -> Tensor:
        normal = self.sa_block.norm(tokens)
        tokens = tokens + self.sa_block(normal, normal, stylization, mask)
        words = self.ca_block.text_norm(text)
        tokens = tokens + self.ca_block(self.ca_block.norm(tokens), words, stylization, text_mask)
        return tokens + self.ffn(tokens, stylization)


class _LinearAttention(nn.Module):
    """Efficient attention (Shen et al. 2021), whose cost grows linearly with the length.

    Keys are normalised over the memory and queries over the features, without scaling by the root of the width.
    """

    text_norm: nn.LayerNorm  # of cross-attention only

    def __init__(self, width: int, memory_width: int, heads: int, stylization_width: int, dropout: float) -> None:
        super().__init__()
        self.heads = heads
        self.norm = nn.LayerNorm(width)
        self.query = nn.Linear(width, width)
        self.key = nn.Linear(memory_width, width)
        self.value = nn.Linear(memory_width, width)
        self.proj_out = _Stylization(width, stylization_width, dropout)

    def forward(
        self,
        tokens: Float[Tensor, "batch _ width"],
        memory: Float[Tensor, "batch words _"],
        stylization: Float[Tensor, "batch 1 _"],
        mask: Bool[Tensor, "batch words"] | None,
    ) -> Float[Tensor, "batch _ width"]:
        query, key, value = (self._by_head(part) for part in (self.query(tokens), self.key(memory), self.value(memory)))
        if mask is not None:
            key = key.masked_fill(~mask[:, None, :, None], float("-inf"))
        gathered = key.softmax(dim=-2).mT @ value
        output = query.softmax(dim=-1) @ gathered
        return self.proj_out(rearrange(output, "batch heads words width -> batch words (heads width)"), stylization)

    def _by_head(self, tokens: Tensor) -> Tensor:
        return rearrange(tokens, "batch words (heads width) -> batch heads words width", heads=self.heads)


class _FeedForward(nn.Module):
    """Feed-forward layers without a leading norm, which `_Stylization` provides."""

    def __init__(self, width: int, feedforward: int, stylization_width: int, dropout: float) -> None:
        super().__init__()
        self.linear1 = nn.Linear(width, feedforward)
        self.linear2 = nn.Linear(feedforward, width)
        self.dropout = nn.Dropout(dropout)
        self.proj_out = _Stylization(width, stylization_width, dropout)

    def forward(self, tokens: Tensor, stylization: Tensor) -> Tensor:
        return self.proj_out(self.linear2(self.dropout(F.gelu(self.linear1(tokens)))), stylization)


class _Stylization(nn.Module):
    """A norm whose scale and shift depend on step and text, followed by a projection."""

    def __init__(self, width: int, stylization_width: int, dropout: float) -> None:
        super().__init__()
        self.emb_layers = nn.Sequential(nn.SiLU(), nn.Linear(stylization_width, 2 * width))
        self.norm = nn.LayerNorm(width)
        self.out_layers = nn.Sequential(nn.SiLU(), nn.Dropout(dropout), nn.Linear(width, width))

    def forward(self, tokens: Tensor, stylization: Tensor) -> Tensor:
        scale, shift = self.emb_layers(stylization).chunk(2, dim=-1)
        return self.out_layers(self.norm(tokens) * (1 + scale) + shift)
