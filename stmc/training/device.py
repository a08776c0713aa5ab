"""Where training runs: the accelerator if there is one, or what was asked for. Knows no network."""

from __future__ import annotations

import torch
from accelerate import Accelerator


def find_accelerator(device: str) -> Accelerator:
    """`device` is cuda, cpu, or auto: cuda if there is one. Apple's accelerator is passed over: it has no
    float64, in which distances are summed.

    Raises `ValueError` for another device, and for cuda where there is none.
    """
    choices = ("auto", "cpu", "cuda")
    if device not in choices:
        raise ValueError(f"device={device!r}: choose from {', '.join(choices)}")
    if device == "cuda" and not torch.cuda.is_available():
        raise ValueError("device=cuda: no GPU is available, or PyTorch was installed without it; try device=cpu")
    return Accelerator(cpu=device == "cpu" or not torch.cuda.is_available())
