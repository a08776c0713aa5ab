"""Turns on the spot in steps: one foot is the pivot, and the other foot walks round it."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from stmc.editing.keys import frame_times, minimum_jerk
from stmc.editing.leg_posing import SIDES, exact, match_dtype, reach_with_legs, select_legs, smooth, turn_joint
from stmc.motion.body import PARENTS
from stmc.motion.geometry import axis_angle_to_matrix, global_rotations, rotation_z
from stmc.motion.motion import Motion
from stmc.settings.records import SettingError

_EARLY = 0.08
"""Seconds by which the trunk leads the feet in each step."""
_PIVOTING, _SWINGING = (0.15, 0.85), (0.1, 0.9)
"""Intervals, as fractions of a step, in which the pivot foot turns, and in which the other foot is in the air."""
_OVER = 0.45
"""Fraction of the distance to the ball of the pivot foot that the pelvis moves while the other foot is in the air."""
_SINK = 0.012
"""Metres by which the pelvis sinks in each step."""
_HEEL = math.radians(7.0)
"""Pitch of the pivot foot while it turns, with its heel off the floor, in radians."""
_HEAD, _CHEST = 0.18, 0.05
"""Seconds by which head and chest lead the pelvis."""


def turn_on_spot(
    motion: Motion,
    angle: float | int,
    pivot: str = "left",
    steps: int = 2,
    start: float | int = 0.5,
    seconds: float | int = 0.65,
    lift: float | int = 0.08,
) -> Motion:
    """Turn a standing body on the spot in steps.

    The ball of the pivot foot stays in place while the foot turns about it; the other foot is lifted and goes round it.
    The pelvis moves over the pivot, and the head looks ahead. Before and after the turn, and above the hips, the body
    moves as in the original motion. Bones keep their lengths.

    Args:
        motion: Motion of a standing body.
        angle: Total angle in radians, positive to the left.
        pivot: Foot that turns in place, "left" or "right".
        steps: Number of steps.
        start: Time of the first step, in seconds.
        seconds: Duration of each step.
        lift: Metres by which the other foot is lifted.

    Raises:
        SettingError: If an argument is out of range, or if the steps do not fit into the motion.

    Examples:
        >>> [motion] = stmc.load().generate("stand # 0 # 3", steps=1)
        >>> stmc.turn_on_spot(motion, 3.14, pivot="left")
        Motion(60 frames at 20 fps, 3.00 s)
    """
    numbers = math.isfinite(angle + start + seconds + lift) and min(start, lift) >= 0 and seconds > 0
    if pivot not in SIDES or steps < 1 or not numbers:
        raise SettingError(
            f"angle={angle}, pivot={pivot}, steps={steps}, start={start}, seconds={seconds}, lift={lift}: "
            "pivot must be left or right, steps at least 1, and times and heights finite and not negative"
        )
    if start + steps * seconds > motion.duration:
        raise SettingError(f"{steps} steps of {seconds:g} s from {start:g} s on do not fit into {motion.duration:g} s")
    body, skeleton = exact(motion)
    plan = _Plan(frame_times(body), angle, steps, start, seconds)
    side = SIDES.index(pivot)
    world = select_legs(global_rotations(body.rotations, PARENTS), "ankle")
    balls, ankles = select_legs(body.joints, "foot"), select_legs(body.joints, "ankle")
    centre = balls[:, side].mean(dim=0)
    feet, ankles = _turn_feet(plan, side, centre, world, balls, ankles, lift)
    turn = plan.angles(-_EARLY, (0.0, 1.0))
    pelvis = _turn_about(body.translation, centre, turn)
    pelvis[:, :2] += (_OVER * plan.single_support)[:, None] * (centre - pelvis)[:, :2]
    pelvis[:, 2] -= _SINK * plan.bumps(_SWINGING)
    rotations = body.rotations.clone()
    rotations[:, 0] = rotation_z(turn) @ rotations[:, 0]
    speed = torch.gradient(turn)[0] * body.fps
    for name, ahead in (("spine3", _CHEST), ("neck", (_HEAD - _CHEST) / 2), ("head", (_HEAD - _CHEST) / 2)):
        rotations = turn_joint(rotations, name, ahead * smooth(speed, 0.1 * body.fps))
    posed = Motion.posed(rotations, pelvis, body.fps, skeleton)
    return match_dtype(reach_with_legs(posed, ankles, feet, skeleton), motion)


def _turn_feet(
    plan: _Plan, pivot: int, centre: Tensor, world: Tensor, balls: Tensor, ankles: Tensor, lift: float
) -> tuple[Float[Tensor, "frames 2 3 3"], Float[Tensor, "frames 2 3"]]:
    """Return the world rotations of the feet and the positions of the ankles."""
    feet, positions = world.clone(), ankles.clone()
    turns = plan.angles(0.0, _PIVOTING), plan.angles(0.0, _SWINGING)
    for foot, turn in zip((pivot, 1 - pivot), turns, strict=True):
        feet[:, foot] = rotation_z(turn) @ world[:, foot]
        positions[:, foot] = _turn_about(ankles[:, foot], centre, turn)
    positions[:, 1 - pivot, 2] += lift * plan.bumps(_SWINGING)
    ball = _turn_about(balls[:, pivot], centre, turns[0])
    tilt = axis_angle_to_matrix(_HEEL * plan.bumps(_PIVOTING)[:, None] * feet[:, pivot, :, 0])
    feet[:, pivot] = tilt @ feet[:, pivot]
    positions[:, pivot] = ball + (tilt @ (positions[:, pivot] - ball)[..., None])[..., 0]
    return feet, positions


def _turn_about(
    points: Float[Tensor, "frames 3"], centre: Float[Tensor, " 3"], angle: Float[Tensor, " frames"]
) -> Tensor:
    return centre + (rotation_z(angle) @ (points - centre)[..., None])[..., 0]


@dataclass(frozen=True)
class _Plan:
    """The timing of the steps of a turn."""

    times: Float[Tensor, " frames"]
    angle: float
    steps: int
    start: float
    seconds: float

    def _progress(self, delay: float, span: tuple[float, float]) -> Float[Tensor, "steps frames"]:
        """Compute the progress of each step, limited to `span`, an interval in fractions of the step, and delayed."""
        begins = self.start + delay + self.seconds * torch.arange(self.steps, dtype=torch.float64)
        fraction = (self.times - begins[:, None]) / self.seconds
        return ((fraction - span[0]) / (span[1] - span[0])).clamp(0, 1)

    def angles(self, delay: float, span: tuple[float, float]) -> Float[Tensor, " frames"]:
        """Compute the angle of each frame in radians: equal minimum-jerk turns in all steps."""
        return self.angle / self.steps * minimum_jerk(self._progress(delay, span)).sum(dim=0)

    def bumps(self, span: tuple[float, float]) -> Float[Tensor, " frames"]:
        """Compute a profile that rises from 0 to 1 and falls back in each step."""
        return (math.pi * self._progress(0.0, span)).sin().square().sum(dim=0)

    @property
    def single_support(self) -> Float[Tensor, " frames"]:
        """1 while one foot carries the body, 0 while both do; each change takes half a step."""
        end = self.start + self.steps * self.seconds
        near = torch.minimum(self.times - self.start + self.seconds / 4, end + self.seconds / 4 - self.times)
        fraction = (near / (self.seconds / 2)).clamp(0, 1)
        return fraction**2 * (3 - 2 * fraction)
