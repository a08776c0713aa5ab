"""TMR's networks: motions and texts as points of one space (Petrovich et al. 2023), built like ACTOR's (2021).

Parameter names and shapes are those of the published checkpoints. Independent of the meaning of features and words, and
of losses (see `objective`).
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from einops import repeat
from jaxtyping import Bool, Float
from torch import Tensor, nn

from stmc.diffusion.statistics import Statistics, restate
from stmc.diffusion.tensors import sinusoids

POSITIONS = 5000
"""Rows of the sinusoidal table: the maximum number of tokens."""


class Posterior(NamedTuple):
    """The distribution of each row of a batch in the latent space: mean and log variance (None if not variational)."""

    mean: Float[Tensor, "batch width"]
    log_variance: Float[Tensor, "batch width"] | None

    def float(self) -> Posterior:
        """Convert to float32, because variances are exponentials."""
        return Posterior(self.mean.float(), None if self.log_variance is None else self.log_variance.float())

    def rsample(self, generator: torch.Generator | None = None) -> Float[Tensor, "batch width"]:
        """Draw a point from each distribution; without a variance, return the mean."""
        if self.log_variance is None:
            return self.mean
        noise = torch.randn(self.mean.shape, generator=generator, device=self.mean.device, dtype=self.mean.dtype)
        return self.mean + (0.5 * self.log_variance).exp() * noise


class SequenceEncoder(nn.Module):
    """A transformer over learned tokens and a sequence; the outputs at the tokens are the result.

    The layers are post-norm.

    Args:
        features: Number of features per element of the sequence.
        width: Width of a token.
        feedforward: Width of the feed-forward layers.
        layers: Number of layers.
        heads: Number of attention heads.
        dropout: Dropout probability.
        variational: Whether there are two tokens, mean and log variance, instead of one.
    """

    positions: Tensor

    def __init__(
        self,
        features: int,
        width: int = 256,
        feedforward: int = 1024,
        layers: int = 6,
        heads: int = 4,
        dropout: float = 0.1,
        variational: bool = True,
    ) -> None:
        super().__init__()
        self.projection = nn.Linear(features, width)
        self.tokens = nn.Parameter(torch.randn(2 if variational else 1, width))
        layer = nn.TransformerEncoderLayer(width, heads, feedforward, dropout, "gelu", batch_first=True)
        self.seqTransEncoder = nn.TransformerEncoder(layer, layers, enable_nested_tensor=False)
        self.dropout = nn.Dropout(dropout)
        self.register_buffer("positions", sinusoids(POSITIONS, width), persistent=False)

    def forward(
        self, sequence: Float[Tensor, "batch frames features"], mask: Bool[Tensor, "batch frames"] | None = None
    ) -> Posterior:
        """Compute the posterior of each sequence; `mask` is True at existing frames, and None without padding."""
        learned = repeat(self.tokens, "tokens width -> batch tokens width", batch=len(sequence))
        tokens = torch.cat([learned, self.projection(sequence)], dim=1)
        tokens = self.dropout(tokens + _first(self.positions, tokens.shape[1]))
        padded = None if mask is None else ~torch.cat([mask.new_ones(len(mask), len(self.tokens)), mask], dim=1)
        outputs = self.seqTransEncoder(tokens, src_key_padding_mask=padded)
        return Posterior(outputs[:, 0], outputs[:, 1] if len(self.tokens) > 1 else None)


class SequenceDecoder(nn.Module):
    """A transformer from positions to a sequence of `features` numbers, with one latent as its memory."""

    positions: Tensor

    def __init__(
        self,
        features: int,
        width: int = 256,
        feedforward: int = 1024,
        layers: int = 6,
        heads: int = 4,
        dropout: float = 0.1,
    ) -> None:
        super().__init__()
        layer = nn.TransformerDecoderLayer(width, heads, feedforward, dropout, "gelu", batch_first=True)
        self.seqTransDecoder = nn.TransformerDecoder(layer, layers)
        self.final_layer = nn.Linear(width, features)
        self.dropout = nn.Dropout(dropout)
        self.register_buffer("positions", sinusoids(POSITIONS, width), persistent=False)

    def forward(
        self, latent: Float[Tensor, "batch width"], mask: Bool[Tensor, "batch frames"]
    ) -> Float[Tensor, "batch frames features"]:
        """Decode the sequence of each latent, with the length of `mask`; zeros where it is False."""
        queries = self.dropout(_first(self.positions, mask.shape[1]).expand(len(latent), -1, -1))
        padded = None if mask.device.type == "cpu" and bool(mask.all()) else ~mask
        decoded = self.seqTransDecoder(queries, latent[:, None], tgt_key_padding_mask=padded)
        return self.final_layer(decoded) * mask[..., None]


class Output(NamedTuple):
    """The results for text-motion pairs: posteriors, a point of each, and the motions decoded from the points."""

    text: Posterior
    motion: Posterior
    points: tuple[Float[Tensor, "batch width"], Float[Tensor, "batch width"]]
    rebuilt: tuple[Float[Tensor, "batch frames features"], Float[Tensor, "batch frames features"]]


class Tmr(nn.Module):
    """Encoders of motions and texts into one space, and a decoder from it to motions.

    The latent of a row is the mean of its posterior; latents are compared by cosine similarity.

    Args:
        features: Number of features per frame.
        text_width: Width of a word embedding.
        width: Width of the space.
        feedforward: Width of the feed-forward layers.
        layers: Number of layers.
        heads: Number of attention heads.
        dropout: Dropout probability.
        variational: Whether the encoders predict a variance.
    """

    def __init__(
        self,
        features: int,
        text_width: int,
        width: int = 256,
        feedforward: int = 1024,
        layers: int = 6,
        heads: int = 4,
        dropout: float = 0.1,
        variational: bool = True,
    ) -> None:
        super().__init__()
        sizes = (width, feedforward, layers, heads, dropout)
        self.motion_encoder = SequenceEncoder(features, *sizes, variational)
        self.text_encoder = SequenceEncoder(text_width, *sizes, variational)
        self.motion_decoder = SequenceDecoder(features, *sizes)

    def forward(
        self,
        text: Float[Tensor, "batch words width"],
        text_mask: Bool[Tensor, "batch words"] | None,
        motion: Float[Tensor, "batch frames features"],
        mask: Bool[Tensor, "batch frames"] | None,
        generator: torch.Generator | None = None,
        rebuild_every: int = 1,
    ) -> Output:
        """Compute the inputs of the training losses, text first; points are drawn from the posteriors.

        Args:
            text: Word embeddings, [batch, words, width].
            text_mask: True at words, [batch, words], or None.
            motion: Motion features, [batch, frames, features].
            mask: True at frames, [batch, frames], or None.
            generator: Source of the points.
            rebuild_every: Stride of the rows that are decoded.
        """
        posteriors = self.text_encoder(text, text_mask).float(), self.motion_encoder(motion, mask).float()
        points = tuple(posterior.rsample(generator) for posterior in posteriors)
        present = torch.ones_like(motion[..., 0], dtype=torch.bool) if mask is None else mask
        rows = slice(None, None, rebuild_every)
        rebuilt = tuple(self.motion_decoder(point[rows], present[rows]).float() for point in points)
        return Output(*posteriors, points, rebuilt)

    def restate(self, old: Statistics, new: Statistics) -> None:
        """Adapt the weights from features normalised by `old` to features normalised by `new`.

        See `statistics.restate`.
        """
        restate(self.motion_encoder.projection, self.motion_decoder.final_layer, old, new)


def _first(positions: Tensor, tokens: int) -> Float[Tensor, "_ width"]:
    if tokens > len(positions):
        raise ValueError(f"{tokens} tokens exceed the {len(positions)} positions of the table")
    return positions[:tokens]
