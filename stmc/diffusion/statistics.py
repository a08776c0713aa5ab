"""Normalisation of features by their mean and standard deviation. Independent of the meaning of the features."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor, nn

WIDEST = 1.5
"""Maximum factor by which `restate` amplifies a feature, and so its noise, in the first layer."""

_ROWS_AT_ONCE = 2**16
"""Rows that are held in float64 at a time: a large data set in float64 would triple its memory."""


@dataclass(frozen=True, eq=False, repr=False)
class Statistics:
    """Mean and standard deviation per feature; `std` is positive everywhere.

    `normalise` and `restore` keep the shape, dtype and device of their argument.
    """

    mean: Float[Tensor, " features"]
    std: Float[Tensor, " features"]

    def __post_init__(self) -> None:
        if not bool((self.std > 0).all() & self.mean.isfinite().all() & self.std.isfinite().all()):
            raise ValueError(f"statistics must be finite and std must be above 0; got mean {self.mean}, std {self.std}")

    def __repr__(self) -> str:
        return f"Statistics({len(self.mean)} features, std {self.std.min():.4g} to {self.std.max():.4g})"

    @classmethod
    def of(cls, rows: Float[Tensor, "frames features"], floor: float | Float[Tensor, " features"]) -> Statistics:
        """Compute the statistics of all `rows` in float64.

        The std of a feature is at least `floor`, a scalar or one value per feature. Raises `ValueError` if there are no
        rows.
        """
        if not len(rows):
            raise ValueError("rows is empty; statistics need at least one row")
        chunks = rows.split(_ROWS_AT_ONCE)
        mean = sum(chunk.double().sum(dim=0) for chunk in chunks) / len(rows)
        std = (sum((chunk.double() - mean).square().sum(dim=0) for chunk in chunks) / len(rows)).sqrt()
        return cls(mean.to(rows.dtype), std.clamp_min(torch.as_tensor(floor).to(std)).to(rows.dtype))

    def normalise(self, raw: Float[Tensor, "*batch features"]) -> Float[Tensor, "*batch features"]:
        """Normalise features to zero mean and unit variance."""
        return (raw - self.mean.to(raw)) / self.std.to(raw)

    def restore(self, normal: Float[Tensor, "*batch features"]) -> Float[Tensor, "*batch features"]:
        """Invert `normalise`."""
        return normal * self.std.to(normal) + self.mean.to(normal)

    def to(self, device: torch.device | str) -> Statistics:
        """Return the statistics on another device."""
        return Statistics(self.mean.to(device), self.std.to(device))


@torch.no_grad()
def restate(first: nn.Linear, last: nn.Linear, old: Statistics, new: Statistics) -> None:
    """Adapt, in place, the first and last layers of a network from features normalised by `old` to `new`.

    The adapted network generates the same motion from the same input, except for features that `new` divides by a much
    larger std: their weights grow at most by the factor `WIDEST`, because larger weights would amplify the noise as
    well.

    Args:
        first: Layer that takes the features in.
        last: Layer that gives the features out.
        old: Statistics that the network was trained with.
        new: Statistics that the network is to use.
    """
    ratio, shift = (old.std / new.std).to(last.weight), ((new.mean - old.mean) / new.std).to(last.weight)
    last.bias.mul_(ratio).sub_(shift)
    last.weight.mul_(ratio[:, None])
    scale = (1 / ratio).clamp(max=WIDEST)
    first.bias.add_(first.weight @ (scale * shift))
    first.weight.mul_(scale)
