"""When heels and toes stand on the floor: low and slow, for a while.

Knows points and steps; knows no legs. A contact is a run of *steps*, from one frame to the next, in which the point
should not move, so two contacts may follow each other without a frame between.
"""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float
from torch import Tensor

_SPEED, _HEIGHT = 0.4, 0.1
"""Metres a second on the floor, and metres above it when at rest, at which a point certainly does not stand; between
the two, what counts is the sum of both as shares of these."""
_SURE = 0.6
"""The share that some step of a contact stays below."""
_SHORTEST = 0.1
"""Seconds of the shortest contact: the feet of runners stand for 0.15 s."""


def held_steps(
    points: Float[Tensor, "frames *points 3"], fps: float | int, floor: float | int
) -> Bool[Tensor, _ * points]:
    """Whether each of the `points` (metres, z up) stands from each frame to the next; one step fewer than frames.

    Hysteresis: a contact is a run of steps that may be contacts, of which one surely is.
    """
    speed = points.diff(dim=0).norm(dim=-1) * fps
    height = (torch.maximum(points[1:, ..., 2], points[:-1, ..., 2]) - floor).clamp(min=0)
    share = speed / _SPEED + height / _HEIGHT
    held = torch.zeros_like(share, dtype=torch.bool)
    for shares, column in zip(share.flatten(start_dim=1).T, held.flatten(start_dim=1).T, strict=True):
        for start, end in runs(shares < 1):
            if end - start >= _SHORTEST * fps - 1e-6 and shares[start:end].min() < _SURE:
                column[start:end] = True
    return held


def runs(mask: Bool[Tensor, " steps"]) -> list[tuple[int, int]]:
    """The first and the last (exclusive) of each run of True."""
    edges = torch.nn.functional.pad(mask.int(), (1, 1)).diff()
    return list(zip((edges > 0).nonzero()[:, 0].tolist(), (edges < 0).nonzero()[:, 0].tolist(), strict=True))
