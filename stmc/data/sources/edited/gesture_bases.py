"""Calm recorded bodies for gestures: standing, walking and sitting people who keep moving below the gesture.

Depends on the recorded actions in which a body rests, and the arm that does not rest in each.
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
"""Recorded actions by the kind of their bases: the probability of each, and the arm that is not at rest in it."""

_TRUNK: dict[Kind, float] = {"stand": 10.0, "walk": 12.0, "sit": 30.0}
"""Maximum lean of a trunk from upright in degrees."""
_HEAD: dict[Kind, float] = {"stand": 32.0, "walk": 36.0, "sit": 60.0}
_SWAY = 0.12
"""Maximum movement of the pelvis of a standing or sitting person in metres."""
_STANDING = 0.84
"""Height in metres below which the pelvis of the default body crouches."""
_TRIES = 80


def draw_base(bases: Bases, rng: np.random.Generator, seconds: float, kind: Kind) -> Base:
    """Draw a random part of a calm recorded body.

    A moving arm is replaced by the mirror image of the other one; standing and sitting bodies that are too short go
    back and forth.

    Args:
        bases: Recorded clips.
        rng: Random generator.
        seconds: Duration in seconds.
        kind: "stand", "walk" or "sit".

    Raises:
        Unusable: If none is found.
    """
    actions = {action: row for action, row in _ACTIONS[kind].items() if bases.get(action)}
    weights = np.array([weight for weight, _ in actions.values()])
    for _ in range(_TRIES if actions else 0):
        action = list(actions)[rng.choice(len(actions), p=weights / weights.sum())]
        base = bases[action][int(rng.integers(len(bases[action])))]
        motion = _window(base.motion, seconds, rng, kind != "walk")
        if motion is not None and _is_calm(motion, kind, actions[action][1]):
            busy = actions[action][1]
            return Base(base.name, base.recording, base.style, copy_arm(motion, busy) if busy else motion)
    raise Unusable(f"no calm base of {seconds:.1f} s to {kind} among {', '.join(_ACTIONS[kind])}")


def _window(motion: Motion, seconds: float, rng: np.random.Generator, bounce: bool) -> Motion | None:
    """Cut `seconds` of a motion at random; a shorter motion goes back and forth if it may `bounce`."""
    frames = round(seconds * motion.fps)
    if motion.frames >= frames:
        start = int(rng.integers(motion.frames - frames + 1))
        return motion.trimmed(start, start + frames)
    if not bounce or motion.frames < motion.fps:
        return None
    return _bounce(motion, frames, float(rng.uniform(0, 2 * math.pi)))


def _bounce(motion: Motion, frames: int, phase: float) -> Motion:
    """Play the motion forwards and backwards, slower towards its ends, for a number of frames."""
    last = motion.frames - 1
    angle = torch.arange(frames, dtype=torch.float64) * (math.pi / (1.5 * last)) + phase
    position = (last - 1e-6) * (1 - torch.cos(angle)) / 2
    before, weight = position.long(), position - position.floor()
    arc = matrix_to_axis_angle(motion.rotations[before].mT @ motion.rotations[before + 1])
    rotations = motion.rotations[before] @ axis_angle_to_matrix(arc * weight[:, None, None])
    translation = torch.lerp(motion.translation[before], motion.translation[before + 1], weight[:, None])
    return Motion.posed(rotations, translation, motion.fps, Skeleton.measured(motion.rotations, motion.joints))


def _is_calm(motion: Motion, kind: Kind, moved: str) -> bool:
    """Return whether trunk and head are upright, the pelvis is still, and the arms that are not replaced rest."""
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
    """Return the maximum angle in degrees between the joint's upward axis and the vertical."""
    return float(torch.rad2deg(torch.acos(world[:, JOINTS.index(joint), 2, 1].clamp(-1, 1))).max())
