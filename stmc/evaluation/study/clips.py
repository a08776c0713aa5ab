"""A motion as the pages draw it: a few points of the body per frame, in whole units of a millimetre.

Knows nothing of methods; two clips of a pair look alike but for how they move.
"""

from __future__ import annotations

import base64
import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Float

from stmc.motion.body import JOINTS, PARENTS
from stmc.motion.geometry import global_rotations, rotation_z
from stmc.motion.motion import Motion

_HEAD = JOINTS.index("head")
_FACE = ((0.0, 0.170, 0.010), (0.0, 0.045, 0.142))
"""Crown and tip of the nose, in metres from the head joint and in its axes (x left, y up, z forward)."""
TREE = (*PARENTS, _HEAD, _HEAD)
"""The parent of each point: SMPL's 24 joints, the crown and the nose."""

_SWELLING = {"elbow": 1.6, "wrist": 1.6, "hand": 1.6, "knee": 1.0, "ankle": 1.0}
"""How much longer than it is the bone that ends at a joint grows: 1.6 is up to 2.6 times as long."""
_PERIOD = 2.0
"""Seconds in which a stretched limb grows and shrinks."""
_FINEST, _LARGEST = 0.001, 32767


@dataclass(frozen=True, eq=False)
class Clip:
    """Points of a body over time: metres, z up, the floor at 0."""

    points: Float[np.ndarray, "frames points 3"]
    fps: float | int

    @classmethod
    def of(cls, motion: Motion) -> Clip:
        """The motion moved to the origin and turned so that it first faces -y: where a method let it begin is no hint
        at the method."""
        joints = motion.joints.double().cpu()
        head = global_rotations(motion.rotations.double().cpu(), PARENTS)[:, _HEAD]
        face = joints[:, _HEAD, None] + torch.einsum("fab,pb->fpa", head, torch.tensor(_FACE).double())
        origin = motion.translation[0].double().cpu() * torch.tensor([1.0, 1.0, 0.0])
        back = rotation_z(-motion.heading[0].double().cpu())
        return cls(((torch.cat([joints, face], dim=1) - origin) @ back.T).numpy(), motion.fps)

    @property
    def duration(self) -> float:
        """Seconds from the first frame to the last."""
        return (len(self.points) - 1) / self.fps

    def stretched(self) -> Clip:
        """The same with arms and legs that grow to more than twice their length and shrink again, as no body can; the
        lowest point stays as high as it was."""
        time = np.arange(len(self.points)) / self.fps
        points = self.points.copy()
        for joint, name in enumerate(JOINTS):
            side, _, rest = name.partition("_")
            late = {"left": 0.0, "right": math.pi}.get(side, 0.0) + (math.pi / 2 if rest in ("knee", "ankle") else 0.0)
            growth = _SWELLING.get(rest, 0.0) * (0.5 - 0.5 * np.cos(2 * math.pi * time / _PERIOD + late))
            _hang(points, self.points, joint, 1 + growth[:, None])
        for extra in range(len(JOINTS), len(TREE)):
            _hang(points, self.points, extra, 1.0)
        sunk = self.points[..., 2].min(axis=1) - points[..., 2].min(axis=1)
        points[..., 2] += sunk[:, None]
        return Clip(points, self.fps)

    def data(self) -> dict[str, Any]:
        """For a page: the frame rate, the unit in metres (a millimetre, but for those who go further than 32 m), and
        the points in units as little-endian 16-bit numbers in base64, frame after frame."""
        unit = max(_FINEST, float(np.abs(self.points).max()) / _LARGEST)
        units = np.round(self.points / unit).astype("<i2")
        return {"fps": float(self.fps), "unit": unit, "points": base64.b64encode(units.tobytes()).decode("ascii")}


def _hang(points: np.ndarray, old: np.ndarray, point: int, factor: np.ndarray | float) -> None:
    """Put a point to its parent's new place, as far away as it was, times `factor`."""
    parent = TREE[point]
    if parent >= 0:
        points[:, point] = points[:, parent] + factor * (old[:, point] - old[:, parent])
