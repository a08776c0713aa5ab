"""Exponential moving average of a network's weights, which is validated, drawn and exported."""

from __future__ import annotations

import copy

import torch
from torch import nn


class Ema:
    """Exponential moving average `model` (in evaluation mode) of a network's weights.

    After n updates the decay is min(decay, (1 + n) / (10 + n)), so that the random initial weights vanish quickly.
    Raises `ValueError` for a decay outside [0, 1).
    """

    def __init__(self, network: nn.Module, decay: float) -> None:
        if not 0 <= decay < 1:
            raise ValueError(f"the decay of a moving average must be in [0, 1), not {decay}")
        self.model = copy.deepcopy(network).eval().requires_grad_(False)
        self.decay = decay
        self._average = [*self.model.parameters(), *self.model.buffers()]

    @torch.no_grad()
    def update(self, network: nn.Module, updates: int) -> None:
        """Move towards `network` after its update number `updates`."""
        share = 1 - min(self.decay, (1 + updates) / (10 + updates))
        current = [*network.parameters(), *network.buffers()]
        moving = [(a, c) for a, c in zip(self._average, current, strict=True) if a.is_floating_point()]
        torch._foreach_lerp_([a for a, _ in moving], [c.detach() for _, c in moving], share)
