"""Roofline of one denoising step: its floating-point operations and bytes beside the ceilings of this processor.

Williams, Waterman and Patterson, "Roofline: an insightful visual performance model", 2009.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor
from torch.nn.attention import SDPBackend, sdpa_kernel
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves
from torch.utils.flop_counter import FlopCounterMode

from stmc.model import Model
from stmc.timeline.planning import Plan

_ATTEMPTS = 5
_MATRIX = 2048
_COPIED = 2**26


@dataclass(frozen=True)
class Roofline:
    """Work of one step, and the ceilings of the device on which it ran.

    Args:
        flops: Floating-point operations of the matrix products of a step.
        moved: Bytes that its operations read and write, if none is fused with another and no cache helps.
        seconds: Time of a step, the shortest of five.
        peak_flops: Operations per second of a product of matrices of 2048 rows and columns in the model's precision.
        bandwidth: Bytes per second of a copy of 256 MiB.

    Examples:
        >>> roofline = Roofline(flops=4e9, moved=1e9, seconds=0.04, peak_flops=4e11, bandwidth=5e10)
        >>> roofline.floor, roofline.efficiency
        (0.02, 0.5)
    """

    flops: float | int
    moved: float | int
    seconds: float | int
    peak_flops: float | int
    bandwidth: float | int

    @property
    def floor(self) -> float | int:
        """The time in seconds of the matrix products, or of the bytes if that is longer, at the ceilings."""
        return max(self.flops / self.peak_flops, self.moved / self.bandwidth)

    @property
    def efficiency(self) -> float | int:
        """The fraction of the measured time that `floor` is."""
        return self.floor / self.seconds


@torch.inference_mode()
def measure_roofline(model: Model, plans: Sequence[Plan]) -> Roofline:
    """Count and time one step of denoising all crops of the plans, with guidance.

    Args:
        model: Model that denoises, in its precision and on its device.
        plans: Plans whose crops are denoised, as `Model.plans` returns them.
    """
    predict, crops = model.guided(plans), [crop for plan in plans for crop in plan.crops]
    x = torch.randn(len(crops), max(crop.frames for crop in crops), model.representation.width, device=model.device)
    noisiest = model.schedule.steps - 1  # the last step is in fp32 whatever the precision
    with FlopCounterMode(display=False) as flops, sdpa_kernel(SDPBackend.MATH):  # fused attention is not counted
        predict(x, noisiest)
    with _Traffic() as traffic:
        predict(x, noisiest)
    dtype = torch.bfloat16 if model.precision == "bf16" else torch.float32
    matrix = torch.randn(_MATRIX, _MATRIX, device=model.device).to(dtype)
    source = torch.zeros(_COPIED, device=model.device)
    target = torch.empty_like(source)
    return Roofline(
        flops=flops.get_total_flops(),
        moved=traffic.moved,
        seconds=_shortest(lambda: predict(x, noisiest)),
        peak_flops=2 * _MATRIX**3 / _shortest(lambda: matrix @ matrix),
        bandwidth=2 * source.nbytes / _shortest(lambda: target.copy_(source)),
    )


class _Traffic(TorchDispatchMode):
    """Count the bytes of the tensors that operations read and write; views move none."""

    def __init__(self) -> None:
        super().__init__()
        self.moved = 0

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        result = func(*args, **(kwargs or {}))
        if not func.is_view:
            self.moved += sum(each.nbytes for each in tree_leaves((args, kwargs, result)) if isinstance(each, Tensor))
        return result


def _shortest(call: Callable[[], Tensor]) -> float:
    """Time a call after a warm-up and return the shortest of some attempts, in seconds."""
    call()
    times = []
    for _ in range(_ATTEMPTS):
        start = time.perf_counter()
        result = call()
        if result.is_cuda:
            torch.cuda.synchronize(result.device)
        times.append(time.perf_counter() - start)
    return min(times)
