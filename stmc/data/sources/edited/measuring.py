"""Measures for the gates of recipes: distance, speed and turning of a motion, and contacts of the feet."""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from stmc.motion.kinematics import joint
from stmc.motion.motion import Motion

STILL = 0.3
"""Speed in m/s below which a foot stands."""


def distance(motion: Motion) -> float:
    """Return the horizontal distance between the first and last position of the pelvis in metres."""
    return float((motion.translation[-1] - motion.translation[0])[:2].norm())


def pace(motion: Motion) -> float:
    """Return the mean speed of the pelvis over the floor, averaged over half a second, in m/s."""
    step = max(1, round(motion.fps / 2))
    ground = motion.translation[::step, :2]
    return float(ground.diff(dim=0).norm(dim=-1).sum() / ((len(ground) - 1) * step) * motion.fps)


def forward(motion: Motion) -> float:
    """Return the distance in metres that the body moves ahead, in its first heading."""
    offset = motion.translation[-1] - motion.translation[0]
    return float(offset @ motion.facing[0])


def leftward(motion: Motion) -> float:
    """Return the distance in metres that the body moves to its left, in its first heading."""
    offset, ahead = motion.translation[-1] - motion.translation[0], motion.facing[0]
    return float(-offset[0] * ahead[1] + offset[1] * ahead[0])


def degrees_turned(motion: Motion) -> Float[np.ndarray, " frames"]:
    """Return the angle in degrees that the body has turned left since its first frame, including full turns."""
    heading = np.unwrap(motion.heading.numpy())
    return np.degrees(heading - heading[0])


def foot_speed(motion: Motion, side: str) -> Float[Tensor, " steps"]:
    """Return the speed of the toe joint in m/s."""
    return joint(motion, f"{side}_foot").diff(dim=0).norm(dim=-1) * motion.fps


def both_stand(motion: Motion) -> Bool[Tensor, " steps"]:
    """Return whether both feet stand, from each frame to the next."""
    low = torch.stack([joint(motion, f"{side}_foot")[1:, 2] < 0.08 for side in ("left", "right")])
    still = torch.stack([foot_speed(motion, side) < STILL for side in ("left", "right")])
    return (low & still).all(dim=0)


def flights(motion: Motion) -> int:
    """Count the times that both feet are in the air together, for a tenth of a second or more."""
    feet = torch.stack([joint(motion, f"{side}_foot")[:, 2] for side in ("left", "right")])
    air = torch.nn.functional.pad((feet.amin(dim=0) > 0.06).int(), (1, 1)).diff()
    starts, ends = (air > 0).nonzero()[:, 0], (air < 0).nonzero()[:, 0]
    return int(((ends - starts) >= round(0.1 * motion.fps)).sum())


def rests(motion: Motion, seconds: float) -> bool:
    """Return whether both feet stand for the last `seconds`, and the body is upright."""
    frames = round(seconds * motion.fps)
    upright = joint(motion, "pelvis")[-1, 2] > 0.8
    return bool(both_stand(motion)[-frames:].all() and upright)


def steady(motion: Motion, share: float = 0.6) -> tuple[int, int]:
    """Return the frames between which the body moves faster than the fraction `share` of its median speed."""
    step = round(motion.fps / 2)
    ground = motion.translation[:, :2]
    if len(ground) <= 2 * step:
        return 0, motion.frames
    fast = (ground[step:] - ground[:-step]).norm(dim=-1)
    going = (fast > share * fast.median()).nonzero()[:, 0]
    return int(going[0]), int(going[-1]) + step + 1
