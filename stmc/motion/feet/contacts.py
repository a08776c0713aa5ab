"""Contacts of heels and toes with the floor: low and slow, or low and gliding while nothing else supports the body.

Depends on points, steps and the height of the pelvis; independent of legs. A contact is a run of *steps*, from one
frame to the next, in which the point should not move, so that two contacts may follow each other without a frame
between them.
"""

from __future__ import annotations

from itertools import pairwise, product

import torch
from jaxtyping import Bool, Float
from torch import Tensor

_SPEED, _HEIGHT = 0.4, 0.1
"""Speed in m/s on the floor, and height in metres at rest, above which a point certainly does not stand. In between,
the score of a step is the sum of speed and height as fractions of these limits; a step below 1 may be a contact."""
_GLIDE = 0.9
"""Speed in m/s on the floor above which the only supporting foot certainly swings: swinging feet move at 2 to 4 m/s."""
_SURE = 0.6
"""Score that at least one step of a contact must stay below."""
_MIN_SECONDS = 0.1
"""Minimum duration of a contact in seconds: the feet of runners stand for 0.15 s."""
_RISE = 0.01
"""Metres above the lowest point of a contact at which it begins or ends."""
_GAP, _SHUFFLE = 0.15, 0.08
"""Seconds and metres between two contacts that are merged: no step is so short."""
_FARTHEST = 0.5
"""Maximum distance in metres that a foot glides in one contact; longer glides are kept."""
_FALL, _FALLING = 5.9, 0.05
"""Acceleration in m/s² of an unsupported pelvis (0.6 of gravity), and seconds on either side over which it is measured.
"""


def standing_steps(
    feet: Float[Tensor, "frames feet 2 3"], pelvis: Float[Tensor, " frames"], fps: float | int, floor: float | int
) -> Bool[Tensor, "_ feet 2"]:
    """Detect the steps in which the heels and toes of two feet stand.

    These are `held_steps`, and the steps in which a foot glides but should stand: it is low and not fast, the other
    foot does not stand, and the pelvis does not fall freely. Gliding steps form contacts together with the standing
    steps around them, with the same hysteresis. The ends of a gliding foot that move like its stiller end are held; an
    end that rolls is not. Contacts of one end that nearly touch are merged.

    Args:
        feet: Positions of heels and toes in metres, [frames, feet, 2, 3].
        pelvis: Height of the pelvis in metres, [frames].
        fps: Frames per second.
        floor: Height of the floor in metres.
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
    """Detect whether each point stands from each frame to the next; the result has one step fewer than frames.

    With hysteresis: a contact is a run of possible contact steps of which at least one is certain.

    Args:
        points: Positions in metres, z up, [frames, *points, 3].
        fps: Frames per second.
        floor: Height of the floor in metres.
    """
    height = _height(points, floor)
    score = points.diff(dim=0).norm(dim=-1) * fps / _SPEED + height / _HEIGHT
    held = torch.zeros_like(score, dtype=torch.bool)
    columns = (tensor.flatten(start_dim=1).T for tensor in (held, score, height))
    for point_held, point_score, point_height in zip(*columns, strict=True):
        for start, end in _contacts(point_score, point_height, fps):
            point_held[start:end] = True
    return held


def standing_frames(held: Bool[Tensor, "_ 2"]) -> Bool[Tensor, "frames 2"]:
    """Return whether each end stands in each frame, that is, in the step before or after it."""
    none = torch.zeros_like(held[:1])
    return torch.cat([none, held]) | torch.cat([held, none])


def runs(mask: Bool[Tensor, " steps"]) -> list[tuple[int, int]]:
    """Return the start and the exclusive end of each run of True."""
    edges = torch.nn.functional.pad(mask.int(), (1, 1)).diff()
    return list(zip((edges > 0).nonzero()[:, 0].tolist(), (edges < 0).nonzero()[:, 0].tolist(), strict=True))


def _contacts(
    score: Float[Tensor, " steps"], height: Float[Tensor, " steps"], fps: float | int
) -> list[tuple[int, int]]:
    """Find the runs of steps with a score below 1 that are long enough and contain a certain step.

    Descending and ascending steps at both ends are removed.
    """
    contacts = []
    for start, end in runs(score < 1):
        down = (height[start:end] <= height[start:end].min() + _RISE).nonzero()[:, 0]
        start, end = start + int(down[0]), start + int(down[-1]) + 1
        if end - start >= _MIN_SECONDS * fps - 1e-6 and score[start:end].min() < _SURE:
            contacts.append((start, end))
    return contacts


def _close(
    held: Bool[Tensor, " steps"], points: Float[Tensor, "_ 3"], height: Float[Tensor, " steps"], fps: float | int
) -> None:
    """Merge, in place, contacts of one point that are too close in time and space for a step between them."""
    for (_, end), (start, _) in pairwise(runs(held)):
        level = height[end:start].max() <= torch.minimum(height[end - 1], height[start]) + _RISE
        if start - end <= _GAP * fps + 1e-6 and level and (points[start] - points[end]).norm() < _SHUFFLE:
            held[end:start] = True


def _height(points: Float[Tensor, "frames *points 3"], floor: float | int) -> Float[Tensor, _ * points]:
    """Return the height above the floor in metres, at the higher end of each step."""
    return (torch.maximum(points[1:, ..., 2], points[:-1, ..., 2]) - floor).clamp(min=0)


def _falling(pelvis: Float[Tensor, " frames"], fps: float | int) -> Bool[Tensor, " steps"]:
    """Return whether the pelvis is unsupported at the beginning or the end of each step."""
    span = max(1, round(_FALLING * fps))
    falls = torch.zeros_like(pelvis, dtype=torch.bool)
    if len(pelvis) > 2 * span:
        second_difference = pelvis[2 * span :] - 2 * pelvis[span:-span] + pelvis[: -2 * span]
        falls[span:-span] = second_difference * (fps / span) ** 2 < -_FALL
    return falls[1:] | falls[:-1]
