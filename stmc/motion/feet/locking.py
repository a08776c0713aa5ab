"""Foot locking: move and rotate a foot so that its standing heel and toes stay still and above the floor.

Depends on the points of one foot and their contacts; the legs follow in `leg_bending`.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import normalize

from stmc.motion.feet.contacts import runs, standing_frames
from stmc.motion.geometry import axis_angle_to_matrix, matrix_to_axis_angle, shortest_arc

_BLEND = 0.25
"""Seconds over which a correction blends in before a contact and out after it."""
_CALM = 0.1
"""Speed in m/s at which a step has half the weight of a still one."""
_FIXED = 1e6
"""Weight of a frame in which the foot must not move."""


@dataclass(frozen=True)
class Foot:
    """A foot over time: its ankle, its world rotation, and its heel and toes in the foot's own frame."""

    ankle: Float[Tensor, "frames 3"]
    turned: Float[Tensor, "frames 3 3"]
    heel: Float[Tensor, " 3"]
    toes: Float[Tensor, " 3"]

    @property
    def points(self) -> Float[Tensor, "frames 2 3"]:
        """Heel and toes in the world."""
        return self.ankle[:, None] + torch.stack([self.turned @ self.heel, self.turned @ self.toes], dim=1)

    def moved(self, way: Float[Tensor, "frames 3"]) -> Foot:
        """Translate the foot."""
        return Foot(self.ankle + way, self.turned, self.heel, self.toes)

    def rotated(self, by: Float[Tensor, "frames 3 3"], about: Float[Tensor, "frames 3"]) -> Foot:
        """Rotate the foot in the world `about` a point."""
        ankle = about + (by @ (self.ankle - about)[..., None])[..., 0]
        return Foot(ankle, by @ self.turned, self.heel, self.toes)


def lock_foot(
    foot: Foot, held: Bool[Tensor, "_ 2"], fixed: Bool[Tensor, " frames"], fps: float | int, floor: float | int
) -> Foot:
    """Lock a foot: its heel and toes do not move in held steps and do not go below the floor.

    The foot stays at its average position over each stance (consecutive steps in which heel or toes stand). Far from
    all stances it changes only if it is below the floor. Fixed frames, and stances that contain one, keep the foot in
    place.

    Args:
        foot: The foot.
        held: True at the steps in which heel and toes stand, [steps, 2].
        fixed: True at the frames that must not change, [frames].
        fps: Frames per second.
        floor: Height of the floor in metres.
    """
    floors = floor - _allowed_depth(foot, fixed, fps, floor)
    level = foot.rotated(axis_angle_to_matrix(_level(foot, held, fixed, fps)), foot.ankle)
    return _lift_above(level.moved(_hold(level, held, fixed, fps, floors)), floors)


def distance_weight(fixed: Bool[Tensor, " frames"], span: float | int) -> Float[Tensor, " frames"]:
    """Return a weight that is 0 in `fixed` frames and rises smoothly to 1 at a distance of `span` frames."""
    weight = (_distance(fixed) / max(1, span)).clamp(max=1)
    return weight**2 * (3 - 2 * weight)


def _distance(fixed: Bool[Tensor, " frames"]) -> Float[Tensor, " frames"]:
    """Count the frames to the nearest `fixed` frame."""
    frames = torch.arange(len(fixed), dtype=torch.float64)
    distances = [(frames - edge).abs() for start, end in runs(fixed) for edge in (start, end - 1)]
    return (
        torch.where(fixed, 0.0, torch.stack(distances).amin(dim=0)) if distances else torch.full_like(frames, torch.inf)
    )


def _allowed_depth(
    foot: Foot, fixed: Bool[Tensor, " frames"], fps: float | int, floor: float | int
) -> Float[Tensor, " frames"]:
    """Return the allowed depth below the floor, which follows from the nearest `fixed` frames."""
    deep = (floor - foot.points[..., 2].amin(dim=1)).clamp(min=0)
    allowed, frames = torch.where(fixed, deep, 0.0), torch.arange(len(fixed))
    for start, end in runs(fixed):
        for edge in (start, end - 1):
            weight = (1 - (frames - edge).abs() / (_BLEND * fps)).clamp(min=0)
            allowed = torch.maximum(allowed, torch.where(fixed, 0.0, deep[edge] * weight))
    return allowed


def _stances(steps: Bool[Tensor, " _"], fixed: Bool[Tensor, " frames"]) -> list[tuple[int, int]]:
    """Return the first and last frame of each run of `steps` or `fixed` frames, merged if they share a frame."""
    stances = runs(steps | (fixed[1:] & fixed[:-1]))
    inside = torch.zeros_like(fixed)
    for start, end in stances:
        inside[start : end + 1] = True
    return sorted(stances + [(frame, frame) for frame in (fixed & ~inside).nonzero()[:, 0].tolist()])


def _interpolate(values: Float[Tensor, "_ 3"], fixed: Bool[Tensor, " _"]) -> Float[Tensor, "_ 3"]:
    """Interpolate linearly between the values of the `fixed` frames."""
    frames, knots = np.arange(len(values)), fixed.nonzero()[:, 0].numpy()
    columns = [np.interp(frames, knots, column[fixed].numpy()) for column in values.T]
    return torch.from_numpy(np.stack(columns, axis=1))


def _level(
    foot: Foot, held: Bool[Tensor, "_ 2"], fixed: Bool[Tensor, " frames"], fps: float | int
) -> Float[Tensor, "frames 3"]:
    """Return rotation vectors that hold the direction of the foot while both its ends stand."""
    along = normalize(foot.points[:, 1] - foot.points[:, 0], dim=-1)
    turns, spans = torch.zeros_like(along), _stances(held.all(dim=1), fixed)
    for start, end in spans:
        directions, anchored = along[start : end + 1], fixed[start : end + 1]
        targets = _interpolate(directions, anchored) if anchored.any() else directions.mean(dim=0).expand_as(directions)
        turns[start : end + 1] = matrix_to_axis_angle(shortest_arc(directions, normalize(targets, dim=-1)))
    turns[fixed] = 0.0
    return blend_spans(turns, spans, fps)


def _hold(
    foot: Foot,
    held: Bool[Tensor, "_ 2"],
    fixed: Bool[Tensor, " frames"],
    fps: float | int,
    floors: Float[Tensor, " frames"],
) -> Float[Tensor, "frames 3"]:
    """Compute the translation of the foot per frame that keeps standing points still.

    It sums the steps to cancel. `_place_stances` chooses the position of each stance as a whole, except for lifts to
    the floor and fixed frames.
    """
    points, spans = foot.points, _stances(held.any(dim=1), fixed)
    steps = torch.where(held[:, 1:], points[:, 1].diff(dim=0), points[:, 0].diff(dim=0)) * held.any(dim=1)[:, None]
    calm = _CALM**2 / ((steps.norm(dim=-1) * fps) ** 2 + _CALM**2)
    summed = [torch.cat([steps.new_zeros(1, 3), -steps[start:end].cumsum(dim=0)]) for start, end in spans]
    calm = torch.nn.functional.pad(calm, (1, 1))
    weights = [calm[[min(start + 1, end), *range(start + 1, end + 1)], None] for start, end in spans]
    weights = [
        torch.where(fixed[start : end + 1, None], _FIXED, weight)
        for (start, end), weight in zip(spans, weights, strict=True)
    ]
    depths = torch.where(standing_frames(held), floors[:, None] - points[..., 2], -torch.inf).amax(dim=1)
    shifts = torch.zeros_like(foot.ankle)
    for (start, end), shift in zip(spans, _place_stances(summed, weights, spans, _BLEND * fps), strict=True):
        anchored = fixed[start : end + 1]
        if anchored.any():
            shift = shift - _interpolate(shift, anchored)
        else:
            lift = (depths[start : end + 1] - shift[:, 2]).amax().clamp(min=0)
            shift = shift + lift * shift.new_tensor([0.0, 0.0, 1.0])
        shifts[start : end + 1] = shift
    return blend_spans(shifts, spans, fps)


def _place_stances(
    paths: list[Float[Tensor, "_ 3"]], weights: list[Float[Tensor, "_ 1"]], spans: list[tuple[int, int]], span: float
) -> list[Float[Tensor, "_ 3"]]:
    """Add a constant to each element of `paths` that minimises a weighted sum of squares.

    The sum includes the squared jumps between neighbours, with more weight for shorter gaps.
    """
    if not paths:
        return []
    bands = np.zeros((3, len(paths)))
    bands[1] = [float(weight.sum()) for weight in weights]
    right = np.stack([-(path * weight).sum(dim=0).numpy() for path, weight in zip(paths, weights, strict=True)])
    for index, (before, after) in enumerate(pairwise(spans)):
        gap = after[0] - before[1]
        tie = span**2 / gap * (gap < 2 * span)
        jump = tie * (paths[index + 1][0] - paths[index][-1]).numpy()
        bands[1, index : index + 2] += tie
        bands[0, index + 1] = bands[2, index] = -tie
        right[index : index + 2] += [jump, -jump]
    from scipy.linalg import solve_banded  # imported late: it is slow to import

    constants = torch.from_numpy(solve_banded((1, 1), bands, right))
    return [path + constant for path, constant in zip(paths, constants, strict=True)]


def _lift_above(foot: Foot, floors: Float[Tensor, " frames"]) -> Foot:
    """Lift the foot until its higher end is above the floor, then rotate it about that end until the other end is."""
    lift = torch.zeros_like(foot.ankle)
    lift[:, 2] = (floors - foot.points[..., 2].amax(dim=1)).clamp(min=0)
    foot = foot.moved(lift)
    heel, toes = foot.points.unbind(dim=1)
    lower = (heel[:, 2:] < toes[:, 2:]).to(heel)
    about = torch.lerp(heel, toes, lower)
    along = torch.lerp(toes, heel, lower) - about
    length = along.norm(dim=-1)
    down = torch.maximum(along[:, 2], floors - about[:, 2])
    flat = normalize(along[:, :2] + 1e-9, dim=-1) * (length**2 - down**2).clamp(min=0).sqrt()[:, None]
    target = torch.cat([flat, down[:, None]], dim=1)
    turn = shortest_arc(along / length[:, None], target / length[:, None])
    identity = torch.eye(3, dtype=turn.dtype, device=turn.device)
    return foot.rotated(torch.where((down > along[:, 2])[:, None, None], turn, identity), about)


def blend_spans(
    values: Float[Tensor, "frames 3"], spans: list[tuple[int, int]], fps: float | int
) -> Float[Tensor, "frames 3"]:
    """Blend `values`, defined in the frames [start, end] of `spans`, smoothly to zero before and after."""
    # the correction does not continue its slope: it would pull down a foot that is about to leave, and drag it
    blended, frames = values.clone(), torch.arange(len(values))
    bounds = [-len(values), *(edge for span in spans for edge in span), 2 * len(values)]
    for index in range(1, len(bounds) - 1):
        edge, outwards = bounds[index], 1 if index % 2 == 0 else -1
        room = abs(bounds[index + outwards] - edge)
        away = (frames - edge) * outwards
        inside = (away > 0) & (away < room)
        weight = (away[inside, None].to(values) / min(_BLEND * fps, room)).clamp(max=1)
        blended[inside] += values[edge] * (1 - weight**2 * (3 - 2 * weight))
    return blended
