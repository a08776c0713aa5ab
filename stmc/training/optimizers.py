"""Optimisers: AdamW, or Muon for the layers of a network and AdamW for the rest."""

from __future__ import annotations

from typing import Literal

import torch
from torch import nn

Optimizer = Literal["adamw", "muon"]
"""Name of an optimiser. Muon (Jordan et al., 2024) updates a matrix by its orthogonalised momentum, so rare directions,
such as those of contents with few clips, are learned as fast as common ones. Its updates are scaled to the size of
AdamW's (Liu et al., 2025), so both can use the same learning rate."""


def build_optimizers(
    network: nn.Module, name: Optimizer, lr: float | int, weight_decay: float | int
) -> list[torch.optim.Optimizer]:
    """Build optimisers that together update every parameter once.

    Raises `ImportError` if torch has no Muon.

    Args:
        network: Network to train.
        name: "adamw" or "muon".
        lr: Learning rate.
        weight_decay: Weight decay.

    Examples:
        >>> from stmc.training.optimizers import build_optimizers
        >>> network = torch.nn.ModuleDict({"layers": torch.nn.ModuleList([torch.nn.Linear(8, 8)])})
        >>> [type(each).__name__ for each in build_optimizers(network, "muon", lr=1e-3, weight_decay=0.01)]
        ['AdamW', 'Muon']
    """
    matrices = _matrices_of_layers(network) if name == "muon" else []
    moved = set(map(id, matrices))
    rest = [parameter for parameter in network.parameters() if id(parameter) not in moved]
    optimizers: list[torch.optim.Optimizer] = [torch.optim.AdamW(rest, lr=lr, weight_decay=weight_decay, fused=True)]
    if matrices:
        if not hasattr(torch.optim, "Muon"):
            raise ImportError(f"optimizer muon needs torch 2.9 or later, not {torch.__version__}; use adamw instead")
        optimizers.append(torch.optim.Muon(matrices, lr=lr, weight_decay=weight_decay, adjust_lr_fn="match_rms_adamw"))
    return optimizers


def _matrices_of_layers(network: nn.Module) -> list[nn.Parameter]:
    """Return the matrices of repeated layers, which are in lists; input and output layers are not."""
    lists = [module for module in network.modules() if isinstance(module, nn.ModuleList)]
    found = {id(each): each for layers in lists for each in layers.parameters() if each.ndim == 2}
    return list(found.values())
