"""Recipes of kicks with the left foot: single recorded kicks, sided by geometry, and low kicks of standing bodies."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from stmc.data.sources.edited.jumping import surround_with_rest
from stmc.data.sources.edited.measuring import degrees_turned, foot_speed, rests
from stmc.data.sources.edited.recipe import Base, Bases, Draft, Recipe, Unusable
from stmc.data.sources.edited.script import ONSET
from stmc.data.sources.edited.standing import draw_standing
from stmc.editing.keys import minimum_jerk
from stmc.editing.leg_posing import exact, reach_with_legs, select_legs, smooth
from stmc.editing.paths import change_pace
from stmc.motion.body import JOINTS, PARENTS
from stmc.motion.geometry import axis_angle_to_matrix, global_rotations
from stmc.motion.kinematics import joint
from stmc.motion.motion import Motion

_APART = 0.15
"""Minimum height in metres of the kicking foot above the other one."""


def _top(motion: Motion, side: str) -> float:
    return float(joint(motion, f"{side}_foot")[:, 2].max())


def _draw(bases: Bases, rng: np.random.Generator, actions: tuple[str, ...], longest: float) -> Base:
    """Draw a recorded kick, mirrored if it is one of the right foot.

    Raises `Unusable` for several kicks, and for a kick of an uncertain side.
    """
    candidates = [base for action in actions for base in bases[action]]
    base = candidates[rng.integers(len(candidates))]
    motion = base.motion if _top(base.motion, "left") > _top(base.motion, "right") else base.motion.mirrored()
    if motion.duration > longest or _top(motion, "left") < _top(motion, "right") + _APART:
        raise Unusable(f"{base.name} is not one kick of one foot")
    return Base(base.name, base.recording, base.style, motion)


def high_kick(bases: Bases, rng: np.random.Generator) -> Draft:
    """Draw a recorded high kick, and add rest."""
    base = _draw(bases, rng, ("kick",), 2.5)
    motion = change_pace(base.motion, tempo=rng.uniform(0.88, 1.1), stride=rng.uniform(0.7, 1.1))
    return Draft(surround_with_rest(motion, bases, rng), base.recording)


def _is_high(motion: Motion) -> bool:
    fast = float(foot_speed(motion, "left").max()) > 4
    one = _top(motion, "left") > 0.9 and _top(motion, "right") < 0.3
    return fast and one and abs(degrees_turned(motion)[-1]) < 150 and rests(motion, 0.5)


def kicked_ball(bases: Bases, rng: np.random.Generator) -> Draft:
    """Draw a recorded kick of a ball."""
    base = _draw(bases, rng, ("kick-ball",), 2.5)
    return Draft(change_pace(base.motion, tempo=rng.uniform(0.85, 1.05)), base.recording)


def low_kick(bases: Bases, rng: np.random.Generator) -> Draft:
    """Draw a standing body, and swing its left leg back and forward."""
    start = ONSET
    base = draw_standing(bases, rng, start + rng.uniform(2.8, 4.2))
    kick = LowKick(
        start=start,
        back=math.radians(rng.uniform(18, 34)),
        forward=math.radians(rng.uniform(32, 58)),
        windup=rng.uniform(0.4, 0.45),
        swing=rng.uniform(0.19, 0.23),
        recovery=rng.uniform(0.5, 0.75),
        hold=rng.uniform(0.0, 0.1),
    )
    return Draft(kick(base.motion), base.recording)


def _is_low(motion: Motion) -> bool:
    fast = float(foot_speed(motion, "left").max()) > 4
    return fast and 0.2 < _top(motion, "left") < 0.75 and _top(motion, "right") < 0.2


@dataclass(frozen=True)
class LowKick:
    """A kick of the left leg.

    `back` and `forward` are angles of the leg about the hip in radians; the other fields are times in seconds.
    """

    start: float
    back: float
    forward: float
    windup: float
    swing: float
    recovery: float
    hold: float

    _OVER = 0.75
    """Fraction of the way to the standing foot that the pelvis moves."""
    _BENT, _STRETCHED, _CLEAR = 0.8, 0.975, 0.1
    """Length of the leg at the end of the windup, at the end of the swing, and its reduction on the way back, as
    fractions of the full length."""
    _LEAN, _TWIST, _ARMS = 0.14, 0.2, 0.45
    """Lean of the trunk, turn of the pelvis and swing of the arms per radian of the leg."""

    def __call__(self, motion: Motion) -> Motion:
        """Add the kick to the motion of a standing body."""
        body, skeleton = exact(motion)
        swing, reach, weight = self._course(body)
        lateral, ahead = body.rotations[0, 0, :, 0], body.facing[0]
        ankles = select_legs(body.joints, "ankle")
        over = (ankles[:, 1] - body.translation) * body.translation.new_tensor([1.0, 1.0, 0.0])
        across = over - (over @ ahead)[:, None] * ahead
        positions = body.translation + self._OVER * weight[:, None] * across
        rotations = self._counter(body.rotations, lateral, smooth(swing, 1.5))
        posed = Motion.posed(rotations, positions, body.fps, skeleton)
        hip = joint(posed, "left_hip")
        rest = ankles[:, 0] - hip
        leg = float(skeleton.offsets[[JOINTS.index("left_knee"), JOINTS.index("left_ankle")]].norm(dim=-1).sum())
        length = rest.norm(dim=-1) * (1 - weight) + leg * weight * reach
        free = (
            _rotation_about(lateral, -swing)
            @ torch.lerp(rest, rest.norm(dim=-1, keepdim=True) * _DOWN, weight[:, None])[..., None]
        )
        targets = ankles.clone()
        targets[:, 0] = hip + free[..., 0] * (length / rest.norm(dim=-1))[:, None]
        feet = select_legs(global_rotations(body.rotations, PARENTS), "ankle")
        kicked = reach_with_legs(posed, targets, feet, skeleton)
        shin = global_rotations(kicked.rotations, PARENTS)[:, JOINTS.index("left_knee")]
        feet[:, 0] = shin @ body.rotations[:, JOINTS.index("left_ankle")]
        return reach_with_legs(posed, targets, feet, skeleton)

    def _course(self, motion: Motion) -> tuple[Tensor, Tensor, Tensor]:
        """Return the leg's angle (forward positive), the fraction of its length, and the weight on the right foot, over
        time.
        """
        times = torch.arange(motion.frames, dtype=torch.float64) / motion.fps
        ends = np.cumsum([self.start, self.windup, self.swing, self.hold, self.recovery])
        swing, reach = torch.zeros_like(times), torch.ones_like(times)
        for (begin, end), angle, length in (
            (ends[:2], -self.back, self._BENT),
            (ends[1:3], self.forward, self._STRETCHED),
            (ends[3:5], 0.0, 1.0),
        ):
            weight = _ease((times - begin) / (end - begin))
            swing, reach = torch.lerp(swing, torch.full_like(swing, angle), weight), reach + weight * (length - reach)
        back = ((times - ends[3]) / self.recovery).clamp(0, 1)
        reach = reach - self._CLEAR * (math.pi * back).sin().square()
        weight = _ease((times - ends[0] + 0.15) / 0.35) * _ease((ends[4] + 0.1 - times) / 0.35)
        return swing, reach, weight

    def _counter(self, rotations: Tensor, lateral: Tensor, swing: Tensor) -> Float[Tensor, "frames 22 3 3"]:
        """Rotate trunk, pelvis and arms against the swing of the leg."""
        up = lateral.new_tensor([0.0, 0.0, 1.0])
        rotations = rotations.clone()
        rotations[:, 0] = (
            _rotation_about(up, -self._TWIST * swing) @ _rotation_about(lateral, -self._LEAN * swing) @ rotations[:, 0]
        )
        for name, axis, angle in (
            ("spine3", up, 1.5 * self._TWIST * swing),
            ("left_shoulder", lateral, self._ARMS * swing),
            ("right_shoulder", lateral, -self._ARMS * swing),
        ):
            index = JOINTS.index(name)
            above = global_rotations(rotations, PARENTS)[:, PARENTS[index]]
            rotations[:, index] = above.mT @ _rotation_about(axis, angle) @ above @ rotations[:, index]
        return rotations


_DOWN = torch.tensor([0.0, 0.0, -1.0], dtype=torch.float64)


def _rotation_about(axis: Float[Tensor, " 3"], angle: Float[Tensor, " frames"]) -> Float[Tensor, "frames 3 3"]:
    return axis_angle_to_matrix(angle[:, None] * axis)


def _ease(fraction: Tensor) -> Tensor:
    return minimum_jerk(fraction.clamp(0, 1))


RECIPES = (
    Recipe("high-kick-left", "edited", high_kick, _is_high, clips=80),
    Recipe("low-kick-left", "edited", kicked_ball, _is_low, clips=20),
    Recipe("low-kick-left", "authored", low_kick, _is_low, clips=70),
)
"""Recipes in the order of the data set."""
