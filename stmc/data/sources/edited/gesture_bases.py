"""Calm recorded bodies to put gestures on: stands, walks and seats whose own movement goes on under the gesture.

Knows which recorded actions leave a body at rest, and which of their arms does not rest.
"""

from __future__ import annotations

import math
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from stmc.data.sources.edited.recipe import Base, Bases, Unusable
from stmc.editing import copy_arm
from stmc.motion.body import JOINTS, PARENTS
from stmc.motion.body_model import Skeleton
from stmc.motion.geometry import axis_angle_to_matrix, global_rotations, matrix_to_axis_angle
from stmc.motion.motion import Motion

Kind = Literal["stand", "walk", "sit"]

_ACTIONS: dict[Kind, dict[str, tuple[float, str]]] = {
    "stand": {
        "raise-up-left-hand": (0.25, "left"),
        "raise-up-right-hand": (0.25, "right"),
        "wave-left-hand": (0.125, "left"),
        "wave-right-hand": (0.125, "right"),
        "stand": (0.25, ""),
    },
    "walk": {"walk": (0.75, ""), "walk-slow": (0.25, "")},
    "sit": {"sit": (1.0, "")},
}
"""Recorded actions by the kind of their bases: how often each is taken, and the arm that is not at rest in it."""

_TRUNK: dict[Kind, float] = {"stand": 10.0, "walk": 12.0, "sit": 30.0}
"""Degrees from upright that a trunk leans at most."""
_HEAD: dict[Kind, float] = {"stand": 32.0, "walk": 36.0, "sit": 60.0}
_SWAY = 0.12
"""Metres that the pelvis of a stand or a seat moves at most."""
_STANDING = 0.84
"""Metres above the floor below which a pelvis crouches, of the default body."""
_TRIES = 80


def draw_base(bases: Bases, rng: np.random.Generator, seconds: float, kind: Kind) -> Base:
    """A calm recorded body of this length at one of its moments; an arm that moves is replaced by the other one's
    mirror image, and stands and seats that are too short go back and forth.

    Raises `Unusable` where none was found.
    """
    actions = {action: row for action, row in _ACTIONS[kind].items() if bases.get(action)}
    shares = np.array([share for share, _ in actions.values()])
    for _ in range(_TRIES if actions else 0):
        action = list(actions)[rng.choice(len(actions), p=shares / shares.sum())]
        base = bases[action][rng.integers(len(bases[action]))]
        motion = _window(base.motion, seconds, rng, kind != "walk")
        if motion is not None and _is_calm(motion, kind, actions[action][1]):
            return Base(base.name, base.recording, base.style, _rested(motion, actions[action][1]))
    raise Unusable(f"no calm base of {seconds:.1f} s to {kind} among {', '.join(_ACTIONS[kind])}")


def _rested(motion: Motion, side: str) -> Motion:
    return copy_arm(motion, side) if side else motion


def _window(motion: Motion, seconds: float, rng: np.random.Generator, bounce: bool) -> Motion | None:
    """`seconds` of a motion from a random moment on; of a shorter one, if it may `bounce`, back and forth."""
    frames = round(seconds * motion.fps)
    if motion.frames >= frames:
        start = int(rng.integers(motion.frames - frames + 1))
        return motion.trimmed(start, start + frames)
    if not bounce or motion.frames < motion.fps:
        return None
    return _bounced(motion, frames, float(rng.uniform(0, 2 * math.pi)))


def _bounced(motion: Motion, frames: int, phase: float) -> Motion:
    """The motion forwards and backwards, slower towards its ends, until `frames` are full."""
    last = motion.frames - 1
    angle = torch.arange(frames, dtype=torch.float64) * (math.pi / (1.5 * last)) + phase
    at = (last - 1e-6) * (1 - torch.cos(angle)) / 2
    before, share = at.long(), at - at.floor()
    arc = matrix_to_axis_angle(motion.rotations[before].mT @ motion.rotations[before + 1])
    rotations = motion.rotations[before] @ axis_angle_to_matrix(arc * share[:, None, None])
    translation = torch.lerp(motion.translation[before], motion.translation[before + 1], share[:, None])
    return Motion.posed(rotations, translation, motion.fps, Skeleton.measured(motion.rotations, motion.joints))


def _is_calm(motion: Motion, kind: Kind, moved: str) -> bool:
    """Whether trunk and head are upright, the pelvis still, and the arms that are not replaced hang or lie."""
    world = global_rotations(motion.rotations, PARENTS)
    if _tilt(world, "spine3") > _TRUNK[kind] or _tilt(world, "head") > _HEAD[kind]:
        return False
    if kind == "stand" and motion.translation[:, 2].min() < _STANDING:
        return False
    ground = motion.translation[:, :2]
    if kind != "walk" and (ground.amax(dim=0) - ground.amin(dim=0)).norm() > _SWAY:
        return False
    resting = [JOINTS.index(f"{side}_wrist") for side in ("left", "right") if side != moved]
    above = motion.joints[:, resting, 2] - motion.translation[:, 2:]
    return bool(above.max() < (0.12 if kind == "walk" else 0.0 if kind == "stand" else 0.2))


def _tilt(world: Float[Tensor, "frames 24 3 3"], joint: str) -> float:
    """The most degrees that the joint's upward axis is from the vertical."""
    return float(torch.rad2deg(torch.acos(world[:, JOINTS.index(joint), 2, 1].clamp(-1, 1))).max())
