"""Padding, masks and positions: sequences of different lengths as one batch, wherever it is.

Knows nothing of what the frames mean.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Generic, TypeVar

import torch
from einops import rearrange
from jaxtyping import Bool, Float, Int, Shaped
from torch import Tensor

Made = TypeVar("Made")


def pad(
    sequences: Sequence[Shaped[Tensor, "_ ..."]],
) -> tuple[Shaped[Tensor, "batch frames ..."], Int[Tensor, " batch"]]:
    """Sequences stacked in a batch, zeros after the end of each, and their lengths.

    Every sequence is [frames, ...] with the same trailing shape, dtype and device. Returns the batch, as long as the
    longest sequence, and the lengths [batch] as int64 on the same device. Raises `ValueError` for no sequence at all.
    """
    if not sequences:
        raise ValueError("nothing to pad: the batch needs at least one sequence")
    batch = torch.nn.utils.rnn.pad_sequence(list(sequences), batch_first=True)
    return batch, torch.tensor([len(sequence) for sequence in sequences], device=batch.device)


def mask(lengths: Int[Tensor, " batch"], frames: int | None = None) -> Bool[Tensor, "batch frames"]:
    """True where a frame exists, False in the padding; as long as the longest sequence if `frames` does not say."""
    frames = int(lengths.max()) if frames is None else frames
    return torch.arange(frames, device=lengths.device) < lengths[:, None]


def sinusoids(rows: int, width: int) -> Float[Tensor, "rows width"]:
    """Positional table: sines in the even columns, cosines in the odd ones, wavelengths 2 pi to 20,000 pi."""
    frequency = torch.exp(torch.arange(0, width, 2).float() * (-math.log(10000.0) / width))
    angle = torch.arange(rows).float()[:, None] * frequency
    return rearrange([angle.sin(), angle.cos()], "two rows half -> rows (half two)")


class Moved(Generic[Made]):
    """Something made of tensors that follows x: `make(x)`, called once for each device and dtype that x comes in."""

    def __init__(self, make: Callable[[Tensor], Made]) -> None:
        self._make = make
        self._made: dict[tuple[torch.device, torch.dtype], Made] = {}

    def at(self, x: Tensor) -> Made:
        """What was made for tensors like `x`."""
        key = (x.device, x.dtype)
        if key not in self._made:
            self._made[key] = self._make(x)
        return self._made[key]


def found_device(device: torch.device | str) -> torch.device:
    """The device of that name on this machine; "auto" is the GPU if there is one. Raises `ValueError` where there is no
    such device."""
    gpus = [f"cuda:{number}" for number in range(torch.cuda.device_count())]
    there = ["cpu", *(["cuda"] if gpus else []), *gpus, *(["mps"] if torch.backends.mps.is_available() else [])]
    name = ("cuda" if gpus else "cpu") if device == "auto" else str(device)
    if name not in there:
        raise ValueError(f"device={name[:60]}: this machine has {', '.join(there)}; auto takes the GPU if there is one")
    return torch.device(name)
