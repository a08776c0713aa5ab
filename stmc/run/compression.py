"""Weights in fewer bits.

With int8, each row of a matrix is whole numbers from -127 to 127 with a scale of its own: in a file, the matrix NAME
has the type int8, and NAME.scale holds one number for each of its rows. Independent of networks and of files.
"""

from __future__ import annotations

from collections.abc import Mapping

import torch
from jaxtyping import Float, Int8
from torch import Tensor

from stmc.run.weights import Spec, specs_of

LARGEST = 127
_SCALE = ".scale"


def compress(weights: Mapping[str, Tensor], dtype: torch.dtype) -> dict[str, Tensor]:
    """Convert floating-point weights to `dtype`; other tensors stay as they are.

    With eight bits, vectors have half precision: the gain of a norm, rounded by 6 %, would matter. With torch.int8, a
    weight changes by at most half of its row's scale, which is the largest absolute weight of the row over 127.

    Examples:
        >>> from stmc.run.compression import compress, restore
        >>> weights = {"weight": torch.tensor([[1.27, -0.5], [0.0, 0.0]]), "bias": torch.zeros(2)}
        >>> small = compress(weights, torch.int8)
        >>> small["weight"].tolist(), small["bias"].dtype
        ([[127, -50], [0, 0]], torch.float16)
        >>> restore(small)["weight"].tolist()
        [[1.2699999809265137, -0.5], [0.0, 0.0]]
    """
    small = dict[str, Tensor]()
    for name, value in weights.items():
        if not value.is_floating_point():
            small[name] = value
        elif dtype.itemsize == 1 and value.ndim < 2:
            small[name] = value.half()
        elif dtype == torch.int8:
            small[name], small[name + _SCALE] = _rounded(value.float())
        else:
            small[name] = value.to(dtype)
    return small


def restore(tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Multiply the rows of int8 matrices by their scales, in single precision; other tensors stay as they are."""
    scales = _scales(specs_of(tensors))
    return {
        name: value.float() * _per_row(tensors[scales[name]].float(), value) if name in scales else value
        for name, value in tensors.items()
        if name not in scales.values()
    }


def restored_specs(specs: Mapping[str, Spec]) -> dict[str, Spec]:
    """Return the specs of what `restore` makes of tensors with these specs."""
    scales = _scales(specs)
    return {
        name: Spec(spec.shape, torch.float32) if name in scales else spec
        for name, spec in specs.items()
        if name not in scales.values()
    }


def _rounded(matrix: Float[Tensor, "rows ..."]) -> tuple[Int8[Tensor, "rows ..."], Float[Tensor, " rows"]]:
    scale = matrix.flatten(1).abs().amax(dim=1) / LARGEST
    steps = matrix / _per_row(scale.where(scale > 0, torch.ones_like(scale)), matrix)
    return steps.round().clamp(-LARGEST, LARGEST).to(torch.int8), scale


def _per_row(scale: Float[Tensor, " rows"], matrix: Tensor) -> Float[Tensor, "rows ..."]:
    return scale.reshape(-1, *[1] * (matrix.ndim - 1))


def _scales(specs: Mapping[str, Spec]) -> dict[str, str]:
    """Return the name of the scale of each matrix that has one."""
    return {
        name: name + _SCALE
        for name, spec in specs.items()
        if spec.dtype == torch.int8 and name + _SCALE in specs and specs[name + _SCALE].shape == spec.shape[:1]
    }
