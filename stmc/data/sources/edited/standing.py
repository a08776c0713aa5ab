"""Recorded people who stand with their arms down: bodies that rest before and after an action, and turn on the spot.

Few recordings show that and nothing else. So these are people who do something with their arms, and stand on both feet:
of a wave of one hand, the waving arm is the mirror image of the resting one; of the others both arms are those of such
a wave. Kept are those in which the body stays calm: others lean against a wave that is no longer there.
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
BUSY = (
    "bye",
    "byebye",
    "guide",
    "respond",
    "stand",
    "direct-traffic",
    "referee-signals",
    "drink",
    "wash-window",
)
"""Actions of the arms in which people stand, shift their weight and look about."""

_DRAWS = 40
"""Draws of one kind before it is given up."""
_UPRIGHT = {"pelvis": 12.0, "spine3": 14.0, "head": 20.0}
"""Degrees by which these are farthest from upright in a calm body."""
_SWAY, _SHUFFLE = 0.15, 0.03
"""Metres by which the pelvis of a calm body moves at most, and its feet."""
_RESTLESS = 0.045
"""Metres a second of all joints on average: more is a wave that goes on without the arm."""
_STRAIGHT, _HANGING = 0.4, 0.36
"""Metres from the shoulder to the wrist of an arm that hangs, and metres down; stretched it has 0.466 m."""
_STANCE = 0.45
"""Metres between the feet at most."""
_ARMS = {part: [JOINTS.index(name) for name in part.joints if not name.endswith("hand")] for part in BodyPart}


def draw_standing(bases: Bases, rng: np.random.Generator, seconds: float, busy: float = 0.4) -> Base:
    """Somebody who stands for so long, arms hanging, mirrored as often as not; of the draws, a share `busy` are of
    `BUSY` people. Raises `Unusable` where no draw is long enough and calm."""
    draw = _busy if rng.random() < busy else _resting
    for _ in range(_DRAWS):
        try:
            base = draw(bases, rng, seconds)
        except Unusable:
            continue
        if is_calm(base.motion):
            turned = base.motion.mirrored() if rng.random() < 0.5 else base.motion
            return Base(base.name, base.recording, base.style, turned)
    raise Unusable(f"nobody stands calmly for {seconds:.1f} s in {_DRAWS} draws")


def _busy(bases: Bases, rng: np.random.Generator, seconds: float) -> Base:
    """A part of what `BUSY` people do, with the arms of somebody who rests."""
    base, other = _part(bases, BUSY[rng.integers(len(BUSY))], rng, seconds), _resting(bases, rng, seconds)
    arms = (BodyPart.LEFT_ARM, BodyPart.RIGHT_ARM)
    return Base(base.name, base.recording, base.style, _with_arms(base.motion, other.motion, arms))


def _resting(bases: Bases, rng: np.random.Generator, seconds: float) -> Base:
    """A part of a wave, without the wave."""
    action = WAVES[rng.integers(len(WAVES))]
    base = _part(bases, action, rng, seconds)
    arm = BodyPart.LEFT_ARM if action == WAVES[0] else BodyPart.RIGHT_ARM
    return Base(base.name, base.recording, base.style, _with_arms(base.motion, base.motion.mirrored(), (arm,)))


def _part(bases: Bases, action: str, rng: np.random.Generator, seconds: float) -> Base:
    """Any part of any clip of an action."""
    found = bases.get(action, ())
    if not found:
        raise Unusable(f"nothing is recorded of {action}")
    base = found[rng.integers(len(found))]
    frames = round(seconds * base.motion.fps)
    spare = base.motion.frames - frames
    if spare < 0:
        raise Unusable(f"{base.name} is shorter than {seconds:.1f} s")
    start = int(rng.integers(spare + 1))
    return Base(base.name, base.recording, base.style, base.motion.trimmed(start, start + frames))


def _with_arms(motion: Motion, other: Motion, arms: tuple[BodyPart, ...]) -> Motion:
    """The motion with these arms of another one, as they are relative to the chest."""
    rotations = motion.rotations.clone()
    for arm in arms:
        rotations[:, _ARMS[arm]] = other.rotations[:, _ARMS[arm]]
    return Motion.posed(rotations, motion.translation, motion.fps, Skeleton(Skeleton.default().offsets.double()))


def is_calm(motion: Motion) -> bool:
    """Whether somebody stands upright on both feet, the arms hanging, and moves little."""
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
    """Mean speed of the joints as seen from the pelvis, in metres a second; 0.01 to 0.05 in recordings of people who
    stand."""
    seen = motion.joints - motion.joints[:, :1]
    return float(seen.diff(dim=0).norm(dim=-1).mean()) * motion.fps


def _range(points: torch.Tensor) -> float:
    """The widest that points go on the ground, in metres."""
    return float((points[..., :2].amax(dim=0) - points[..., :2].amin(dim=0)).norm(dim=-1).max())
