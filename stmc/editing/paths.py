"""Changes of path, pace and direction: an edit bends or stretches the ground, and the body follows.

Points of the ground have two coordinates: along the straight line from the pelvis' first position to its last, and to
the left of it. An edit moves the points of the ground; pelvis and ankles each move with the ground below them, and the
legs follow by inverse kinematics. A standing foot therefore stays in one place and does not begin to slide.
Depends on motions and legs; independent of text and features.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from stmc.editing.leg_posing import exact, match_dtype, reach_with_legs, select_legs, smooth, turn_joint
from stmc.motion.body import JOINTS, PARENTS
from stmc.motion.body_model import Skeleton
from stmc.motion.geometry import (
    axis_angle_to_matrix,
    global_rotations,
    matrix_to_axis_angle,
    matrix_to_quaternion,
    quaternion_to_matrix,
    rotation_z,
)
from stmc.motion.motion import Motion
from stmc.settings.records import SettingError

Moved = tuple[Float[Tensor, "frames 3 2"], Float[Tensor, "frames 3"]]
"""New positions of the ground below the pelvis and both ankles, and the angles (radians) by which it turns."""
_SHORTEST = 0.05
"""Metres between the ends of the shortest path."""
_GRID = 0.002
"""Metres between the points at which a curve is integrated."""
_BEYOND = 2.0
"""Metres before and after the path over which the ground is bent too, since feet go ahead of the pelvis."""
_GRAVITY = 9.81
_LEAN = 0.7
"""Fraction of the lean that would align the body with gravity and centrifugal force: people lean less."""
_AHEAD = 0.15
"""Seconds by which the head looks ahead in a curve."""
_ARMS = [JOINTS.index(f"{side}_{name}") for side in ("left", "right") for name in ("collar", "shoulder", "elbow")]
_TURN, _SLOW = 2.0, 6.0
"""Standard deviations of the Gaussians that smooth the pelvis' turn and the lean, in frames at 20 fps."""


def bend_path(
    motion: Motion, angle: float | int | None = None, radius: float | int | None = None, ramp: float | int = 0.0
) -> Motion:
    """Bend the straight line from a motion's beginning to its end into a curve: a walk becomes a walk in a circle.

    In the curve, the body leans inwards and the head looks ahead. Bones keep their lengths, and standing feet stay in
    place. Pass either `angle` or `radius`.

    Args:
        motion: Motion to edit.
        angle: Total angle by which the path turns, in radians, positive to the left.
        radius: Radius of the curve in metres, positive to the left.
        ramp: Fraction of the path, at either end, over which the curvature grows from zero and falls back to it.

    Raises:
        SettingError: Unless exactly one of `angle` and `radius` is given, and if the motion ends less than 5 cm from
            its beginning.

    Examples:
        >>> [motion] = stmc.load().generate("walk # 0 # 2", steps=1)
        >>> stmc.bend_path(motion, angle=1.57)
        Motion(40 frames at 20 fps, 2.00 s)
    """
    given = [value for value in (angle, radius) if value is not None]
    if len(given) != 1 or not math.isfinite(given[0]) or radius == 0 or not 0 <= ramp <= 0.5:
        raise SettingError(
            f"angle={angle}, radius={radius}, ramp={ramp}: pass a finite angle or a finite radius other than 0, "
            "and a ramp from 0 to 0.5"
        )
    body, skeleton = exact(motion)
    line = _Line.of(body)
    curvature = 1 / given[0] if radius is not None else given[0] / (line.length * (1 - ramp))
    curve = _Curve.of(curvature, line.length, ramp * line.length)
    bent = _move_ground(body, skeleton, lambda points: curve.bend(line, points))
    along = line.coordinates(body.translation[:, :2])[:, 0]
    speed = smooth(torch.gradient(along)[0] * body.fps, _SLOW * body.fps / 20) if body.frames > 1 else 0 * along
    turning = speed * torch.from_numpy(np.interp(along.numpy(), curve.positions, curve.curvature))
    turning = smooth(turning, _SLOW * body.fps / 20)
    return match_dtype(_lean(bent, skeleton, speed, turning, line.angle, curve, along), motion)


def change_pace(motion: Motion, tempo: float | int = 1.0, stride: float | int = 1.0) -> Motion:
    """Change the rate and the length of steps; the speed is multiplied by both factors.

    Slow walkers take fewer and shorter steps; a change of time alone looks like slow motion. Steps are measured along
    the straight line from the motion's beginning to its end. With shorter steps, the arms swing less about their mean,
    by the same factor. Bones keep their lengths.

    Args:
        motion: Motion to edit.
        tempo: Factor of the number of steps per second.
        stride: Factor of the length of steps.

    Raises:
        SettingError: If a factor is not above 0, or if `stride` is not 1 and the motion ends less than 5 cm from its
            beginning.

    Examples:
        >>> [motion] = stmc.load().generate("walk # 0 # 2", steps=1)
        >>> stmc.change_pace(motion, tempo=0.8, stride=0.7)
        Motion(50 frames at 20 fps, 2.50 s)
    """
    if not (0 < tempo < math.inf and 0 < stride < math.inf):
        raise SettingError(f"tempo={tempo}, stride={stride}: both must be above 0")
    body, skeleton = exact(motion)
    if stride != 1:
        body = _move_ground(body, skeleton, _Line.of(body).map(forward=stride, sideways=0.0))
    if stride < 1:
        body = _reduce_arm_swing(body, stride, skeleton)
    return match_dtype(body if tempo == 1 else _warp_time(body, tempo, skeleton), motion)


def reverse(motion: Motion) -> Motion:
    """Play a motion backwards: a walk forwards becomes a walk backwards.

    Examples:
        >>> [motion] = stmc.load().generate("walk # 0 # 1", steps=1)
        >>> torch.equal(stmc.reverse(motion).joints[0], motion.joints[-1])
        True
    """
    rotations, translation, joints = (value.flip(0) for value in (motion.rotations, motion.translation, motion.joints))
    return Motion(rotations, translation, joints, motion.fps, motion.overlap)


def shift_sideways(motion: Motion, distance: float | int, forward: float | int = 1.0) -> Motion:
    """Shear the path of a motion to the side, without turning the body: a jump forwards becomes a hop to the side.

    Bones keep their lengths, and standing feet stay in place.

    Args:
        motion: Motion to edit.
        distance: Metres by which the end moves to the left; negative: to the right.
        forward: Factor of the distance ahead.

    Raises:
        SettingError: If the motion ends less than 5 cm from its beginning, or if a number is not finite.

    Examples:
        >>> [motion] = stmc.load().generate("jump forward # 0 # 2", steps=1)
        >>> stmc.shift_sideways(motion, 0.5, forward=0.1)
        Motion(40 frames at 20 fps, 2.00 s)
    """
    if not (math.isfinite(distance) and math.isfinite(forward)):
        raise SettingError(f"distance={distance}, forward={forward}: both must be finite")
    body, skeleton = exact(motion)
    line = _Line.of(body)
    return match_dtype(_move_ground(body, skeleton, line.map(forward, distance / line.length)), motion)


@dataclass(frozen=True)
class _Line:
    """The straight line from the pelvis' first position to its last: start, direction and length."""

    start: Float[Tensor, " 2"]
    direction: Float[Tensor, " 2"]
    length: float

    @classmethod
    def of(cls, motion: Motion) -> _Line:
        first, last = motion.translation[0, :2], motion.translation[-1, :2]
        length = float((last - first).norm())
        if length < _SHORTEST:
            raise SettingError(
                f"the motion ends {length:.2f} m from its beginning; a path needs at least {_SHORTEST} m"
            )
        return cls(first, (last - first) / length, length)

    @property
    def axes(self) -> Float[Tensor, "2 2"]:
        """Unit vectors along the line and to its left, as rows."""
        x, y = self.direction
        return torch.stack([self.direction, torch.stack([-y, x])])

    @property
    def angle(self) -> float:
        """The angle of the line in the world, from the x axis, in radians."""
        return math.atan2(self.direction[1], self.direction[0])

    def coordinates(self, points: Float[Tensor, "*points 2"]) -> Float[Tensor, "*points 2"]:
        """Return coordinates in metres along the line and to its left."""
        return (points - self.start) @ self.axes.T

    def map(self, forward: float, sideways: float) -> Callable[[Tensor], Moved]:
        """Make a map that scales along the line by `forward` and shears to the left by `sideways` per metre."""
        change = self.axes.T @ torch.tensor([[forward, 0.0], [sideways, 1.0]], dtype=torch.float64) @ self.axes

        def move(points: Tensor) -> Moved:
            return self.start + (points - self.start) @ change.T, torch.zeros_like(points[..., 0])

        return move


@dataclass(frozen=True)
class _Curve:
    """The curve that replaces a straight line: at `positions` along the line (metres), its curvature (1/m), its
    direction relative to the line (radians), and its points."""

    positions: Float[np.ndarray, " positions"]
    curvature: Float[np.ndarray, " positions"]
    direction: Float[np.ndarray, " positions"]
    points: Float[np.ndarray, "positions 2"]

    @classmethod
    def of(cls, curvature: float, length: float, ramp: float) -> _Curve:
        """Make a curve of constant curvature; with a ramp, the curvature is zero before and after the line.

        Args:
            curvature: Curvature in 1/m, positive to the left.
            length: Length of the line in metres.
            ramp: Metres at either end over which the curvature grows from zero and falls back to it.
        """
        around = _BEYOND + abs(length)
        steps = math.ceil(around / _GRID)
        positions = np.arange(-steps, math.ceil((length + around) / _GRID) + 1) * _GRID
        weight = np.ones_like(positions)
        if ramp > 0:
            weight = np.clip(np.minimum(positions, length - positions) / ramp, 0, 1)
        direction = _integrate(curvature * weight, steps)
        points = np.stack([_integrate(np.cos(direction), steps), _integrate(np.sin(direction), steps)], axis=1)
        return cls(positions, curvature * weight, direction, points)

    def bend(self, line: _Line, points: Float[Tensor, "frames 3 2"]) -> Moved:
        """Move points of the ground from beside the line to beside the curve; also return the curve's directions."""
        along, left = line.coordinates(points).numpy().transpose(2, 0, 1)
        turn = np.interp(along, self.positions, self.direction)
        moved = np.stack([np.interp(along, self.positions, column) for column in self.points.T], axis=-1)
        moved = moved + left[..., None] * np.stack([-np.sin(turn), np.cos(turn)], axis=-1)
        return line.start + torch.from_numpy(moved) @ line.axes, torch.from_numpy(turn)


def _integrate(values: np.ndarray, zero: int) -> np.ndarray:
    total = np.concatenate([[0.0], np.cumsum((values[1:] + values[:-1]) / 2 * _GRID)])
    return total - total[zero]


def _move_ground(motion: Motion, skeleton: Skeleton, move: Callable[[Tensor], Moved]) -> Motion:
    """Move the ground of a motion; pelvis and ankles move with the ground below them."""
    world, ankles = global_rotations(motion.rotations, PARENTS), select_legs(motion.joints, "ankle")
    ground = torch.cat([motion.translation[:, None], ankles], dim=1)
    moved, turn = move(ground[..., :2])
    positions = torch.cat([moved, ground[..., 2:]], dim=-1)
    rotations = motion.rotations.clone()
    rotations[:, 0] = rotation_z(smooth(turn[:, 0], _TURN * motion.fps / 20)) @ rotations[:, 0]
    posed = Motion.posed(rotations, positions[:, 0], motion.fps, skeleton)
    return reach_with_legs(posed, positions[:, 1:], rotation_z(turn[:, 1:]) @ select_legs(world, "ankle"), skeleton)


def _lean(
    motion: Motion, skeleton: Skeleton, speed: Tensor, turning: Tensor, angle: float, curve: _Curve, along: Tensor
) -> Motion:
    """Lean the body into the curve about its tangent, with the feet in place, and turn the head ahead."""
    feet = select_legs(global_rotations(motion.rotations, PARENTS), "ankle")
    ankles = select_legs(motion.joints, "ankle")
    tangent = angle + torch.from_numpy(np.interp(along.numpy(), curve.positions, curve.direction))
    axis = torch.stack([tangent.cos(), tangent.sin(), torch.zeros_like(tangent)], dim=1)
    lean = _LEAN * torch.atan(speed * turning / _GRAVITY)
    rotations = motion.rotations.clone()
    rotations[:, 0] = axis_angle_to_matrix(-lean[:, None] * axis) @ rotations[:, 0]
    for name in ("neck", "head"):
        rotations = turn_joint(rotations, name, _AHEAD / 2 * turning)
    posed = Motion.posed(rotations, motion.translation, motion.fps, skeleton)
    return reach_with_legs(posed, ankles, feet, skeleton)


def _reduce_arm_swing(motion: Motion, factor: float, skeleton: Skeleton) -> Motion:
    """Scale the rotations of the arms about their mean over time."""
    import roma  # imported late: it takes as long to import as torch

    rotations = motion.rotations.clone()
    arms = rotations[:, _ARMS]
    mean = roma.special_procrustes(arms.mean(dim=0))
    rotations[:, _ARMS] = mean @ axis_angle_to_matrix(factor * matrix_to_axis_angle(mean.mT @ arms))
    return Motion.posed(rotations, motion.translation, motion.fps, skeleton)


def _warp_time(motion: Motion, tempo: float, skeleton: Skeleton) -> Motion:
    """Play a motion `tempo` times as fast, with cubic splines of positions and quaternions."""
    from scipy.interpolate import CubicSpline  # imported late: it is slow to import

    times = np.arange(motion.frames)
    sampled = np.arange(max(1, round(motion.frames / tempo))) * (
        (motion.frames - 1) / max(1, round(motion.frames / tempo) - 1)
    )
    if motion.frames < 2:
        return motion
    quaternions = matrix_to_quaternion(motion.rotations).numpy()
    flips = np.sign((quaternions[1:] * quaternions[:-1]).sum(axis=-1, keepdims=True))
    quaternions[1:] *= np.cumprod(np.where(flips == 0, 1, flips), axis=0)
    turns = torch.from_numpy(CubicSpline(times, quaternions)(sampled))
    rotations = quaternion_to_matrix(turns / turns.norm(dim=-1, keepdim=True))
    translation = torch.from_numpy(CubicSpline(times, motion.translation.numpy())(sampled))
    return Motion.posed(rotations, translation, motion.fps, skeleton)
