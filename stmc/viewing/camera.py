"""Where a camera stands so that a whole motion is in the picture."""

from __future__ import annotations

import math

import numpy as np
from jaxtyping import Float
from scipy.spatial import ConvexHull

from stmc.motion.body import JOINTS

_ELEVATION = math.radians(18.0)
_ROOM = 1.12
"""How much wider than the motion the picture is."""
_ABOVE = 0.3
"""Metres kept free above the head joint, for the skull and some air."""
_HEAD = JOINTS.index("head")


def framing(
    joints: Float[np.ndarray, "frames joints 3"], facing: Float[np.ndarray, " 3"], fov: int | float, aspect: int | float
) -> tuple[Float[np.ndarray, " 3"], Float[np.ndarray, " 3"]]:
    """Position and target (metres, z up) of a camera that sees all joints of all frames.

    It stands where it can come closest, but rather in front of the body, which first faces `facing`, and aside.
    `fov`: the vertical field of view in radians; `aspect`: the picture's width over its height.
    """
    points = np.concatenate([joints.reshape(-1, 3), joints[:, _HEAD] + [0.0, 0.0, _ABOVE]])
    points = points[ConvexHull(points, qhull_options="QJ").vertices]  # whatever sees these sees all
    front = math.atan2(facing[1], facing[0])
    best, least = None, math.inf
    for aside in np.radians(np.arange(-180, 180, 15)):
        position, target = _fit(points, front + aside, fov, aspect)
        distance = float(np.linalg.norm(position - target))
        cost = distance * (1.0 + 0.25 * abs(abs(aside) - math.radians(35)))
        if cost < least:
            best, least = (position, target), cost
    assert best is not None
    return best


def _fit(points: np.ndarray, azimuth: float, fov: int | float, aspect: int | float) -> tuple[np.ndarray, np.ndarray]:
    """The closest camera in one direction that has every point in its pyramid."""
    away = np.array([math.cos(azimuth), math.sin(azimuth), 0.0])
    eye = math.cos(_ELEVATION) * away + np.array([0.0, 0.0, math.sin(_ELEVATION)])
    right = np.array([-away[1], away[0], 0.0])
    up = np.cross(eye, right)
    slopes = (math.tan(fov / 2) * aspect / _ROOM, math.tan(fov / 2) / _ROOM)
    towards = points @ eye
    centre, distance = np.zeros(3), 0.0
    for axis, slope in zip((right, up), slopes, strict=True):
        # a point at height h and depth d is inside where |h - c| <= slope * (distance - d)
        high, low = (points @ axis + slope * towards).max(), (points @ axis - slope * towards).min()
        centre = centre + axis * (high + low) / 2
        distance = max(distance, (high - low) / (2 * slope))
    depth = towards.mean()
    return centre + eye * distance, centre + eye * depth
