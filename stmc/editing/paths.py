"""Motions on another path, at another pace, in another direction: the ground is bent or stretched, the body follows.

Points of the ground have two coordinates, along the straight line from the pelvis' first place to its last and to the
left of it. An edit moves the points of the ground; pelvis and ankles move with the ground below them, each for itself,
and legs follow by inverse kinematics. So a foot that stands has one place after the edit as before, and slides no more.
Knows motions and legs; knows no text and no features.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from stmc.editing.leg_posing import exact, like, of_legs, reach_with_legs, smooth, turn_joint
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
"""Where the ground below the pelvis and both ankles goes, and by which angles (radians) it turns."""

_SHORTEST = 0.05
"""Metres between the ends of the shortest path."""
_GRID = 0.002
"""Metres between the places at which a curve is integrated."""
_BEYOND = 2.0
"""Metres before and behind the path up to which the ground is bent: feet go ahead of the pelvis."""
_GRAVITY = 9.81
_LEAN = 0.7
"""The share of the lean into a curve with which the weight would point along the body: people lean less."""
_AHEAD = 0.15
"""Seconds by which the head looks ahead in a curve."""
_ARMS = [JOINTS.index(f"{side}_{name}") for side in ("left", "right") for name in ("collar", "shoulder", "elbow")]
_TURN, _SLOW = 2.0, 6.0
"""Frames, at 20 a second, over which the pelvis' turn, and the lean, are averaged (Gaussian)."""


def bend_path(
    motion: Motion,
    angle: float | int | None = None,
    radius: float | int | None = None,
    ramp: float | int = 0.0,
) -> Motion:
    """The motion on a curve instead of the straight line from its beginning to its end: a walk becomes a walk in a
    circle.

    Either `angle`, by which the path turns in all (radians, positive to the left), or `radius` (metres, positive to
    the left). Where the path curves, the body leans inwards and the head looks ahead. For the share `ramp` of the path
    at either end, the curvature grows from zero and falls back to it. Bones keep their lengths, feet that stand stay.

    Raises `SettingError` unless one of the two is given, and for a motion that ends less than 5 cm from its beginning.

    Examples:
        >>> [motion] = stmc.load().generate("walk # 0 # 2", steps=1)
        >>> stmc.bend_path(motion, angle=1.57)
        Motion(40 frames at 20 fps, 2.00 s)
    """
    asked = [value for value in (angle, radius) if value is not None]
    if len(asked) != 1 or not math.isfinite(asked[0]) or radius == 0 or not 0 <= ramp <= 0.5:
        raise SettingError(
            f"angle={angle}, radius={radius}, ramp={ramp}: one of the first two, finite; ramp from 0 to 0.5"
        )
    body, skeleton = exact(motion)
    line = _Line.of(body)
    curvature = 1 / radius if radius is not None else angle / (line.length * (1 - ramp))
    curve = _Curve.of(curvature, line.length, ramp * line.length)
    bent = _on_ground(body, skeleton, lambda points: curve.bend(line, points))
    along = line.coordinates(body.translation[:, :2])[:, 0]
    speed = smooth(torch.gradient(along)[0] * body.fps, _SLOW * body.fps / 20) if body.frames > 1 else 0 * along
    turning = speed * torch.from_numpy(np.interp(along.numpy(), curve.places, curve.curvature))
    return like(
        _leaning(bent, skeleton, speed, smooth(turning, _SLOW * body.fps / 20), line.angle, curve, along), motion
    )


def change_pace(motion: Motion, tempo: float | int = 1.0, stride: float | int = 1.0) -> Motion:
    """The motion with `tempo` times as many steps a second, each `stride` times as long: its speed is multiplied by
    both.

    Slow walkers make fewer and shorter steps; a motion that is slowed in time alone looks like slow motion. Steps are
    those along the straight line from the motion's beginning to its end. With shorter steps, arms swing less: about
    their mean, by as much. Bones keep their lengths.

    Raises `SettingError` for numbers that are not above zero, and for a `stride` other than 1 of a motion that ends
    less than 5 cm from its beginning.

    Examples:
        >>> [motion] = stmc.load().generate("walk # 0 # 2", steps=1)
        >>> stmc.change_pace(motion, tempo=0.8, stride=0.7)
        Motion(50 frames at 20 fps, 2.50 s)
    """
    if not (0 < tempo < math.inf and 0 < stride < math.inf):
        raise SettingError(f"tempo={tempo}, stride={stride}: both must be above 0")
    body, skeleton = exact(motion)
    if stride != 1:
        body = _on_ground(body, skeleton, _Line.of(body).map(forward=stride, sideways=0.0))
    if stride < 1:
        body = _with_smaller_swing(body, stride, skeleton)
    return like(body if tempo == 1 else _retimed(body, tempo, skeleton), motion)


def reverse(motion: Motion) -> Motion:
    """The motion played backwards: from a walk forwards, a walk backwards.

    Examples:
        >>> [motion] = stmc.load().generate("walk # 0 # 1", steps=1)
        >>> torch.equal(stmc.reverse(motion).joints[0], motion.joints[-1])
        True
    """
    values = (motion.rotations, motion.translation, motion.joints)
    return Motion(*(value.flip(0) for value in values), motion.fps, motion.overlap)


def shift_sideways(motion: Motion, distance: float | int, forward: float | int = 1.0) -> Motion:
    """The motion with its path sheared: it ends `distance` metres farther to the left (negative: to the right), and
    goes `forward` times as far ahead. The body faces where it faced. From a jump forwards, a hop to the side.

    Bones keep their lengths, feet that stand stay. Raises `SettingError` for a motion that ends less than 5 cm from
    its beginning, and for numbers that are not finite.

    Examples:
        >>> [motion] = stmc.load().generate("jump forward # 0 # 2", steps=1)
        >>> stmc.shift_sideways(motion, 0.5, forward=0.1)
        Motion(40 frames at 20 fps, 2.00 s)
    """
    if not (math.isfinite(distance) and math.isfinite(forward)):
        raise SettingError(f"distance={distance}, forward={forward}: both must be finite")
    body, skeleton = exact(motion)
    line = _Line.of(body)
    return like(_on_ground(body, skeleton, line.map(forward, distance / line.length)), motion)


@dataclass(frozen=True)
class _Line:
    """The straight line from the pelvis' first place to its last: where it begins, its direction, its length."""

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
        """Rows: along the line, and to its left."""
        x, y = self.direction
        return torch.stack([self.direction, torch.stack([-y, x])])

    @property
    def angle(self) -> float:
        """Of the line in the world, from the x axis."""
        return math.atan2(self.direction[1], self.direction[0])

    def coordinates(self, points: Float[Tensor, "*points 2"]) -> Float[Tensor, "*points 2"]:
        """Metres along the line and to its left."""
        return (points - self.start) @ self.axes.T

    def map(self, forward: float, sideways: float) -> Callable[[Tensor], Moved]:
        """Along the line `forward` times as far, and to the left by `sideways` for each metre along it."""
        change = self.axes.T @ torch.tensor([[forward, 0.0], [sideways, 1.0]], dtype=torch.float64) @ self.axes

        def moved(points: Tensor) -> Moved:
            return self.start + (points - self.start) @ change.T, torch.zeros_like(points[..., 0])

        return moved


@dataclass(frozen=True)
class _Curve:
    """A curve that a straight line is bent to: at places along the line, its curvature (1/m), its direction relative
    to the line, and its points."""

    places: Float[np.ndarray, " places"]
    curvature: Float[np.ndarray, " places"]
    direction: Float[np.ndarray, " places"]
    points: Float[np.ndarray, "places 2"]

    @classmethod
    def of(cls, curvature: float, length: float, ramp: float) -> _Curve:
        """Constant curvature; with a ramp, none before the line and behind it."""
        around = _BEYOND + abs(length)
        steps = math.ceil(around / _GRID)
        places = np.arange(-steps, math.ceil((length + around) / _GRID) + 1) * _GRID
        share = np.ones_like(places)
        if ramp > 0:
            share = np.clip(np.minimum(places, length - places) / ramp, 0, 1)
        direction = _integral(curvature * share, steps)
        points = np.stack([_integral(np.cos(direction), steps), _integral(np.sin(direction), steps)], axis=1)
        return cls(places, curvature * share, direction, points)

    def bend(self, line: _Line, points: Float[Tensor, "frames 3 2"]) -> Moved:
        """Points of the ground beside the line → beside the curve, and the curve's directions there."""
        along, left = line.coordinates(points).numpy().transpose(2, 0, 1)
        turn = np.interp(along, self.places, self.direction)
        on = np.stack([np.interp(along, self.places, column) for column in self.points.T], axis=-1)
        on = on + left[..., None] * np.stack([-np.sin(turn), np.cos(turn)], axis=-1)
        return line.start + torch.from_numpy(on) @ line.axes, torch.from_numpy(turn)


def _integral(values: np.ndarray, zero: int) -> np.ndarray:
    total = np.concatenate([[0.0], np.cumsum((values[1:] + values[:-1]) / 2 * _GRID)])
    return total - total[zero]


def _on_ground(motion: Motion, skeleton: Skeleton, move: Callable[[Tensor], Moved]) -> Motion:
    """The motion after its ground was moved: pelvis and ankles go along with the ground below them."""
    world, ankles = global_rotations(motion.rotations, PARENTS), of_legs(motion.joints, "ankle")
    ground = torch.cat([motion.translation[:, None], ankles], dim=1)
    moved, turn = move(ground[..., :2])
    places = torch.cat([moved, ground[..., 2:]], dim=-1)
    rotations = motion.rotations.clone()
    rotations[:, 0] = rotation_z(smooth(turn[:, 0], _TURN * motion.fps / 20)) @ rotations[:, 0]
    posed = Motion.posed(rotations, places[:, 0], motion.fps, skeleton)
    return reach_with_legs(posed, places[:, 1:], rotation_z(turn[:, 1:]) @ of_legs(world, "ankle"), skeleton)


def _leaning(
    motion: Motion, skeleton: Skeleton, speed: Tensor, turning: Tensor, angle: float, curve: _Curve, along: Tensor
) -> Motion:
    """The body leant into the curve about its tangent, the feet where they are, and the head turned ahead."""
    feet, ankles = of_legs(global_rotations(motion.rotations, PARENTS), "ankle"), of_legs(motion.joints, "ankle")
    tangent = angle + torch.from_numpy(np.interp(along.numpy(), curve.places, curve.direction))
    axis = torch.stack([tangent.cos(), tangent.sin(), torch.zeros_like(tangent)], dim=1)
    lean = _LEAN * torch.atan(speed * turning / _GRAVITY)
    rotations = motion.rotations.clone()
    rotations[:, 0] = axis_angle_to_matrix(-lean[:, None] * axis) @ rotations[:, 0]
    for name in ("neck", "head"):
        rotations = turn_joint(rotations, name, _AHEAD / 2 * turning)
    posed = Motion.posed(rotations, motion.translation, motion.fps, skeleton)
    return reach_with_legs(posed, ankles, feet, skeleton)


def _with_smaller_swing(motion: Motion, share: float, skeleton: Skeleton) -> Motion:
    """The arms' rotations nearer to their mean over time."""
    import roma  # not above: it takes as long to import as torch

    rotations = motion.rotations.clone()
    arms = rotations[:, _ARMS]
    mean = roma.special_procrustes(arms.mean(dim=0))
    rotations[:, _ARMS] = mean @ axis_angle_to_matrix(share * matrix_to_axis_angle(mean.mT @ arms))
    return Motion.posed(rotations, motion.translation, motion.fps, skeleton)


def _retimed(motion: Motion, tempo: float, skeleton: Skeleton) -> Motion:
    """`tempo` times as fast, on cubic splines of positions and quaternions."""
    from scipy.interpolate import CubicSpline  # not above: it is slow to import

    times = np.arange(motion.frames)
    wanted = np.arange(max(1, round(motion.frames / tempo))) * (
        (motion.frames - 1) / max(1, round(motion.frames / tempo) - 1)
    )
    if motion.frames < 2:
        return motion
    quaternions = matrix_to_quaternion(motion.rotations).numpy()
    flips = np.sign((quaternions[1:] * quaternions[:-1]).sum(axis=-1, keepdims=True))
    quaternions[1:] *= np.cumprod(np.where(flips == 0, 1, flips), axis=0)
    turned = torch.from_numpy(CubicSpline(times, quaternions)(wanted))
    rotations = quaternion_to_matrix(turned / turned.norm(dim=-1, keepdim=True))
    places = torch.from_numpy(CubicSpline(times, motion.translation.numpy())(wanted))
    return Motion.posed(rotations, places, motion.fps, skeleton)
