"""Noise that belongs to its seed: a sample draws the same numbers alone, in any batch, and for any device.

Touches no global generator.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

Seed = int | tuple[int, ...]
"""A seed, or a seed and the numbers of an independent stream below it, such as (seed, crop)."""


class Noise:
    """Standard normal noise for a padded batch, one generator on the CPU for each sample.

    `lengths` are frames. A sample's stream is determined by its seed, its length and `features` alone; frames beyond
    its length are zero. Numbers are drawn in float32 and then given `device` and `dtype`, so that every device gets the
    same ones. Raises `ValueError` for negative seeds and for as many seeds as there are not lengths.

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
            raise ValueError(f"{len(seeds)} seeds for {len(lengths)} samples: each sample needs one")
        self.shape = torch.Size([len(lengths), max(lengths), features])
        self._lengths = tuple(lengths)
        self._generators = [_generator(seed) for seed in seeds]
        self._device, self._dtype = device, dtype

    def __repr__(self) -> str:
        return f"Noise({len(self._lengths)} samples of up to {self.shape[1]} frames, {self.shape[2]} features)"

    def __call__(self, shape: Sequence[int] | None = None) -> Float[Tensor, "batch frames features"]:
        """The next noise of every sample. `shape`, what a sampler asks for, can only be `self.shape`."""
        if shape is not None and tuple(shape) != tuple(self.shape):
            raise ValueError(f"asked for noise of shape {tuple(shape)}, but these samples are {tuple(self.shape)}")
        noise = np.zeros(self.shape, dtype=np.float32)
        for row, length, generator in zip(noise, self._lengths, self._generators, strict=True):
            generator.standard_normal(dtype=np.float32, out=row[:length])
        return torch.from_numpy(noise).to(self._device, self._dtype)


def _generator(seed: Seed) -> np.random.Generator:
    first, *stream = seed if isinstance(seed, tuple) else (seed,)
    return np.random.default_rng(np.random.SeedSequence(first, spawn_key=tuple(stream)))
