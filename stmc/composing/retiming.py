"""Retiming of arms that pass from one crop to the next within a few frames: they use the whole transition.

A network that has rarely seen an arm between two actions places it at one or the other, and the less noise there is,
the harder the change becomes: however crops are weighted, all of them agree on it. The poses are kept, on their
shortest arcs; only their timing changes. Depends on plans and layouts of features; independent of networks, texts and
samplers.
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
"""The retimed body parts. Retimed legs would slide, and arms hang on the other parts."""
MAX_SPEED_RATIO = 2.0
"""Maximum speed of an arm in a transition relative to its mean speed there. A swing to and fro has pi / 2, and a reach
3 / 2: both stay unchanged."""

Steps = Float[Tensor, "windows steps"]


def time_warp(predict: Predict, plans: Sequence[Plan], layout: Layout, statistics: Statistics) -> Predict:
    r"""Wrap a predictor of timelines so that arms use the whole transition from one crop to another.

    If an arm rotates further in some frame than `MAX_SPEED_RATIO` times the mean of its transition, it passes through
    the same poses at a steadier pace. The pace is mixed from its own and that of a reach, from rest to rest with the
    least acceleration (a cubic), with as little of the latter as possible. Frames outside transitions, slow arms, and
    features without rotations are unchanged. Transitions that touch are merged.

    Args:
        predict: Predictor of timelines.
        plans: Plans of `planning.plan`.
        layout: Layout of the features.
        statistics: Statistics that normalise the features.

    Examples:
        >>> model = stmc.load()
        >>> plans = model.plans([stmc.Timeline.parse("walk # 0 # 2\nraise the right arm # 1 # 2 # right arm")])
        >>> predict = stmc.collage(model.guided(plans), plans, model.representation.columns)
        >>> predict = stmc.composing.time_warp(predict, plans, model.representation.layout, model.motion_statistics)
        >>> predict(torch.zeros(1, 40, 205), 50).shape
        torch.Size([1, 40, 205])
    """
    arms = [_Arm.of(plans, part, layout, statistics) for part in ARMS if "rotations" in layout.slices]
    cached = [PerDevice(partial(_Arm.to, arm)) for arm in arms if arm is not None]

    def predict_steadily(x: Tensor, t: int) -> Tensor:
        x0 = predict(x, t).clone()
        for arm in cached:
            arm.at(x0).retime(x0)
        return x0

    return predict_steadily


@dataclass(frozen=True)
class _Arm:
    """The transitions of one arm in all plans, each with the frame before and the frame after, which stay unchanged."""

    rows: Int[Tensor, "windows 1"]
    """Index of each window's plan."""
    frames: Int[Tensor, "windows frames"]
    """Frames of each window in its timeline; the last one repeats after the end of a shorter window."""
    reach: Steps
    """Steps of a reach of that length, with mean 1; 0 after the end."""
    columns: Int[Tensor, " columns"]
    turning: Bool[Tensor, " columns"]
    """True at the columns of rotations, six per joint."""
    statistics: Statistics
    """Statistics of the columns."""

    @classmethod
    def of(cls, plans: Sequence[Plan], part: BodyPart, layout: Layout, statistics: Statistics) -> _Arm | None:
        spans = [(row, *span) for row, plan in enumerate(plans) for span in _windows(plan, part)]
        if not spans:
            return None
        rows, first, last = torch.tensor(spans).split(1, dim=1)
        frames = torch.arange(int((last - first).max()) + 1)
        progress = (frames / (last - first)).clamp(max=1)
        reach = (last - first) * (progress**2 * (3 - 2 * progress)).diff(dim=1)
        columns, rotations = torch.tensor(layout.columns[part]), layout["rotations"]
        part_statistics = Statistics(*(values.cpu()[columns] for values in (statistics.mean, statistics.std)))
        turning = (columns >= rotations.start) & (columns < rotations.stop)
        return cls(rows, torch.minimum(first + frames, last), reach, columns, turning, part_statistics)

    def to(self, x: Tensor) -> _Arm:
        values = {field.name: getattr(self, field.name).to(x.device) for field in fields(self)}
        return _Arm(**values | {"reach": self.reach.to(x)})

    def retime(self, x0: Float[Tensor, "batch frames features"]) -> None:
        """Retime the arm in place."""
        raw = self.statistics.restore(x0[self.rows, self.frames][..., self.columns])
        poses = rows_to_matrix(rearrange(raw[..., self.turning], "... (joints six) -> ... joints six", six=6))
        turns = matrix_to_axis_angle(poses[:, :-1].mT @ poses[:, 1:])
        steps = turns.flatten(2).norm(dim=-1)
        target = limit_speed(steps, self.reach)
        index, fraction = _locate(steps, target)
        window = torch.arange(len(index), device=index.device)[:, None]
        retimed_poses = poses[window, index] @ axis_angle_to_matrix(fraction[..., None, None] * turns[window, index])
        values = torch.lerp(raw[window, index], raw[window, index + 1], fraction[..., None])
        values[..., self.turning] = rearrange(matrix_to_rows(retimed_poses), "... joints six -> ... (joints six)")
        inner = self.frames[:, 1:-1]
        changed = (target != steps).any(dim=1, keepdim=True) & (inner < self.frames[:, -1:])
        changes = self.rows.expand_as(inner)[changed][:, None], inner[changed][:, None], self.columns
        x0[changes] = self.statistics.normalise(values)[changed]


def _windows(plan: Plan, part: BodyPart) -> list[Span]:
    """Return the first and last frame of each window."""
    windows: list[Span] = []
    for start, end in transition_spans(plan, part):
        first, last = max(0, start - 1), min(plan.frames - 1, end)
        touches = bool(windows) and first < windows[-1][1]
        windows = [*windows[:-1], (windows[-1][0], last)] if touches else [*windows, (first, last)]
    return windows


def limit_speed(steps: Steps, reach: Steps) -> Steps:
    """Limit steps to `MAX_SPEED_RATIO` times their mean, and keep their sum.

    Steps within the limit are unchanged; others are mixed with those of a `reach`, with mean 1 and 0 where there is no
    step.
    """
    mean = steps.sum(dim=1, keepdim=True) / reach.sum(dim=1, keepdim=True)
    longest = steps.amax(dim=1, keepdim=True)
    fast = longest > MAX_SPEED_RATIO * mean
    mix = (longest - MAX_SPEED_RATIO * mean) / (longest - reach.amax(dim=1, keepdim=True) * mean).where(fast, 1)
    return torch.where(fast, torch.lerp(steps, mean * reach, mix.where(fast, 0)), steps)


def _locate(steps: Steps, target: Steps) -> tuple[Int[Tensor, "windows inner"], Float[Tensor, "windows inner"]]:
    """Locate each inner frame on the path: return the index of its step and its fraction of that step."""
    path, position = torch.nn.functional.pad(steps.cumsum(dim=1), (1, 0)), target.cumsum(dim=1)[:, :-1].contiguous()
    index = (torch.searchsorted(path, position, right=True) - 1).clamp(0, steps.shape[1] - 1)
    length = steps.gather(1, index)
    fraction = (position - path.gather(1, index)) / length.where(length > 0, 1)
    return index, fraction.clamp(0, 1)
