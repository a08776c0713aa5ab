"""Arms that pass from one crop to the next within a few frames are given the whole transition for it.

A network that has hardly seen an arm between two actions lets it be here or there, and the less noise there is, the
harder the change becomes: whichever way crops are weighed, all of them agree on it. The poses stay, on their shortest
arcs; when the arm is where is made anew. Knows plans and layouts of features; knows no networks, texts or samplers.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from functools import partial

import torch
from einops import rearrange
from jaxtyping import Bool, Float, Int
from torch import Tensor

from stmc.diffusion import Predict
from stmc.diffusion.statistics import Statistics
from stmc.diffusion.tensors import PerDevice
from stmc.motion.body import BodyPart
from stmc.motion.geometry import axis_angle_to_matrix, matrix_to_axis_angle, matrix_to_rows, rows_to_matrix
from stmc.motion.representation import Layout
from stmc.timeline.planning import Plan, Span, transition_spans

ARMS = (BodyPart.LEFT_ARM, BodyPart.RIGHT_ARM)
"""Legs are not retimed, since feet would slide, nor is what the arms hang on."""

FASTEST = 2.0
"""How far an arm turns in one frame of a transition at most, over its mean there. A swing to and fro has pi / 2, and a
reach 3 / 2: both stay as they are."""

Steps = Float[Tensor, "windows steps"]


def retimed(predict: Predict, plans: Sequence[Plan], layout: Layout, statistics: Statistics) -> Predict:
    """The predictor of timelines, normalised by `statistics`, whose arms take their time: where one is passed on from a
    crop to another, and turns further in some frame than `FASTEST` times the mean of that transition, it goes through
    the same poses at a steadier pace.

    The pace is mixed from its own and that of a reach, from rest to rest with the least acceleration (a cubic), with no
    more of the latter than is needed. Frames outside transitions, and arms that are slow enough, are not touched.
    Transitions that touch are one. The `plans` are those of `planning.plan`. Features without rotations stay as they
    are.

    Examples:
        >>> model = stmc.load()
        >>> plans = model.plans([stmc.Timeline.parse("walk # 0 # 2\\nraise the right arm # 1 # 2 # right arm")])
        >>> predict = stmc.collage(model.guided(plans), plans, model.representation.columns)
        >>> predict = stmc.composing.retimed(predict, plans, model.representation.layout, model.motion_statistics)
        >>> predict(torch.zeros(1, 40, 205), 50).shape
        torch.Size([1, 40, 205])
    """
    arms = [_Arm.of(plans, part, layout, statistics) for part in ARMS if "rotations" in layout.slices]
    cached = [PerDevice(partial(_Arm.to, arm)) for arm in arms if arm is not None]

    def steady(x: Tensor, t: int) -> Tensor:
        x0 = predict(x, t).clone()
        for each in cached:
            each.at(x0).retime(x0)
        return x0

    return steady


@dataclass(frozen=True)
class _Arm:
    """Its transitions in all plans, each with the frame before and the one behind, which stay as they are."""

    rows: Int[Tensor, "windows 1"]
    """Which plan each is of."""
    frames: Int[Tensor, "windows frames"]
    """Of its timeline; the last one again behind the end of a shorter window."""
    reach: Steps
    """The steps of a reach that long, of mean 1; 0 behind the end."""
    columns: Int[Tensor, " columns"]
    turning: Bool[Tensor, " columns"]
    """Which of them are of rotations: six of a joint."""
    statistics: Statistics
    """Of the columns."""

    @classmethod
    def of(cls, plans: Sequence[Plan], part: BodyPart, layout: Layout, statistics: Statistics) -> _Arm | None:
        spans = [(row, *span) for row, plan in enumerate(plans) for span in _windows(plan, part)]
        if not spans:
            return None
        rows, first, last = torch.tensor(spans).split(1, dim=1)
        frames = torch.arange(int((last - first).max()) + 1)
        way = (frames / (last - first)).clamp(max=1)
        reach = (last - first) * (way**2 * (3 - 2 * way)).diff(dim=1)
        columns, where = torch.tensor(layout.columns[part]), layout["rotations"]
        own = Statistics(*(each.cpu()[columns] for each in (statistics.mean, statistics.std)))
        turning = (columns >= where.start) & (columns < where.stop)
        return cls(rows, torch.minimum(first + frames, last), reach, columns, turning, own)

    def to(self, x: Tensor) -> _Arm:
        values = {each.name: getattr(self, each.name) for each in fields(self)}
        moved = {name: value.to(x.device) for name, value in values.items()}
        return _Arm(**moved | {"reach": self.reach.to(x)})

    def retime(self, x0: Float[Tensor, "batch frames features"]) -> None:
        """In place."""
        raw = self.statistics.restore(x0[self.rows, self.frames][..., self.columns])
        poses = rows_to_matrix(rearrange(raw[..., self.turning], "... (joints six) -> ... joints six", six=6))
        turns = matrix_to_axis_angle(poses[:, :-1].mT @ poses[:, 1:])
        steps = turns.flatten(2).norm(dim=-1)
        wanted = paced(steps, self.reach)
        at, share = _along(steps, wanted)
        window = torch.arange(len(at), device=at.device)[:, None]
        turned = poses[window, at] @ axis_angle_to_matrix(share[..., None, None] * turns[window, at])
        values = torch.lerp(raw[window, at], raw[window, at + 1], share[..., None])
        values[..., self.turning] = rearrange(matrix_to_rows(turned), "... joints six -> ... (joints six)")
        inner = self.frames[:, 1:-1]
        changed = (wanted != steps).any(dim=1, keepdim=True) & (inner < self.frames[:, -1:])
        where = self.rows.expand_as(inner)[changed][:, None], inner[changed][:, None], self.columns
        x0[where] = self.statistics.normalise(values)[changed]


def _windows(plan: Plan, part: BodyPart) -> list[Span]:
    """First and last frame of each."""
    joined: list[Span] = []
    for start, end in transition_spans(plan, part):
        first, last = max(0, start - 1), min(plan.frames - 1, end)
        joined = [*joined[:-1], (joined[-1][0], last)] if joined and first < joined[-1][1] else [*joined, (first, last)]
    return joined


def paced(steps: Steps, reach: Steps) -> Steps:
    """Steps of the same sum of which none is longer than `FASTEST` times their mean: as they are where they are that
    already, else mixed with those of a `reach`, of mean 1 and 0 where there is no step."""
    mean = steps.sum(dim=1, keepdim=True) / reach.sum(dim=1, keepdim=True)
    longest = steps.amax(dim=1, keepdim=True)
    fast = longest > FASTEST * mean
    mixed = (longest - FASTEST * mean) / (longest - reach.amax(dim=1, keepdim=True) * mean).where(fast, 1)
    return torch.where(fast, torch.lerp(steps, mean * reach, mixed.where(fast, 0)), steps)


def _along(steps: Steps, wanted: Steps) -> tuple[Int[Tensor, "windows inner"], Float[Tensor, "windows inner"]]:
    """For each frame but the first and the last, in which of the `steps` it now lies, and at which share of that."""
    way, sought = torch.nn.functional.pad(steps.cumsum(dim=1), (1, 0)), wanted.cumsum(dim=1)[:, :-1].contiguous()
    at = (torch.searchsorted(way, sought, right=True) - 1).clamp(0, steps.shape[1] - 1)
    length = steps.gather(1, at)
    share = (sought - way.gather(1, at)) / length.where(length > 0, 1)
    return at, share.clamp(0, 1)
