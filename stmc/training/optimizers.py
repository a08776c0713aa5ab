"""Optimisers: AdamW, or Muon for the layers of a network and AdamW for the rest."""

from __future__ import annotations

import math
from typing import Any, Literal

import torch
from jaxtyping import Float
from torch import Tensor, nn

from stmc.run.precision import imitates_bf16

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
        kind = _fp32_muon() if imitates_bf16(matrices[0].device) else torch.optim.Muon
        optimizers.append(kind(matrices, lr=lr, weight_decay=weight_decay, adjust_lr_fn="match_rms_adamw"))
    return optimizers


def orthogonalised(
    matrix: Float[Tensor, "rows columns"], coefficients: tuple[float, float, float], steps: int, eps: float
) -> Float[Tensor, "rows columns"]:
    """Return nearly the nearest orthogonal matrix, by Newton-Schulz iterations in the matrix's own precision.

    Args:
        matrix: Matrix, such as a momentum.
        coefficients: Coefficients of the odd polynomial of degree five that maps singular values towards 1.
        steps: Number of iterations.
        eps: Lower bound of the norm that the matrix is divided by.
    """
    first, third, fifth = coefficients
    wide = matrix if len(matrix) <= matrix.shape[1] else matrix.T
    wide = wide / wide.norm().clamp(min=eps)
    for _ in range(steps):
        gram = wide @ wide.T
        wide = torch.addmm(wide, torch.addmm(gram, gram, gram, beta=third, alpha=fifth), wide, beta=first)
    return wide if len(matrix) <= matrix.shape[1] else wide.T


def _fp32_muon() -> type[torch.optim.Muon]:
    """Return torch's Muon without bf16: torch iterates in bf16 whatever the precision of training is."""

    class Fp32Muon(torch.optim.Muon):
        """Muon with the iteration in the precision of the parameters."""

        @torch.no_grad()
        def step(self, closure: Any = None) -> Any:
            """Update the matrices that have a gradient, as torch does."""
            assert closure is None
            for group in self.param_groups:
                for matrix in (each for each in group["params"] if each.grad is not None):
                    momentum = self.state[matrix].setdefault("momentum_buffer", torch.zeros_like(matrix.grad))
                    momentum.lerp_(matrix.grad, 1 - group["momentum"])
                    ahead = matrix.grad.lerp(momentum, group["momentum"])
                    update = orthogonalised(ahead, group["ns_coefficients"], group["ns_steps"], group["eps"])
                    matrix.mul_(1 - group["lr"] * group["weight_decay"])
                    matrix.add_(update, alpha=-group["lr"] * 0.2 * math.sqrt(max(matrix.shape)))

    return Fp32Muon


def _matrices_of_layers(network: nn.Module) -> list[nn.Parameter]:
    """Return the matrices of repeated layers, which are in lists; input and output layers are not."""
    lists = [module for module in network.modules() if isinstance(module, nn.ModuleList)]
    found = {id(each): each for layers in lists for each in layers.parameters() if each.ndim == 2}
    return list(found.values())
