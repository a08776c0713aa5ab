"""Recorded people who stand: bodies that rest before and after an action, and that turn on the spot.

Of Bandai's waves of one hand the waving arm is replaced by the mirror image of the resting one; kept are those in which
the body stays calm: others lean against a wave that is no longer there.
"""

from __future__ import annotations

import math

import numpy as np
import torch

from stmc.body import JOINTS, BodyPart
from stmc.body_model import Skeleton
from stmc.data.sources.edited.recipe import Base, Bases, Unusable
from stmc.motion import Motion

WAVES = ("wave-left-hand", "wave-right-hand")

_LEAN, _NOD = math.radians(9.0), math.radians(32.0)
"""The farthest that trunk and head of a calm body are from upright."""
_SWAY, _SHUFFLE = 0.12, 0.03
"""Metres by which the pelvis of a calm body moves at most, and its feet."""


def draw_standing(bases: Bases, rng: np.random.Generator, seconds: float) -> Base:
    """Somebody who stands for so long, arms hanging. Raises `Unusable` for a draw that is too short or not calm."""
    action = WAVES[rng.integers(2)]
    base = bases[action][rng.integers(len(bases[action]))]
    frames = round(seconds * base.motion.fps)
    spare = base.motion.frames - frames
    if spare < 0:
        raise Unusable(f"{base.name} is shorter than {seconds:g} s")
    start = int(rng.integers(spare + 1))
    motion = with_resting_arm(base.motion.trimmed(start, start + frames), action)
    if not is_calm(motion):
        raise Unusable(f"{base.name} does not stand calmly")
    return Base(base.name, base.recording, base.style, motion.mirrored() if rng.random() < 0.5 else motion)


def with_resting_arm(motion: Motion, action: str) -> Motion:
    """A wave of one hand without it: that arm is the mirror image of the other one."""
    arm = BodyPart.LEFT_ARM if action == WAVES[0] else BodyPart.RIGHT_ARM
    joints = [JOINTS.index(name) for name in arm.joints if not name.endswith("hand")]
    rotations = motion.rotations.clone()
    rotations[:, joints] = motion.mirrored().rotations[:, joints]
    return Motion.posed(rotations, motion.translation, motion.fps, Skeleton(Skeleton.default().offsets.double()))


def is_calm(motion: Motion) -> bool:
    """Whether somebody stands upright on both feet, the arms down, and moves little."""
    pelvis, chest, head = (motion.joints[:, JOINTS.index(name)] for name in ("pelvis", "neck", "head"))
    feet = motion.joints[:, [JOINTS.index(f"{side}_foot") for side in ("left", "right")]]
    hands = motion.joints[:, [JOINTS.index(f"{side}_wrist") for side in ("left", "right")], 2]
    top = motion.joints[:, JOINTS.index("head")] + 0  # the head's joint lies at the base of the skull
    return bool(
        _tilt(chest - pelvis) < _LEAN
        and _tilt(top - chest) < _NOD
        and _range(pelvis) < _SWAY
        and _range(feet) < _SHUFFLE
        and (hands < pelvis[:, None, 2] + 0.15).all()
        and (head[:, 2] > chest[:, 2]).all()
    )


def _tilt(bones: torch.Tensor) -> float:
    return float(torch.atan2(bones[:, :2].norm(dim=-1), bones[:, 2]).max())


def _range(points: torch.Tensor) -> float:
    """The widest that points go on the ground, in metres."""
    return float((points[..., :2].amax(dim=0) - points[..., :2].amin(dim=0)).norm(dim=-1).max())
