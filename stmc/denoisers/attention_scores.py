"""Attention scores of a FlowMDM network while it denoises (Barquero et al. 2024, Fig. 2).

Depends on the attention of these networks; independent of diffusion steps and figures.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import torch
from jaxtyping import Float
from torch import Tensor, nn

from stmc.denoisers.flow_mdm_layers import Attention

_ALL = slice(None)


@contextmanager
def recorded_attention(
    network: nn.Module, frames: slice = _ALL
) -> Iterator[list[Float[Tensor, "batch chosen frames"]]]:
    """Record how much the selected `frames` attend to every frame, in each call of `network` inside the context.

    Each call appends one tensor [batch, chosen, frames] on the CPU to the yielded list: the mean over all layers and
    heads, whose rows sum to 1. A sampler calls the network once per step, noisiest step first, unless the batch is too
    large for one call. The batch holds the timelines with their texts first, then the timelines without texts. Raises
    `ValueError` if the network has no FlowMDM attention.
    """
    blocks = [module for module in network.modules() if isinstance(module, Attention)]
    if not blocks:
        raise ValueError(f"{type(network).__name__} has no FlowMDM attention; pass a FlowMdm network")
    calls, scores = list[Tensor](), list[Tensor]()

    def record(block: Attention, inputs: tuple) -> None:
        with torch.no_grad():
            scores.append(block.scores(*inputs)[:, :, frames].mean(dim=1).float().cpu())
        if len(scores) == len(blocks):
            calls.append(torch.stack(scores).mean(dim=0))
            scores.clear()

    handles = [block.register_forward_pre_hook(record) for block in blocks]
    try:
        yield calls
    finally:
        for handle in handles:
            handle.remove()
