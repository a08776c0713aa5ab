"""Where a foot should be: moved and turned so that its heel and toes stay while they stand, and stay above the floor.

Knows the points of one foot and when they are held; knows no legs, which follow (see `legs`).
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
"""Seconds over which a correction comes before a contact and goes after it."""
_CALM = 0.1
"""Metres a second of a step that counts half as much as one that stands still."""
_FIXED = 1e6
"""What a frame counts in which the foot may not be moved."""


@dataclass(frozen=True)
class Foot:
    """A foot over time: its ankle, how it is turned in the world, and its heel and toes in the foot's own frame."""

    ankle: Float[Tensor, "frames 3"]
    turned: Float[Tensor, "frames 3 3"]
    heel: Float[Tensor, " 3"]
    toes: Float[Tensor, " 3"]

    @property
    def points(self) -> Float[Tensor, "frames 2 3"]:
        """Heel and toes in the world."""
        return self.ankle[:, None] + torch.stack([self.turned @ self.heel, self.turned @ self.toes], dim=1)

    def moved(self, way: Float[Tensor, "frames 3"]) -> Foot:
        """Elsewhere, turned as it is."""
        return Foot(self.ankle + way, self.turned, self.heel, self.toes)

    def rotated(self, by: Float[Tensor, "frames 3 3"], about: Float[Tensor, "frames 3"]) -> Foot:
        """Turned in the world `about` a point."""
        ankle = about + (by @ (self.ankle - about)[..., None])[..., 0]
        return Foot(ankle, by @ self.turned, self.heel, self.toes)


def locked(
    foot: Foot, held: Bool[Tensor, "_ 2"], fixed: Bool[Tensor, " frames"], fps: float | int, floor: float | int
) -> Foot:
    """The foot whose heel and toes do not move in steps that are `held`, nor go below the `floor`.

    It stays where it is on average over each stance (the steps in which heel or toes stand, one after the other), and
    far from all stances, where it is above the floor, is not touched at all. In frames that are `fixed` it is as it
    was, and so are the stances that have one.
    """
    floors = floor - _sunk(foot, fixed, fps, floor)
    level = foot.rotated(axis_angle_to_matrix(_levelling(foot, held, fixed, fps)), foot.ankle)
    return _above(level.moved(_staying(level, held, fixed, fps, floors)), floors)


def away(fixed: Bool[Tensor, " frames"], span: float | int) -> Float[Tensor, " frames"]:
    """0 in frames that are `fixed`, smoothly 1 from `span` frames away on."""
    share = (_distance(fixed) / max(1, span)).clamp(max=1)
    return share**2 * (3 - 2 * share)


def _distance(fixed: Bool[Tensor, " frames"]) -> Float[Tensor, " frames"]:
    """Frames to the next one that is `fixed`."""
    frames = torch.arange(len(fixed), dtype=torch.float64)
    found = [(frames - edge).abs() for start, end in runs(fixed) for edge in (start, end - 1)]
    return torch.where(fixed, 0.0, torch.stack(found).amin(dim=0)) if found else torch.full_like(frames, torch.inf)


def _sunk(foot: Foot, fixed: Bool[Tensor, " frames"], fps: float | int, floor: float | int) -> Float[Tensor, " frames"]:
    """How deep below the floor it may be, since it is in the nearest `fixed` frames."""
    deep = (floor - foot.points[..., 2].amin(dim=1)).clamp(min=0)
    allowed, frames = torch.where(fixed, deep, 0.0), torch.arange(len(fixed))
    for start, end in runs(fixed):
        for edge in (start, end - 1):
            share = (1 - (frames - edge).abs() / (_BLEND * fps)).clamp(min=0)
            allowed = torch.maximum(allowed, torch.where(fixed, 0.0, deep[edge] * share))
    return allowed


def _stances(steps: Bool[Tensor, " _"], fixed: Bool[Tensor, " frames"]) -> list[tuple[int, int]]:
    """The first and the last frame of each run of `steps`, and of what is `fixed`, joined where they share a frame."""
    found = runs(steps | (fixed[1:] & fixed[:-1]))
    inside = torch.zeros_like(fixed)
    for start, end in found:
        inside[start : end + 1] = True
    return sorted(found + [(frame, frame) for frame in (fixed & ~inside).nonzero()[:, 0].tolist()])


def _between(values: Float[Tensor, "_ 3"], fixed: Bool[Tensor, " _"]) -> Float[Tensor, "_ 3"]:
    """Those of the `fixed` frames, on straight lines between them."""
    frames, known = np.arange(len(values)), fixed.nonzero()[:, 0].numpy()
    columns = [np.interp(frames, known, column[fixed].numpy()) for column in values.T]
    return torch.from_numpy(np.stack(columns, axis=1))


def _levelling(
    foot: Foot, held: Bool[Tensor, "_ 2"], fixed: Bool[Tensor, " frames"], fps: float | int
) -> Float[Tensor, "frames 3"]:
    """Rotation vectors that keep the foot's direction while both its ends stand."""
    along = normalize(foot.points[:, 1] - foot.points[:, 0], dim=-1)
    turns, spans = torch.zeros_like(along), _stances(held.all(dim=1), fixed)
    for start, end in spans:
        own, known = along[start : end + 1], fixed[start : end + 1]
        wanted = _between(own, known) if known.any() else own.mean(dim=0).expand_as(own)
        turns[start : end + 1] = matrix_to_axis_angle(shortest_arc(own, normalize(wanted, dim=-1)))
    turns[fixed] = 0.0
    return blended(turns, spans, fps)


def _staying(
    foot: Foot,
    held: Bool[Tensor, "_ 2"],
    fixed: Bool[Tensor, " frames"],
    fps: float | int,
    floors: Float[Tensor, " frames"],
) -> Float[Tensor, "frames 3"]:
    """How far to move the foot in each frame so that what stands stays: the sum of the steps that it should not make.

    Where each stance is as a whole is `_placed`'s matter, but for what lifts it to the floor, and what is fixed.
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
    ways = torch.zeros_like(foot.ankle)
    for (start, end), way in zip(spans, _placed(summed, weights, spans, _BLEND * fps), strict=True):
        known = fixed[start : end + 1]
        if known.any():
            way = way - _between(way, known)
        else:
            lift = (depths[start : end + 1] - way[:, 2]).amax().clamp(min=0)
            way = way + lift * way.new_tensor([0.0, 0.0, 1.0])
        ways[start : end + 1] = way
    return blended(ways, spans, fps)


def _placed(
    ways: list[Float[Tensor, "_ 3"]], weights: list[Float[Tensor, "_ 1"]], spans: list[tuple[int, int]], span: float
) -> list[Float[Tensor, "_ 3"]]:
    """`ways`, each with a constant added: those with the least weighted sum of squares, to which the jumps between
    neighbours add theirs, the more the shorter the time between the two."""
    if not ways:
        return []
    bands = np.zeros((3, len(ways)))
    bands[1] = [float(weight.sum()) for weight in weights]
    right = np.stack([-(way * weight).sum(dim=0).numpy() for way, weight in zip(ways, weights, strict=True)])
    for index, (before, after) in enumerate(pairwise(spans)):
        gap = after[0] - before[1]
        tie = span**2 / gap * (gap < 2 * span)
        jump = tie * (ways[index + 1][0] - ways[index][-1]).numpy()
        bands[1, index : index + 2] += tie
        bands[0, index + 1] = bands[2, index] = -tie
        right[index : index + 2] += [jump, -jump]
    from scipy.linalg import solve_banded  # not above: it is slow to import

    constants = torch.from_numpy(solve_banded((1, 1), bands, right))
    return [way + constant for way, constant in zip(ways, constants, strict=True)]


def _above(foot: Foot, floors: Float[Tensor, " frames"]) -> Foot:
    """Lifted until its higher end is not below the floor, then turned about that end until the other is not."""
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
    wanted = torch.cat([flat, down[:, None]], dim=1)
    turn = shortest_arc(along / length[:, None], wanted / length[:, None])
    same = torch.eye(3, dtype=turn.dtype, device=turn.device)
    return foot.rotated(torch.where((down > along[:, 2])[:, None, None], turn, same), about)


def blended(
    values: Float[Tensor, "frames 3"], spans: list[tuple[int, int]], fps: float | int
) -> Float[Tensor, "frames 3"]:
    """`values`, given in the frames [start, end] of `spans`, going smoothly to zero in the frames before and after."""
    # they do not go on as they went first: a foot that is about to leave would be drawn down again, and drag
    blended, frames = values.clone(), torch.arange(len(values))
    bounds = [-len(values), *(edge for span in spans for edge in span), 2 * len(values)]
    for index in range(1, len(bounds) - 1):
        edge, outwards = bounds[index], 1 if index % 2 == 0 else -1
        room = abs(bounds[index + outwards] - edge)
        away = (frames - edge) * outwards
        there = (away > 0) & (away < room)
        share = (away[there, None].to(values) / min(_BLEND * fps, room)).clamp(max=1)
        blended[there] += values[edge] * (1 - share**2 * (3 - 2 * share))
    return blended
