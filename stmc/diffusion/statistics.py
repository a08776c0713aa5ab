"""Mean and standard deviation of features: what stands between raw numbers and those a network sees.

Knows nothing of what the numbers mean.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor, nn

WIDEST = 1.5
"""How much more than before the first layer may make of a feature whose statistics have changed: of its noise, too."""

_AT_ONCE = 2**16
"""Rows that are in float64 at a time: all of a large data set would take the memory twice over."""


@dataclass(frozen=True, eq=False, repr=False)
class Statistics:
    """Per feature; `std` is positive everywhere. Both directions keep shape, dtype and device of their argument."""

    mean: Float[Tensor, " features"]
    std: Float[Tensor, " features"]

    def __post_init__(self) -> None:
        if not bool((self.std > 0).all() & self.mean.isfinite().all() & self.std.isfinite().all()):
            raise ValueError(f"statistics must be finite, with std above 0: mean {self.mean}, std {self.std}")

    def __repr__(self) -> str:
        return f"Statistics({len(self.mean)} features, std {self.std.min():.4g} to {self.std.max():.4g})"

    @classmethod
    def of(cls, rows: Float[Tensor, "frames features"], floor: float | Float[Tensor, " features"]) -> Statistics:
        """Over all `rows`, summed in float64. A feature that hardly varies has std `floor` (its own, of several), not
        0."""
        if not len(rows):
            raise ValueError("statistics of no rows at all")
        pieces = rows.split(_AT_ONCE)
        mean = sum(piece.double().sum(dim=0) for piece in pieces) / len(rows)
        std = (sum((piece.double() - mean).square().sum(dim=0) for piece in pieces) / len(rows)).sqrt()
        return cls(mean.to(rows.dtype), std.clamp_min(torch.as_tensor(floor).to(std)).to(rows.dtype))

    def normalise(self, raw: Float[Tensor, "*batch features"]) -> Float[Tensor, "*batch features"]:
        """Zero mean and unit variance."""
        return (raw - self.mean.to(raw)) / self.std.to(raw)

    def restore(self, normal: Float[Tensor, "*batch features"]) -> Float[Tensor, "*batch features"]:
        """The inverse of `normalise`."""
        return normal * self.std.to(normal) + self.mean.to(normal)

    def to(self, device: torch.device | str) -> Statistics:
        """The same on another device."""
        return Statistics(self.mean.to(device), self.std.to(device))


@torch.no_grad()
def restate(first: nn.Linear, last: nn.Linear, old: Statistics, new: Statistics) -> None:
    """Makes a network's layers that take features in (`first`) and give them out (`last`), trained on features
    normalised by `old`, those for features normalised by `new`.

    What comes out is the same motion, for an input that is. What goes in is the same but for features that `new`
    divides by far more, whose noise would be blown up as well: these count `WIDEST` times as much as before.
    """
    narrower, moved = (old.std / new.std).to(last.weight), ((new.mean - old.mean) / new.std).to(last.weight)
    last.bias.mul_(narrower).sub_(moved)
    last.weight.mul_(narrower[:, None])
    scale = (1 / narrower).clamp(max=WIDEST)
    first.bias.add_(first.weight @ (scale * moved))
    first.weight.mul_(scale)
