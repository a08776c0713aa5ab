"""Reproducible noise: a sample draws the same numbers alone, in any batch and on any device.

No global generator is used.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

Seed = int | tuple[int, ...]
"""An integer seed, or a tuple of a seed and the indices of an independent stream below it, such as (seed, crop)."""


class Noise:
    """Standard normal noise for a padded batch, with one CPU generator per sample.

    The stream of a sample depends only on its seed, its length and `features`; frames beyond its length are zero.
    Numbers are drawn in float32 and then moved to `device` and `dtype`, so every device gets the same numbers.

    Args:
        seeds: One seed per sample, 0 or greater.
        lengths: Length of each sample in frames.
        features: Number of features per frame.
        device: Device of the noise.
        dtype: Data type of the noise.

    Raises:
        ValueError: If a seed is negative, or if the numbers of seeds and lengths differ.

    Examples:
        >>> draw = stmc.Noise(seeds=[0, 1], lengths=[30, 40], features=205)
        >>> draw().shape
        torch.Size([2, 40, 205])
    """

    def __init__(
        self,
        seeds: Sequence[Seed],
        lengths: Sequence[int],
        features: int,
        device: torch.device | str = "cpu",
        dtype: torch.dtype = torch.float32,
    ) -> None:
        if len(seeds) != len(lengths):
            raise ValueError(f"{len(seeds)} seeds for {len(lengths)} samples; pass one seed per sample")
        self.shape = torch.Size([len(lengths), max(lengths), features])
        self._lengths = tuple(lengths)
        self._generators = [_generator(seed) for seed in seeds]
        self._device, self._dtype = device, dtype

    def __repr__(self) -> str:
        return f"Noise({len(self._lengths)} samples of up to {self.shape[1]} frames, {self.shape[2]} features)"

    def __call__(self, shape: Sequence[int] | None = None) -> Float[Tensor, "batch frames features"]:
        """Draw the next noise of every sample. `shape`, which samplers pass, must equal `self.shape`."""
        if shape is not None and tuple(shape) != tuple(self.shape):
            raise ValueError(f"shape {tuple(shape)} differs from {tuple(self.shape)}, the shape of these samples")
        noise = np.zeros(self.shape, dtype=np.float32)
        for row, length, generator in zip(noise, self._lengths, self._generators, strict=True):
            generator.standard_normal(dtype=np.float32, out=row[:length])
        return torch.from_numpy(noise).to(self._device, self._dtype)


class FrameNoise:
    """Standard normal noise of spans of one long timeline, whose numbers depend on the seed and the frame alone.

    Spans that share a frame draw the same numbers there, so a window that slides over a timeline sees the same noise
    again. A call draws the next numbers of every frame; rows of shorter spans end with zeros.

    Args:
        seed: Seed of the timeline, 0 or greater.
        starts: First frame of each span.
        lengths: Length of each span in frames.
        features: Number of features per frame.
        device: Device of the noise.

    Examples:
        >>> before, after = (stmc.diffusion.FrameNoise(0, [start], [40], features=205)() for start in (100, 120))
        >>> torch.equal(before[:, 20:], after[:, :20])
        True
    """

    def __init__(
        self,
        seed: Seed,
        starts: Sequence[int],
        lengths: Sequence[int],
        features: int,
        device: torch.device | str = "cpu",
    ) -> None:
        self._first = min(starts)
        frames = max(start + length for start, length in zip(starts, lengths, strict=True)) - self._first
        stream = seed if isinstance(seed, tuple) else (seed,)
        self._frames = Noise([(*stream, self._first + frame) for frame in range(frames)], [1] * frames, features)
        self._spans = [(start - self._first, length) for start, length in zip(starts, lengths, strict=True)]
        self.shape, self._device = torch.Size([len(starts), max(lengths), features]), device

    def __call__(self, shape: Sequence[int] | None = None) -> Float[Tensor, "batch frames features"]:
        """Draw the next noise of every frame. `shape`, which samplers pass, is not used."""
        drawn, noise = self._frames()[:, 0], torch.zeros(self.shape)
        for row, (start, length) in zip(noise, self._spans, strict=True):
            row[:length] = drawn[start : start + length]
        return noise.to(self._device)


def _generator(seed: Seed) -> np.random.Generator:
    entropy, *stream = seed if isinstance(seed, tuple) else (seed,)
    return np.random.default_rng(np.random.SeedSequence(entropy, spawn_key=tuple(stream)))
