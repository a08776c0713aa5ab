"""A moving average of a network's weights: what is validated, drawn and shipped."""

from __future__ import annotations

import copy

import torch
from torch import nn


class Ema:
    """The average `model` (in evaluation mode) follows a network; its reach grows until `decay` is reached.

    After n updates the decay is min(decay, (1 + n) / (10 + n)), so that the random weights of the start are soon gone.
    """

    def __init__(self, network: nn.Module, decay: float) -> None:
        if not 0 <= decay < 1:
            raise ValueError(f"the decay of a moving average is in [0, 1), not {decay}")
        self.model = copy.deepcopy(network).eval().requires_grad_(False)
        self.decay = decay
        self._average = [*self.model.parameters(), *self.model.buffers()]

    @torch.no_grad()
    def update(self, network: nn.Module, updates: int) -> None:
        """Moves towards `network`, which has been updated `updates` times."""
        share = 1 - min(self.decay, (1 + updates) / (10 + updates))
        current = [*network.parameters(), *network.buffers()]
        moving = [(a, c) for a, c in zip(self._average, current, strict=True) if a.is_floating_point()]
        torch._foreach_lerp_([a for a, _ in moving], [c.detach() for _, c in moving], share)
