"""Precisions that a processor computes slowly."""

from __future__ import annotations

import platform

import torch

from stmc.timeline.advice import advise


def imitates_bf16(device: torch.device | str) -> bool:
    """Return whether `device` is an x86 processor without AVX-512 and AMX.

    There, PyTorch multiplies matrices in bf16 up to seventy times more slowly than in fp32.
    """
    capability = torch.backends.cpu.get_cpu_capability()
    plain = platform.machine() in ("x86_64", "AMD64") and capability in ("DEFAULT", "AVX2")
    return torch.device(device).type == "cpu" and plain


def advise_precision(precision: str, device: torch.device | str) -> None:
    """Warn if `precision` is "bf16" and `device` imitates it."""
    if precision == "bf16" and imitates_bf16(device):
        advise(
            "precision=bf16 is very slow on this processor, which has neither AVX-512 nor AMX; use fp32", UserWarning
        )
