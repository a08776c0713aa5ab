"""When heels and toes stand on the floor: low and slow, for a while; or low and gliding, where nothing else carries.

Knows points, steps and how high a pelvis is; knows no legs. A contact is a run of *steps*, from one frame to the next,
in which the point should not move, so two contacts may follow each other without a frame between.
"""

from __future__ import annotations

from itertools import pairwise, product

import torch
from jaxtyping import Bool, Float
from torch import Tensor

_SPEED, _HEIGHT = 0.4, 0.1
"""Metres a second on the floor, and metres above it when at rest, at which a point certainly does not stand; between
the two, what counts is the sum of both as shares of these."""
_GLIDE = 0.9
"""Metres a second on the floor at which a foot that alone can carry certainly swings: feet that swing go 2 to 4."""
_SURE = 0.6
"""The share that some step of a contact stays below."""
_SHORTEST = 0.1
"""Seconds of the shortest contact: the feet of runners stand for 0.15 s."""
_RISE = 0.01
"""Metres by which a point has come up from the lowest of its contact when it begins or ends."""
_GAP, _SHUFFLE = 0.15, 0.08
"""Seconds, and metres, between two contacts that are one: nobody makes a step so short."""
_FARTHEST = 0.5
"""Metres that a foot glides at most in one contact: what goes farther is left to go."""
_FALL, _FALLING = 5.9, 0.05
"""Metres per second² with which a pelvis falls that nothing carries, 0.6 of gravity's; seconds to both sides of the
frame over which that is measured."""


def standing_steps(
    feet: Float[Tensor, "frames feet 2 3"], pelvis: Float[Tensor, " frames"], fps: float | int, floor: float | int
) -> Bool[Tensor, "_ feet 2"]:
    """When the heels and toes of two feet stand: `held_steps`, and where a foot glides that should stand, for it is low
    and not fast, the other does not stand, and the `pelvis` (its height, metres) does not fall freely.

    Such steps are a contact with those around them in which the foot stands, under the same hysteresis. Of a foot that
    glides, an end is held that moves as the stiller one does; one that rolls is not. Contacts of one end with next to
    nothing between them are one.
    """
    held, height, step = held_steps(feet, fps, floor), _height(feet, floor), feet.diff(dim=0)
    best, stiller = (step.norm(dim=-1) * fps / _GLIDE + height / _HEIGHT).min(dim=-1)
    stiller = stiller[..., None]
    still = step.take_along_dim(stiller[..., None], dim=2)
    rolls = (step - still).norm(dim=-1) * fps / _SPEED + height / _HEIGHT
    stands = held.any(dim=-1)
    glides = (best < 1) & ~stands & ~stands.flip(dims=(1,)) & ~_falling(pelvis, fps)[:, None]
    best = torch.where(glides | stands, best, torch.inf)
    lower = height.take_along_dim(stiller, dim=2)[..., 0]
    for foot in range(feet.shape[1]):
        for start, end in _contacts(best[:, foot], lower[:, foot], fps):
            if still[start:end, foot].sum(dim=0).norm() < _FARTHEST:
                held[start:end, foot] |= glides[start:end, foot, None] & (rolls[start:end, foot] < 1)
    for foot, end in product(range(feet.shape[1]), range(2)):
        _close(held[:, foot, end], feet[:, foot, end], height[:, foot, end], fps)
    return held


def held_steps(
    points: Float[Tensor, "frames *points 3"], fps: float | int, floor: float | int
) -> Bool[Tensor, _ * points]:
    """Whether each of the `points` (metres, z up) stands from each frame to the next; one step fewer than frames.

    Hysteresis: a contact is a run of steps that may be contacts, of which one surely is.
    """
    height = _height(points, floor)
    share = points.diff(dim=0).norm(dim=-1) * fps / _SPEED + height / _HEIGHT
    held = torch.zeros_like(share, dtype=torch.bool)
    for column, *each in zip(*(values.flatten(start_dim=1).T for values in (held, share, height)), strict=True):
        for start, end in _contacts(*each, fps):
            column[start:end] = True
    return held


def standing_frames(held: Bool[Tensor, "_ 2"]) -> Bool[Tensor, "frames 2"]:
    """Whether each end stands in each frame: in the step before it or after it."""
    none = torch.zeros_like(held[:1])
    return torch.cat([none, held]) | torch.cat([held, none])


def runs(mask: Bool[Tensor, " steps"]) -> list[tuple[int, int]]:
    """The first and the last (exclusive) of each run of True."""
    edges = torch.nn.functional.pad(mask.int(), (1, 1)).diff()
    return list(zip((edges > 0).nonzero()[:, 0].tolist(), (edges < 0).nonzero()[:, 0].tolist(), strict=True))


def _contacts(
    share: Float[Tensor, " steps"], height: Float[Tensor, " steps"], fps: float | int
) -> list[tuple[int, int]]:
    """The runs of steps with a `share` below 1, without what comes down or goes up at both ends, that are long enough
    and in which one step is sure."""
    found = []
    for start, end in runs(share < 1):
        down = (height[start:end] <= height[start:end].min() + _RISE).nonzero()[:, 0]
        start, end = start + int(down[0]), start + int(down[-1]) + 1
        if end - start >= _SHORTEST * fps - 1e-6 and share[start:end].min() < _SURE:
            found.append((start, end))
    return found


def _close(
    held: Bool[Tensor, " steps"], points: Float[Tensor, "_ 3"], height: Float[Tensor, " steps"], fps: float | int
) -> None:
    """Makes contacts of one point one, in place, where the time and the way between them are too short for a step."""
    for (_, end), (start, _) in pairwise(runs(held)):
        level = height[end:start].max() <= torch.minimum(height[end - 1], height[start]) + _RISE
        if start - end <= _GAP * fps + 1e-6 and level and (points[start] - points[end]).norm() < _SHUFFLE:
            held[end:start] = True


def _height(points: Float[Tensor, "frames *points 3"], floor: float | int) -> Float[Tensor, _ * points]:
    """Metres above the floor, at the higher end of each step."""
    return (torch.maximum(points[1:, ..., 2], points[:-1, ..., 2]) - floor).clamp(min=0)


def _falling(pelvis: Float[Tensor, " frames"], fps: float | int) -> Bool[Tensor, " steps"]:
    """Whether nothing carries the pelvis at the beginning or the end of each step."""
    reach = max(1, round(_FALLING * fps))
    falls = torch.zeros_like(pelvis, dtype=torch.bool)
    if len(pelvis) > 2 * reach:
        bent = pelvis[2 * reach :] - 2 * pelvis[reach:-reach] + pelvis[: -2 * reach]
        falls[reach:-reach] = bent * (fps / reach) ** 2 < -_FALL
    return falls[1:] | falls[:-1]
