"""A trained TMR as one record, with the functions from texts and motions to latents.

Converts raw features and texts to network inputs; independent of metrics (see `metrics`) and files (see `run`).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from stmc.diffusion.statistics import Statistics
from stmc.diffusion.tensors import mask, pad
from stmc.evaluators.tmr import SequenceEncoder, Tmr
from stmc.motion.motion import Motion
from stmc.motion.representation import Representation
from stmc.text import TextEncoder

BATCH = 64


@dataclass(frozen=True, eq=False)
class Evaluator:
    """A trained TMR with everything that it needs to compare motions with texts and with each other.

    Args:
        network: Networks of TMR.
        text_encoder: Encoder of texts.
        representation: Representation of motions.
        motion_statistics: Statistics that normalise motion features.
        text_statistics: Statistics that normalise text embeddings.
        fps: Frame rate of the features.
        config: Configuration to rebuild the parts; see `run.save_evaluator`.
    """

    network: Tmr
    text_encoder: TextEncoder
    representation: Representation
    motion_statistics: Statistics
    text_statistics: Statistics
    fps: float | int
    config: Mapping[str, Any] = field(default_factory=dict)

    def __repr__(self) -> str:
        weights = sum(parameter.numel() for parameter in self.network.parameters())
        encoder, representation = (type(part).__name__ for part in (self.text_encoder, self.representation))
        return f"Evaluator({weights:,} weights on {self.device}, {encoder} and {representation}, {self.fps:g} fps)"

    @property
    def device(self) -> torch.device:
        """The device of the networks."""
        return next(self.network.parameters()).device

    def to(self, device: torch.device | str) -> Evaluator:
        """Return the evaluator on another device. The networks are moved, not copied."""
        return dataclasses.replace(self, network=self.network.to(device))

    def features(self, motion: Motion) -> Float[Tensor, "_ features"]:
        """Compute the input of `motions` from a motion of any frame rate: raw features at `fps`."""
        return self.representation.encode(motion.resampled(self.fps)).float()

    def motions(self, features: Sequence[Float[Tensor, "_ features"]]) -> Float[Tensor, "batch width"]:
        """Compute the latents of raw feature sequences of any lengths, on the CPU.

        A latent does not depend on the other sequences. Raises `ValueError` if there is no sequence, or an empty one.
        """
        return self._latents(self.network.motion_encoder, [self.motion_statistics.normalise(row) for row in features])

    def texts(self, texts: Sequence[str]) -> Float[Tensor, "batch width"]:
        """Compute the latents of texts, on the CPU."""
        words, lengths = self.text_encoder.encode(texts)
        normal = self.text_statistics.normalise(words.float().cpu())
        rows = [row[:length] for row, length in zip(normal, lengths.tolist(), strict=True)]
        return self._latents(self.network.text_encoder, rows)

    @torch.inference_mode()
    def _latents(self, encoder: SequenceEncoder, rows: Sequence[Tensor]) -> Float[Tensor, "batch width"]:
        lengths = [len(row) for row in rows]
        if not rows or min(lengths) < 1:
            raise ValueError(f"nothing to encode: {len(rows)} sequences, the shortest of {min(lengths, default=0)}")
        encoder.eval()
        order = sorted(range(len(rows)), key=lambda index: lengths[index])
        latents: dict[int, Tensor] = {}
        for start in range(0, len(order), BATCH):
            indices = order[start : start + BATCH]
            batch, counts = pad([rows[index].to(self.device) for index in indices])
            latents |= dict(zip(indices, encoder(batch, mask(counts)).mean.float().cpu(), strict=True))
        return torch.stack([latents[index] for index in range(len(rows))])
