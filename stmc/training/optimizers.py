"""What moves the weights by their gradients: AdamW, or Muon for a network's layers and AdamW for the rest of it.

Knows networks as modules with layers; knows no loss and no data.
"""

from __future__ import annotations

from typing import Literal

import torch
from torch import nn

Optimizer = Literal["adamw", "muon"]
"""Muon (Jordan et al., 2024) moves a matrix by its momentum made orthogonal, so that rare directions, such as those of
contents with few clips, are learned as fast as common ones. Its steps are scaled to be as long as AdamW's (Liu et al.,
2025), so that a learning rate that is right for one is for the other."""


def build_optimizers(
    network: nn.Module, name: Optimizer, lr: float | int, weight_decay: float | int
) -> list[torch.optim.Optimizer]:
    """Optimisers that move every parameter once between them. Raises `ImportError` where torch is older than its Muon.

    Examples:
        >>> from stmc.training.optimizers import build_optimizers
        >>> network = torch.nn.ModuleDict({"layers": torch.nn.ModuleList([torch.nn.Linear(8, 8)])})
        >>> [type(each).__name__ for each in build_optimizers(network, "muon", lr=1e-3, weight_decay=0.01)]
        ['AdamW', 'Muon']
    """
    matrices = _matrices_of_layers(network) if name == "muon" else []
    moved = set(map(id, matrices))
    rest = [parameter for parameter in network.parameters() if id(parameter) not in moved]
    found: list[torch.optim.Optimizer] = [torch.optim.AdamW(rest, lr=lr, weight_decay=weight_decay, fused=True)]
    if matrices:
        if not hasattr(torch.optim, "Muon"):
            raise ImportError(f"optimizer muon needs torch 2.9 or later, not {torch.__version__}; or choose adamw")
        found.append(torch.optim.Muon(matrices, lr=lr, weight_decay=weight_decay, adjust_lr_fn="match_rms_adamw"))
    return found


def _matrices_of_layers(network: nn.Module) -> list[nn.Parameter]:
    """Of what is repeated, and so in a list: what reads features, texts and steps, and what writes features, is not."""
    lists = [module for module in network.modules() if isinstance(module, nn.ModuleList)]
    found = {id(each): each for layers in lists for each in layers.parameters() if each.ndim == 2}
    return list(found.values())
