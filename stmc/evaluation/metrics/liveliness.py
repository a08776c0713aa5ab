"""Measures of life in motions: how much a body moves, how still it becomes, and how high its feet stay.

A person who stands still breathes and shifts the weight; a motion that freezes or floats does not look recorded. Values
have a meaning beside those of recordings at the same frame rate. Independent of texts and models.
"""

from __future__ import annotations

import torch

from stmc.motion.kinematics import joint
from stmc.motion.motion import Motion

CALM_SECONDS = 1.0
"""Seconds over which `rest_energy` averages."""


def motion_energy(motion: Motion) -> float:
    """Return the mean squared speed of all joints in the world, in m²/s²; 0 for a single frame."""
    squares = _squared_speeds(motion)
    return float(squares.mean()) if len(squares) else 0.0


def rest_energy(motion: Motion) -> float:
    """Return the motion energy of the calmest second, in m²/s²; that of the whole motion if it is shorter."""
    squares, frames = _squared_speeds(motion), round(CALM_SECONDS * motion.fps)
    if len(squares) <= frames:
        return motion_energy(motion)
    return float(squares.unfold(0, frames, 1).mean(dim=-1).min())


def lower_toe_height(motion: Motion) -> float:
    """Return the median height of the lower toe joint above the floor (z = 0), in metres.

    People who stand, walk or run have a foot on the floor most of the time; a body that floats never has one.
    """
    toes = torch.stack([joint(motion, f"{side}_foot")[:, 2] for side in ("left", "right")])
    return float(toes.amin(dim=0).median())


def _squared_speeds(motion: Motion) -> torch.Tensor:
    """Return the squared speed of each step, averaged over the joints."""
    return (motion.joints.diff(dim=0) * motion.fps).square().sum(dim=-1).mean(dim=-1)
