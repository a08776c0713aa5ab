"""Recorded people who stand with their arms down: bodies that rest before and after an action, and turn on the spot.

Few recordings show only that. The bodies are therefore people who use their arms and stand on both feet: in a wave of
one hand, the waving arm is replaced by the mirror image of the resting one; in other actions both arms are those of
such a wave. Only calm bodies are used, because others lean against a wave that no longer exists.
"""

from __future__ import annotations

import math

import numpy as np
import torch

from stmc.data.sources.edited.recipe import Base, Bases, Unusable
from stmc.motion.body import JOINTS, PARENTS, BodyPart
from stmc.motion.body_model import Skeleton
from stmc.motion.geometry import global_rotations
from stmc.motion.kinematics import joint
from stmc.motion.motion import Motion

WAVES = ("wave-left-hand", "wave-right-hand")
BUSY = ("bye", "byebye", "guide", "respond", "stand", "direct-traffic", "referee-signals", "drink", "wash-window")
"""Actions of the arms in which people stand, shift their weight and look about."""
_DRAWS = 40
"""Maximum number of draws of one kind."""
_UPRIGHT = {"pelvis": 12.0, "spine3": 14.0, "head": 20.0}
"""Maximum tilt in degrees in a calm body."""
_SWAY, _SHUFFLE = 0.15, 0.03
"""Maximum movement in metres of the pelvis and of the feet of a calm body."""
_RESTLESS = 0.045
"""Mean speed of all joints in m/s above which a wave continues without its arm."""
_STRAIGHT, _HANGING = 0.4, 0.36
"""Distance in metres between shoulder and wrist of a hanging arm, and its vertical part; a stretched arm has 0.466 m.
"""
_STANCE = 0.45
"""Maximum distance between the feet in metres."""
_ARMS = {part: [JOINTS.index(name) for name in part.joints if not name.endswith("hand")] for part in BodyPart}


def draw_standing(bases: Bases, rng: np.random.Generator, seconds: float, busy: float = 0.4) -> Base:
    """Draw a standing person with hanging arms, mirrored half of the time.

    Args:
        bases: Recorded clips.
        rng: Random generator.
        seconds: Duration in seconds.
        busy: Fraction of the draws from `BUSY` actions.

    Raises:
        Unusable: If no draw is long enough and calm.
    """
    draw = _busy if rng.random() < busy else _draw_resting
    for _ in range(_DRAWS):
        try:
            base = draw(bases, rng, seconds)
        except Unusable:
            continue
        if is_calm(base.motion):
            motion = base.motion.mirrored() if rng.random() < 0.5 else base.motion
            return Base(base.name, base.recording, base.style, motion)
    raise Unusable(f"nobody stands calmly for {seconds:.1f} s in {_DRAWS} draws")


def _busy(bases: Bases, rng: np.random.Generator, seconds: float) -> Base:
    """Draw a part of a `BUSY` action, with the arms of a resting person."""
    base, other = _part(bases, BUSY[rng.integers(len(BUSY))], rng, seconds), _draw_resting(bases, rng, seconds)
    arms = (BodyPart.LEFT_ARM, BodyPart.RIGHT_ARM)
    return Base(base.name, base.recording, base.style, _copy_arms(base.motion, other.motion, arms))


def _draw_resting(bases: Bases, rng: np.random.Generator, seconds: float) -> Base:
    """Draw a part of a wave, without the wave."""
    action = WAVES[rng.integers(len(WAVES))]
    base = _part(bases, action, rng, seconds)
    arm = BodyPart.LEFT_ARM if action == WAVES[0] else BodyPart.RIGHT_ARM
    return Base(base.name, base.recording, base.style, _copy_arms(base.motion, base.motion.mirrored(), (arm,)))


def _part(bases: Bases, action: str, rng: np.random.Generator, seconds: float) -> Base:
    """Draw any part of any clip of an action."""
    candidates = bases.get(action, ())
    if not candidates:
        raise Unusable(f"no recording of {action}")
    base = candidates[int(rng.integers(len(candidates)))]
    frames = round(seconds * base.motion.fps)
    spare = base.motion.frames - frames
    if spare < 0:
        raise Unusable(f"{base.name} is shorter than {seconds:.1f} s")
    start = int(rng.integers(spare + 1))
    return Base(base.name, base.recording, base.style, base.motion.trimmed(start, start + frames))


def _copy_arms(motion: Motion, other: Motion, arms: tuple[BodyPart, ...]) -> Motion:
    """Copy arms from another motion, relative to the chest."""
    rotations = motion.rotations.clone()
    for arm in arms:
        rotations[:, _ARMS[arm]] = other.rotations[:, _ARMS[arm]]
    return Motion.posed(rotations, motion.translation, motion.fps, Skeleton(Skeleton.default().offsets.double()))


def is_calm(motion: Motion) -> bool:
    """Return whether a person stands upright on both feet with hanging arms, and moves little."""
    pelvis, up = joint(motion, "pelvis"), global_rotations(motion.rotations, PARENTS)[:, :, 2, 1]
    sides = ("left", "right")
    feet = torch.stack([joint(motion, f"{side}_foot") for side in sides], dim=1)
    arms = torch.stack([joint(motion, f"{side}_wrist") - joint(motion, f"{side}_shoulder") for side in sides])
    return bool(
        all(up[:, JOINTS.index(name)].min() > math.cos(math.radians(most)) for name, most in _UPRIGHT.items())
        and _range(pelvis) < _SWAY
        and _range(feet) < _SHUFFLE
        and _restlessness(motion) < _RESTLESS
        and pelvis[:, 2].min() > 0.8
        and (feet[..., 2] < 0.08).all()
        and (arms.norm(dim=-1) > _STRAIGHT).all()
        and (arms[..., 2] < -_HANGING).all()
        and (feet[:, 0] - feet[:, 1]).norm(dim=-1).max() < _STANCE
    )


def _restlessness(motion: Motion) -> float:
    """Return the mean speed of the joints relative to the pelvis in m/s.

    It is 0.01 to 0.05 in recordings of standing people.
    """
    seen = motion.joints - motion.joints[:, :1]
    return float(seen.diff(dim=0).norm(dim=-1).mean()) * motion.fps


def _range(points: torch.Tensor) -> float:
    """Return the maximum extent of points on the ground, in metres."""
    return float((points[..., :2].amax(dim=0) - points[..., :2].amin(dim=0)).norm(dim=-1).max())
