"""Constraints on the root: a path on the floor, and a heading."""

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
"""Metres by which the pelvis may leave its path to either side, as it does in walking."""
_LOOK = 0.15
"""Radians by which a heading may differ; also the cost in metres of each further radian."""
_AHEAD = 0.3
"""Seconds over which the direction of a path is measured."""
_ROUNDS = 4
"""Rounds in which a finished motion is moved onto a path."""


@dataclass(frozen=True)
class Path(Constraint):
    """The pelvis goes along `points` (x and y on the floor, metres) from `start` to `end` seconds (None: to the end).

    It moves in straight lines, at a constant pace or at the `times` of the points (seconds). The body looks `facing`
    radians to the left of the path's direction: 0 walks forwards, pi backwards; None leaves the heading free. A motion
    begins above the origin and looks along -y, unless a path starts at 0: it then begins at the first point, with the
    heading of the path. Raises `SettingError` for fewer than two points, and for times that do not increase.

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
            raise SettingError(f"path of {len(points)} points: needs at least two")
        if self.times is not None:
            times = check_numbers("times", self.times, len(points))
            object.__setattr__(self, "times", times)
            if any(after <= before for before, after in pairwise(times)) or times[0] < 0:
                raise SettingError("times of a path: must increase, from 0 on")
            object.__setattr__(self, "start", times[0])
            object.__setattr__(self, "end", times[-1])

    def places(self, pose: Pose) -> tuple[slice, Float[Tensor, "_ 2"], Float[Tensor, " _"]]:
        """Return the constrained frames, the target positions of the pelvis, and the directions of the path there.

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
        lengths = torch.cat([torch.zeros(1, dtype=torch.float64), points.diff(dim=0).norm(dim=-1).cumsum(0)])
        knots = lengths / lengths[-1].clamp(min=1e-9) * whole
        if self.times is not None:
            knots = (torch.tensor(self.times, dtype=torch.float64) - self.start) * pose.fps
        frame = torch.arange(span.stop - span.start, dtype=torch.float64)
        step = _AHEAD * pose.fps
        ahead = _interpolate(points, knots, frame + step) - _interpolate(points, knots, frame - step)
        where = _interpolate(points, knots, frame)
        return span, where.to(pose.translation), torch.atan2(ahead[:, 0], -ahead[:, 1]).to(pose.translation)

    def frames(self, pose: Pose) -> slice:
        """Return the frames from the start to the end."""
        return pose.frames_of(self.start, self.end)

    def begin_place(self, place: Place) -> Place:
        """Return the first point of a path that starts at 0, with the heading of the path."""
        if self.start != 0:
            return place
        (x, y), (then_x, then_y) = self.points[:2]
        return x, y, place[2], math.atan2(then_x - x, -(then_y - y)) + (self.facing or 0.0)

    def root_shift(self, pose: Pose) -> Float[Tensor, "frames 2"]:
        """Compute the shift towards the path, less the sway of the pelvis."""
        span, where, _ = self.places(pose)
        return _spread(_shrink(where - pose.translation[span, :2], SWAY), span, pose)

    def root_turn(self, pose: Pose) -> Float[Tensor, " frames"] | None:
        """Compute the turn towards the heading of the path."""
        if self.facing is None:
            return None
        span, _, direction = self.places(pose)
        return _spread(_excess(direction + self.facing - pose.heading[span])[:, None], span, pose)[:, 0]

    def errors(self, pose: Pose) -> Float[Tensor, " _"]:
        """Compute distances on the floor between the pelvis and the path, in metres."""
        span, where, _ = self.places(pose)
        return (pose.translation[span, :2] - where).norm(dim=-1)

    def residuals(self, pose: Pose) -> Float[Tensor, " _"]:
        """Compute offsets from the path less the sway, and heading errors less the tolerated deviation."""
        span, where, direction = self.places(pose)
        offsets = _shrink(pose.translation[span, :2] - where, SWAY).flatten()
        if self.facing is None:
            return offsets
        return torch.cat([offsets, _heading_residuals(pose.heading[span] - direction - self.facing)])

    def project(self, motion: Motion, skeleton: Skeleton, free: Float[Tensor, "frames 5"]) -> Motion:
        """Move the pelvis onto the path, up to its sway, in a few smoothed rounds.

        After the span, the motion continues from its new position.
        """
        legs = free[:, list(BodyPart).index(BodyPart.LEGS), None]
        first = (free.min() >= 1).to(legs).reshape(1, 1)  # the start of a kept motion stays
        free_steps = torch.cat([first, legs[:-1]])
        for _ in range(_ROUNDS):
            shift = self.root_shift(Pose.of(motion))
            shift = (shift.diff(dim=0, prepend=torch.zeros_like(shift[:1])) * free_steps).cumsum(dim=0)
            translation = motion.translation + torch.nn.functional.pad(shift, (0, 1))
            motion = Motion.posed(motion.rotations, translation, motion.fps, skeleton)
        return motion


@dataclass(frozen=True)
class Heading(Constraint):
    """The body looks `angle` radians to the left of -y from `start` to `end` seconds (None: to the end).

    See `Motion.heading`.

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
        """Return the frames from the start to the end."""
        return pose.frames_of(self.start, self.end)

    def begin_place(self, place: Place) -> Place:
        """Return the place with the angle of a heading that starts at 0."""
        return (*place[:3], float(self.angle)) if self.start == 0 else place

    def root_turn(self, pose: Pose) -> Float[Tensor, " frames"]:
        """Compute the turn towards the angle."""
        span = self.frames(pose)
        return _spread(_excess(self.angle - pose.heading[span])[:, None], span, pose)[:, 0]

    def errors(self, pose: Pose) -> Float[Tensor, " _"]:
        """Compute absolute heading errors in radians."""
        return wrap(pose.heading[self.frames(pose)] - self.angle).abs()

    def residuals(self, pose: Pose) -> Float[Tensor, " _"]:
        """Compute heading errors less the tolerated deviation, as metres."""
        return _heading_residuals(pose.heading[self.frames(pose)] - self.angle)


def _interpolate(points: Tensor, knots: Tensor, frames: Tensor) -> Float[Tensor, "_ 2"]:
    """Interpolate linearly between `points`, reached at the frames `knots`; extrapolate beyond both ends."""
    segment = (torch.searchsorted(knots, frames, right=True) - 1).clamp(0, len(knots) - 2)
    fraction = (frames - knots[segment]) / (knots[segment + 1] - knots[segment]).clamp(min=1e-9)
    return points[segment] + fraction[:, None] * (points[segment + 1] - points[segment])


def _shrink(vectors: Float[Tensor, "_ width"], slack: float) -> Float[Tensor, "_ width"]:
    """Shorten vectors by `slack`, to zero at most."""
    length = vectors.norm(dim=-1, keepdim=True).clamp(min=1e-9)
    return vectors * (1 - slack / length).clamp(min=0)


def _heading_residuals(angles: Float[Tensor, " _"]) -> Float[Tensor, " _"]:
    """Convert heading errors beyond the tolerated deviation to metres."""
    return _LOOK * _excess(angles)


def _excess(angles: Float[Tensor, " _"]) -> Float[Tensor, " _"]:
    """Return the part of heading errors beyond the tolerated deviation, in radians."""
    angles = wrap(angles)
    return angles - angles.clamp(-_LOOK, _LOOK)


def _spread(correction: Float[Tensor, "_ width"], span: slice, pose: Pose) -> Float[Tensor, "frames width"]:
    """Smooth a span's correction and extend it to all frames: it fades in over `RAMP` before the span, and stays."""
    frames, ramp = len(pose.translation), round(RAMP * pose.fps)
    if not len(correction):
        return correction.new_zeros(frames, correction.shape[1])
    rest, radius = frames - span.start - len(correction), ramp // 2
    before, after = correction[:1].expand(radius + span.start, -1), correction[-1:].expand(rest + radius, -1)
    smooth = average_frames(torch.cat([before, correction, after]), radius)
    return bump(frames, slice(span.start, frames), ramp, correction)[:, None] * smooth
