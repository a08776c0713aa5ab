"""Turns on the spot, stepped by a body that stood: one foot is the pivot, the other one walks round it.

Knows motions and legs; knows no text and no features.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from stmc.editing.keys import frame_times, minimum_jerk
from stmc.editing.leg_posing import SIDES, exact, like, of_legs, reach_with_legs, smooth, turn_joint
from stmc.motion.body import PARENTS
from stmc.motion.geometry import axis_angle_to_matrix, global_rotations, rotation_z
from stmc.motion.motion import Motion
from stmc.settings.records import SettingError

_EARLY = 0.08
"""Seconds by which the trunk begins each step before the feet."""
_PIVOTING, _SWINGING = (0.15, 0.85), (0.1, 0.9)
"""The shares of a step in which the pivot foot turns, and in which the other one is in the air."""
_OVER = 0.45
"""How much of its way over the pivot's ball the pelvis comes while the other foot is in the air."""
_SINK = 0.012
"""Metres that the pelvis sinks in each step."""
_HEEL = math.radians(7.0)
"""The pitch of the pivot foot while it turns: its heel comes off the floor."""
_HEAD, _CHEST = 0.18, 0.05
"""Seconds by which head and chest turn ahead of the pelvis."""


def turn_on_spot(
    motion: Motion,
    angle: float | int,
    pivot: str = "left",
    steps: int = 2,
    start: float | int = 0.5,
    seconds: float | int = 0.65,
    lift: float | int = 0.08,
) -> Motion:
    """The motion of a body that stands, turned on the spot by `angle` (radians, positive to the left).

    From `start` on (seconds), `steps` steps of `seconds` each: the ball of the `pivot` foot stays in its place while
    the foot turns about it; the other foot is lifted by `lift` metres and goes round it. The pelvis comes over the
    pivot, the head looks ahead. Before and after, and above the hips, the body goes on moving as it did. Bones keep
    their lengths. Raises `SettingError` for steps that do not fit into the motion.

    Examples:
        >>> [motion] = stmc.load().generate("stand # 0 # 3", steps=1)
        >>> stmc.turn_on_spot(motion, 3.14, pivot="left")
        Motion(60 frames at 20 fps, 3.00 s)
    """
    numbers = math.isfinite(angle + start + seconds + lift) and min(start, lift) >= 0 and seconds > 0
    if pivot not in SIDES or steps < 1 or not numbers:
        raise SettingError(
            f"angle={angle}, pivot={pivot}, steps={steps}, start={start}, seconds={seconds}, lift={lift}: "
            "left or right, at least one step, finite times and heights from 0 on"
        )
    if start + steps * seconds > motion.duration:
        raise SettingError(f"{steps} steps of {seconds:g} s from {start:g} s on do not fit in {motion.duration:g} s")
    body, skeleton = exact(motion)
    plan = _Plan(frame_times(body), angle, steps, start, seconds)
    side = SIDES.index(pivot)
    world, balls, ankles = (
        of_legs(values, name)
        for values, name in (
            (global_rotations(body.rotations, PARENTS), "ankle"),
            (body.joints, "foot"),
            (body.joints, "ankle"),
        )
    )
    centre = balls[:, side].mean(dim=0)
    feet, ankles = _feet(plan, side, centre, world, balls, ankles, lift)
    turn = plan.turned(-_EARLY, (0.0, 1.0))
    pelvis = _turned(body.translation, centre, turn)
    pelvis[:, :2] += (_OVER * plan.over)[:, None] * (centre - pelvis)[:, :2]
    pelvis[:, 2] -= _SINK * plan.lifted(_SWINGING)
    rotations = body.rotations.clone()
    rotations[:, 0] = rotation_z(turn) @ rotations[:, 0]
    speed = torch.gradient(turn)[0] * body.fps
    for name, ahead in (("spine3", _CHEST), ("neck", (_HEAD - _CHEST) / 2), ("head", (_HEAD - _CHEST) / 2)):
        rotations = turn_joint(rotations, name, ahead * smooth(speed, 0.1 * body.fps))
    return like(reach_with_legs(Motion.posed(rotations, pelvis, body.fps, skeleton), ankles, feet, skeleton), motion)


def _feet(
    plan: _Plan, pivot: int, centre: Tensor, world: Tensor, balls: Tensor, ankles: Tensor, lift: float
) -> tuple[Float[Tensor, "frames 2 3 3"], Float[Tensor, "frames 2 3"]]:
    """The feet's rotations to the world and the places of the ankles."""
    feet, places = world.clone(), ankles.clone()
    turns = plan.turned(0.0, _PIVOTING), plan.turned(0.0, _SWINGING)
    for foot, turn in zip((pivot, 1 - pivot), turns, strict=True):
        feet[:, foot] = rotation_z(turn) @ world[:, foot]
        places[:, foot] = _turned(ankles[:, foot], centre, turn)
    places[:, 1 - pivot, 2] += lift * plan.lifted(_SWINGING)
    ball = _turned(balls[:, pivot], centre, turns[0])
    tilt = axis_angle_to_matrix(_HEEL * plan.lifted(_PIVOTING)[:, None] * feet[:, pivot, :, 0])
    feet[:, pivot] = tilt @ feet[:, pivot]
    places[:, pivot] = ball + (tilt @ (places[:, pivot] - ball)[..., None])[..., 0]
    return feet, places


def _turned(points: Float[Tensor, "frames 3"], centre: Float[Tensor, " 3"], angle: Float[Tensor, " frames"]) -> Tensor:
    return centre + (rotation_z(angle) @ (points - centre)[..., None])[..., 0]


@dataclass(frozen=True)
class _Plan:
    """When the steps of a turn are, and how far it has come."""

    times: Float[Tensor, " frames"]
    angle: float
    steps: int
    start: float
    seconds: float

    def _shares(self, delay: float, span: tuple[float, float]) -> Float[Tensor, "steps frames"]:
        """How much of each step is done, if it begins and ends at the shares `span` of its time, later by `delay`."""
        begins = self.start + delay + self.seconds * torch.arange(self.steps, dtype=torch.float64)
        share = (self.times - begins[:, None]) / self.seconds
        return ((share - span[0]) / (span[1] - span[0])).clamp(0, 1)

    def turned(self, delay: float, span: tuple[float, float]) -> Float[Tensor, " frames"]:
        """Radians: a minimum jerk in each step, all of the same angle."""
        return self.angle / self.steps * minimum_jerk(self._shares(delay, span)).sum(dim=0)

    def lifted(self, span: tuple[float, float]) -> Float[Tensor, " frames"]:
        """From 0 to 1 and back in each step."""
        return (math.pi * self._shares(0.0, span)).sin().square().sum(dim=0)

    @property
    def over(self) -> Float[Tensor, " frames"]:
        """1 while one foot carries the body, 0 while it stands on both; half a step to come and to go."""
        end = self.start + self.steps * self.seconds
        near = torch.minimum(self.times - self.start + self.seconds / 4, end + self.seconds / 4 - self.times)
        share = (near / (self.seconds / 2)).clamp(0, 1)
        return share**2 * (3 - 2 * share)
