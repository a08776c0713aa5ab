"""Helpers of the file formats: the change of the up axis, and quaternion curves without jumps."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from torch import Tensor

Z_UP_TO_Y_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])


def continued(quaternions: Float[Tensor, "frames joints 4"]) -> Float[np.ndarray, "frames joints 4"]:
    """Choose, of the two quaternions of each rotation, the one on the side of the previous frame."""
    values = quaternions.double().cpu().numpy()
    flips = np.sign((values[1:] * values[:-1]).sum(axis=-1, keepdims=True))
    signs = np.cumprod(np.where(flips < 0, -1.0, 1.0), axis=0)
    return np.concatenate([values[:1], values[1:] * signs])
