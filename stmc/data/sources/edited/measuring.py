"""What gates of recipes look at: how far and how fast a motion goes, how much it turns, and when feet stand.

Knows motions in metres and radians; knows no recipe.
"""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from stmc.motion.kinematics import joint
from stmc.motion.motion import Motion

STILL = 0.3
"""Metres a second below which a foot stands."""


def distance(motion: Motion) -> float:
    """Metres on the ground between the pelvis' first and last place."""
    return float((motion.translation[-1] - motion.translation[0])[:2].norm())


def pace(motion: Motion) -> float:
    """Mean speed of the pelvis' way on the ground, averaged over half a second, in metres a second."""
    step = max(1, round(motion.fps / 2))
    ground = motion.translation[::step, :2]
    return float(ground.diff(dim=0).norm(dim=-1).sum() / ((len(ground) - 1) * step) * motion.fps)


def forward(motion: Motion) -> float:
    """Metres that the body goes ahead, in its first heading."""
    way = motion.translation[-1] - motion.translation[0]
    return float(way @ motion.facing[0])


def leftward(motion: Motion) -> float:
    """Metres that the body goes to its left, in its first heading."""
    way, ahead = motion.translation[-1] - motion.translation[0], motion.facing[0]
    return float(-way[0] * ahead[1] + way[1] * ahead[0])


def turned(motion: Motion) -> Float[np.ndarray, " frames"]:
    """Degrees that the body has turned to the left since its first frame, also beyond 360."""
    heading = np.unwrap(motion.heading.numpy())
    return np.degrees(heading - heading[0])


def foot_speed(motion: Motion, side: str) -> Float[Tensor, " steps"]:
    """Metres a second of the toes' joint."""
    return joint(motion, f"{side}_foot").diff(dim=0).norm(dim=-1) * motion.fps


def both_stand(motion: Motion) -> Bool[Tensor, " steps"]:
    """Whether both feet stand, from each frame to the next."""
    low = torch.stack([joint(motion, f"{side}_foot")[1:, 2] < 0.08 for side in ("left", "right")])
    still = torch.stack([foot_speed(motion, side) < STILL for side in ("left", "right")])
    return (low & still).all(dim=0)


def flights(motion: Motion) -> int:
    """How many times both feet are in the air together, for a tenth of a second or more."""
    feet = torch.stack([joint(motion, f"{side}_foot")[:, 2] for side in ("left", "right")])
    air = torch.nn.functional.pad((feet.amin(dim=0) > 0.06).int(), (1, 1)).diff()
    starts, ends = (air > 0).nonzero()[:, 0], (air < 0).nonzero()[:, 0]
    return int(((ends - starts) >= round(0.1 * motion.fps)).sum())


def rests(motion: Motion, seconds: float) -> bool:
    """Whether both feet stand at the end for so long, and the body is upright."""
    frames = round(seconds * motion.fps)
    upright = joint(motion, "pelvis")[-1, 2] > 0.8
    return bool(both_stand(motion)[-frames:].all() and upright)


def steady(motion: Motion, share: float = 0.6) -> tuple[int, int]:
    """The frames between which the body goes at more than this share of its median speed."""
    step = round(motion.fps / 2)
    ground = motion.translation[:, :2]
    if len(ground) <= 2 * step:
        return 0, motion.frames
    fast = (ground[step:] - ground[:-step]).norm(dim=-1)
    going = (fast > share * fast.median()).nonzero()[:, 0]
    return int(going[0]), int(going[-1]) + step + 1
