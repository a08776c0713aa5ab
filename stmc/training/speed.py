"""Faster training steps on a CPU, as measured, with the same mathematics.

With bf16 on CPU (sequences of about 100 frames, width 256) PyTorch's fused attention has a slower backward pass than
its unfused one, and dropout masks are drawn element by element; together the changes save some ten per cent of a step.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import torch
from torch import Tensor, nn
from torch.nn.attention import SDPBackend, sdpa_kernel


@contextmanager
def quick_attention(device: torch.device) -> Iterator[None]:
    """Use plain matrix products in the tensors' own precision for scaled dot product attention on a CPU."""
    if device.type != "cpu":
        yield
        return
    before = torch.backends.cuda.fp16_bf16_reduction_math_sdp_allowed()
    torch.backends.cuda.allow_fp16_bf16_reduction_math_sdp(True)
    try:
        with sdpa_kernel(SDPBackend.MATH):
            yield
    finally:
        torch.backends.cuda.allow_fp16_bf16_reduction_math_sdp(before)


class ByteDropout(nn.Module):
    """Dropout that draws a byte per element instead of a Bernoulli variable: `p` is rounded to a multiple of 1/256."""

    def __init__(self, p: float) -> None:
        super().__init__()
        self.dropped = round(256 * p)
        if not 0 <= self.dropped < 256:
            raise ValueError(f"the probability of dropout must be in [0, 1), not {p}")

    def forward(self, x: Tensor) -> Tensor:
        """Set random elements of `x` to zero and scale up the others in training; return `x` itself otherwise."""
        if not self.training or not self.dropped:
            return x
        words = torch.empty((x.numel() + 7) // 8, dtype=torch.int64, device=x.device).random_(-(2**63), None)
        kept = words.view(torch.uint8)[: x.numel()].view(x.shape) >= self.dropped
        return x * (kept * torch.tensor(256 / (256 - self.dropped), dtype=x.dtype, device=x.device))


def quicken_dropout(network: nn.Module) -> None:
    """Replace every `nn.Dropout` in `network` by a `ByteDropout`, whose probability differs by at most 1/512."""
    for module in network.modules():
        for name, child in module.named_children():
            if isinstance(child, nn.Dropout):
                setattr(module, name, ByteDropout(child.p).train(child.training))
