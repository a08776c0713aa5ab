"""Where the body goes and where it looks: a path on the floor, a heading."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import torch
from jaxtyping import Float
from torch import Tensor

from stmc.editing.constraints.constraint import Constraint, Field, Order, span_fields
from stmc.editing.constraints.pose import RAMP, Place, Pose, bump, check_numbers, check_span
from stmc.motion.body import BodyPart
from stmc.motion.body_model import Skeleton
from stmc.motion.geometry import average_frames, wrap
from stmc.motion.motion import Motion
from stmc.settings.records import SettingError

SWAY = 0.02
"""Metres by which a pelvis may leave its path to either side: people who walk do."""

_LOOK = 0.15
"""Radians by which a heading may differ, and what one radian more counts in metres."""

_AHEAD = 0.3
"""Seconds over which the direction of a path is measured."""

_ROUNDS = 4
"""In which a finished motion is moved onto a path."""


@dataclass(frozen=True)
class Path(Constraint):
    """The pelvis goes along `points` (x and y on the floor, metres) from `start` to `end` seconds (None: to the end).

    On straight lines, at an even pace, or at the `times` of the points (seconds). The body looks `facing` radians to
    the left of where the path leads: 0 walks forwards, pi backwards; None leaves open where it looks. Motions begin
    above the origin and look along -y, unless a path starts at 0: then on its first point, looking as it says. Raises
    `SettingError` for less than two points, and times that do not rise.

    Examples:
        >>> path = stmc.Path([(0, 0), (0, -3), (2, -3)], end=5)
        >>> [motion] = stmc.load().generate("walk # 0 # 1", steps=1, constraints=[path])
        >>> motion.translation[0, :2].abs().max() < 0.1
        tensor(True)
    """

    points: Sequence[Sequence[float | int]]
    start: float | int = 0.0
    end: float | int | None = None
    facing: float | int | None = 0.0
    times: Sequence[float | int] | None = None
    name = "path"
    about = "The person walks along a line on the floor: draw it."
    tolerance = 0.05
    order = Order.PATH
    fields = (*span_fields(4.0), Field("points", "line", "Points: x, y; x, y; … (m)"))

    def __post_init__(self) -> None:
        check_span("path", self.start, self.end)
        points = tuple(check_numbers("point", point, 2) for point in self.points)
        object.__setattr__(self, "points", points)
        if len(points) < 2:
            raise SettingError(f"path of {len(points)} points: two at least")
        if self.times is not None:
            times = check_numbers("times", self.times, len(points))
            object.__setattr__(self, "times", times)
            if any(after <= before for before, after in pairwise(times)) or times[0] < 0:
                raise SettingError("times of a path: they must rise, from 0 on")
            object.__setattr__(self, "start", times[0])
            object.__setattr__(self, "end", times[-1])

    def places(self, pose: Pose) -> tuple[slice, Float[Tensor, "_ 2"], Float[Tensor, " _"]]:
        """The frames it is about; where the pelvis should be, and in which direction the path leads there.

        Examples:
            >>> [motion] = stmc.load().generate("walk # 0 # 1", steps=1)
            >>> pose = stmc.editing.constraints.Pose.of(motion)
            >>> span, where, direction = stmc.Path([(0, 0), (0, -1)], end=0.5).places(pose)
            >>> span, where.shape, direction.shape
            (slice(0, 10, None), torch.Size([10, 2]), torch.Size([10]))
        """
        span = self.frames(pose)
        last = pose.frames_of(0, self.end).stop if self.end is not None else len(pose.translation)
        whole = max(1, (int(self.end * pose.fps) if self.end is not None else last) - span.start - 1)
        points = torch.tensor(self.points, dtype=torch.float64)
        ways = torch.cat([torch.zeros(1, dtype=torch.float64), points.diff(dim=0).norm(dim=-1).cumsum(0)])
        knots = ways / ways[-1].clamp(min=1e-9) * whole
        if self.times is not None:
            knots = (torch.tensor(self.times, dtype=torch.float64) - self.start) * pose.fps
        frame = torch.arange(span.stop - span.start, dtype=torch.float64)
        few = _AHEAD * pose.fps
        ahead = _on(points, knots, frame + few) - _on(points, knots, frame - few)
        where = _on(points, knots, frame)
        return span, where.to(pose.translation), torch.atan2(ahead[:, 0], -ahead[:, 1]).to(pose.translation)

    def frames(self, pose: Pose) -> slice:
        """From the start to the end."""
        return pose.frames_of(self.start, self.end)

    def begin_place(self, place: Place) -> Place:
        """The first point of a path that starts at 0, looking as the path says."""
        if self.start != 0:
            return place
        (x, y), (then_x, then_y) = self.points[:2]
        return x, y, place[2], math.atan2(then_x - x, -(then_y - y)) + (self.facing or 0.0)

    def root_shift(self, pose: Pose) -> Float[Tensor, "frames 2"]:
        """Towards the path, by what the pelvis is off beyond its sway."""
        span, where, _ = self.places(pose)
        return _spread(_beyond(where - pose.translation[span, :2], SWAY), span, pose)

    def root_turn(self, pose: Pose) -> Float[Tensor, " frames"] | None:
        """Towards where the body should look beside the path."""
        if self.facing is None:
            return None
        span, _, direction = self.places(pose)
        return _spread(_too_far(direction + self.facing - pose.heading[span])[:, None], span, pose)[:, 0]

    def errors(self, pose: Pose) -> Float[Tensor, " _"]:
        """Metres on the floor from where the pelvis should be."""
        span, where, _ = self.places(pose)
        return (pose.translation[span, :2] - where).norm(dim=-1)

    def residuals(self, pose: Pose) -> Float[Tensor, " _"]:
        """Beyond what people sway, and beyond what they look aside."""
        span, where, direction = self.places(pose)
        away = _beyond(pose.translation[span, :2] - where, SWAY).flatten()
        if self.facing is None:
            return away
        return torch.cat([away, _aside(pose.heading[span] - direction - self.facing)])

    def project(self, motion: Motion, skeleton: Skeleton, free: Float[Tensor, "frames 5"]) -> Motion:
        """Move the pelvis by what it is off beyond its sway, smoothed and so in a few rounds; behind the span the
        motion goes on from where it is."""
        legs = free[:, list(BodyPart).index(BodyPart.LEGS), None]
        first = (free.min() >= 1).to(legs).reshape(1, 1)  # a kept motion begins where it does
        free_steps = torch.cat([first, legs[:-1]])
        for _ in range(_ROUNDS):
            over = self.root_shift(Pose.of(motion))
            way = (over.diff(dim=0, prepend=torch.zeros_like(over[:1])) * free_steps).cumsum(dim=0)
            moved = motion.translation + torch.nn.functional.pad(way, (0, 1))
            motion = Motion.posed(motion.rotations, moved, motion.fps, skeleton)
        return motion


@dataclass(frozen=True)
class Heading(Constraint):
    """The body looks `angle` radians to the left of -y (see `Motion.heading`) from `start` to `end` seconds (None: to
    the end).

    Examples:
        >>> constraint = stmc.Heading(1.57, start=0.5)
        >>> [motion] = stmc.load().generate("walk # 0 # 1", steps=1, constraints=[constraint])
    """

    angle: float | int
    start: float | int = 0.0
    end: float | int | None = None
    name = "heading"
    about = "The body looks in a direction."
    unit = "rad"
    tolerance = math.radians(10)
    order = Order.HEADING
    fields = (*span_fields(2.0), Field("angle", "angle", "Degrees to the left of the start", 0.0))

    def __post_init__(self) -> None:
        check_span("heading", self.start, self.end)
        check_numbers("angle", [self.angle], 1)

    def frames(self, pose: Pose) -> slice:
        """From the start to the end."""
        return pose.frames_of(self.start, self.end)

    def begin_place(self, place: Place) -> Place:
        """Looking as a heading demands that starts at 0."""
        return (*place[:3], float(self.angle)) if self.start == 0 else place

    def root_turn(self, pose: Pose) -> Float[Tensor, " frames"]:
        """Towards the angle."""
        span = self.frames(pose)
        return _spread(_too_far(self.angle - pose.heading[span])[:, None], span, pose)[:, 0]

    def errors(self, pose: Pose) -> Float[Tensor, " _"]:
        """Radians."""
        return wrap(pose.heading[self.frames(pose)] - self.angle).abs()

    def residuals(self, pose: Pose) -> Float[Tensor, " _"]:
        """Beyond what a body sways."""
        return _aside(pose.heading[self.frames(pose)] - self.angle)


def _on(points: Tensor, knots: Tensor, frames: Tensor) -> Float[Tensor, "_ 2"]:
    """Where the straight lines through `points`, reached at the frames `knots`, are; they go on behind both ends."""
    piece = (torch.searchsorted(knots, frames, right=True) - 1).clamp(0, len(knots) - 2)
    share = (frames - knots[piece]) / (knots[piece + 1] - knots[piece]).clamp(min=1e-9)
    return points[piece] + share[:, None] * (points[piece + 1] - points[piece])


def _beyond(vectors: Float[Tensor, "_ width"], slack: float) -> Float[Tensor, "_ width"]:
    length = vectors.norm(dim=-1, keepdim=True).clamp(min=1e-9)
    return vectors * (1 - slack / length).clamp(min=0)


def _aside(angles: Float[Tensor, " _"]) -> Float[Tensor, " _"]:
    """Radians too many, as metres."""
    return _LOOK * _too_far(angles)


def _too_far(angles: Float[Tensor, " _"]) -> Float[Tensor, " _"]:
    """Radians beyond what a body looks aside."""
    angles = wrap(angles)
    return angles - angles.clamp(-_LOOK, _LOOK)


def _spread(off: Float[Tensor, "_ width"], span: slice, pose: Pose) -> Float[Tensor, "frames width"]:
    """What a span is off, smoothed, for all frames: it comes within `RAMP` before the span, and stays."""
    frames, ramp = len(pose.translation), round(RAMP * pose.fps)
    if not len(off):
        return off.new_zeros(frames, off.shape[1])
    behind, reach = frames - span.start - len(off), ramp // 2
    before, after = off[:1].expand(reach + span.start, -1), off[-1:].expand(behind + reach, -1)
    whole = average_frames(torch.cat([before, off, after]), reach)
    return bump(frames, slice(span.start, frames), ramp, off)[:, None] * whole
