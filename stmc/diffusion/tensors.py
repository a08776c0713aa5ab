"""Padding, masks and positions: sequences of different lengths as one batch. Independent of the meaning of frames."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Sequence
from typing import Generic, TypeVar

import torch
from einops import rearrange
from jaxtyping import Bool, Float, Int, Shaped
from torch import Tensor

from stmc.io.untrusted import quote

Value = TypeVar("Value")


def pad(
    sequences: Sequence[Shaped[Tensor, "_ ..."]],
) -> tuple[Shaped[Tensor, "batch frames ..."], Int[Tensor, " batch"]]:
    """Stack sequences into a zero-padded batch.

    Every sequence is [frames, ...] with the same trailing shape, dtype and device. Returns the batch, as long as the
    longest sequence, and the lengths [batch] as int64 on the same device. Raises `ValueError` if there is no sequence.
    """
    if not sequences:
        raise ValueError("no sequences to pad; pass at least one")
    batch = torch.nn.utils.rnn.pad_sequence(list(sequences), batch_first=True)
    return batch, torch.tensor([len(sequence) for sequence in sequences], device=batch.device)


def mask(lengths: Int[Tensor, " batch"], frames: int | None = None) -> Bool[Tensor, "batch frames"]:
    """Return a mask that is True at the frames of a sequence and False in the padding.

    `frames` is the length of the mask; None uses the longest sequence.
    """
    frames = int(lengths.max()) if frames is None else frames
    return torch.arange(frames, device=lengths.device) < lengths[:, None]


def sinusoids(rows: int, width: int) -> Float[Tensor, "rows width"]:
    """Build a positional table: sines in the even columns, cosines in the odd ones, wavelengths 2 pi to 20,000 pi."""
    frequency = torch.exp(torch.arange(0, width, 2).float() * (-math.log(10000.0) / width))
    angle = torch.arange(rows).float()[:, None] * frequency
    return rearrange([angle.sin(), angle.cos()], "two rows half -> rows (half two)")


class PerDevice(Generic[Value]):
    """A cache of `make(x)`, whose tensors follow `x`: one value per device and dtype of `x`."""

    def __init__(self, make: Callable[[Tensor], Value]) -> None:
        self._make = make
        self._values: dict[tuple[torch.device, torch.dtype], Value] = {}

    def at(self, x: Tensor) -> Value:
        """Return the value for tensors like `x`."""
        key = (x.device, x.dtype)
        if key not in self._values:
            self._values[key] = self._make(x)
        return self._values[key]


def resolve_device(device: torch.device | str) -> torch.device | str:
    """Resolve "auto" to an available device, or check that a named device is available.

    "auto" selects an accelerator if one is available. Of several GPUs it selects the one of this process if `accelerate
    launch` or `torchrun` started several processes on this machine (LOCAL_RANK). Raises `ValueError` if the device is
    unknown or unavailable.
    """
    cuda, mps = torch.cuda.is_available(), torch.backends.mps.is_available()
    if device == "auto":
        rank = os.environ.get("LOCAL_RANK", "")
        gpu = f"cuda:{int(rank) % torch.cuda.device_count()}" if cuda and rank.isdecimal() else "cuda"
        return gpu if cuda else "mps" if mps else "cpu"
    try:
        torch.empty(0, device=device)
    except (RuntimeError, AssertionError, NotImplementedError, TypeError, ValueError) as error:
        choices = ", ".join(["auto", "cpu", *["cuda"] * cuda, *["mps"] * mps])
        raise ValueError(
            f"device {quote(str(device))} is unknown or not available here; choose from {choices}"
        ) from error
    return device
