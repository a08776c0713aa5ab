"""Figures of plans: crops, and the weight of each crop for a body part over time."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Rectangle

from stmc.motion.body import BodyPart
from stmc.timeline.planning import Plan
from stmc.viewing.colours import NEUTRAL, ink, palette
from stmc.viewing.figure import Figure
from stmc.viewing.timeline_figure import FAINT, INK

_ROW_INCHES, _PANEL_INCHES = 0.26, 0.62


def plot_plan(
    plan: Plan, fps: int | float, parts: Sequence[BodyPart] | None = None, width: int | float = 10.0
) -> Figure:
    """Plot the crops of a plan, and below them the weights of their tiles for body parts.

    Crops without a text are grey. Positive weights are above the line, negative ones hatched below it. The figure is
    not registered with pyplot: save it, or show it in a notebook.

    Args:
        plan: Plan to plot.
        fps: Frames per second.
        parts: Body parts to plot; None: one for each group with equal weights.
        width: Width in inches.

    Examples:
        >>> timeline = stmc.Timeline.parse("walk # 0 # 4 # legs\\nwave # 1 # 3 # right arm")
        >>> stmc.plot_plan(stmc.plan(timeline, fps=20, overlap=10), fps=20).savefig("plan.svg")
    """
    weights = {part: _weights(plan, part) for part in (BodyPart if parts is None else parts)}
    alike = _alike(weights) if parts is None else {part: str(part) for part in weights}
    heights = [_ROW_INCHES * len(plan.crops), *[_PANEL_INCHES] * len(alike)]
    plot = Figure(figsize=(width, sum(heights) + 0.7), layout="constrained")
    axes = plot.subplots(len(heights), 1, sharex=True, height_ratios=heights, squeeze=False)[:, 0]
    colours = _colours(plan)
    _crops(axes[0], plan, fps, colours)
    for panel, (part, name) in zip(axes[1:], alike.items(), strict=True):
        _shares(panel, weights[part], fps, colours)
        panel.set_ylabel(name, rotation=0, ha="right", va="center", fontsize=9, color=INK)
    for each in axes:
        each.set(xlim=(0, plan.frames / fps))
        each.tick_params(length=0, labelsize=9, colors=FAINT)
        each.spines[:].set_visible(False)
    axes[-1].set_xlabel("seconds", color=FAINT, fontsize=9)
    return plot


def _weights(plan: Plan, part: BodyPart) -> np.ndarray:
    """Return the weight of each crop for a part, [crops, frames]; tiles of one crop and frame are summed."""
    weights = np.zeros((len(plan.crops), plan.frames))
    for tile in plan.tiles:
        if tile.part == part:
            weights[tile.crop, tile.start : tile.end] += tile.weight
    return weights


def _alike(weights: dict[BodyPart, np.ndarray]) -> dict[BodyPart, str]:
    """Group parts with equal weights; return one part of each group with the names of all."""
    groups: dict[bytes, list[BodyPart]] = {}
    for part, each in weights.items():
        groups.setdefault(each.tobytes(), []).append(part)
    return {parts[0]: "all parts" if len(parts) == len(BodyPart) else "\n".join(parts) for parts in groups.values()}


def _colours(plan: Plan) -> list[str]:
    texts = list(dict.fromkeys(crop.text for crop in plan.crops if crop.text))
    by_text = dict(zip(texts, palette(len(texts)), strict=True))
    return [by_text.get(crop.text or "", NEUTRAL) for crop in plan.crops]


def _crops(axes: Axes, plan: Plan, fps: int | float, colours: Sequence[str]) -> None:
    axes.set(ylim=(len(plan.crops), 0), yticks=[])
    axes.set_ylabel("crops", rotation=0, ha="right", va="center", fontsize=9, color=INK)
    for row, (crop, colour) in enumerate(zip(plan.crops, colours, strict=True)):
        left, wide = crop.start / fps, crop.frames / fps
        axes.add_patch(Rectangle((left, row + 0.08), wide, 0.84, facecolor=colour, linewidth=0))
        label = axes.text(
            left + wide / 2, row + 0.5, crop.text or "", ha="center", va="center", fontsize=8, color=ink(colour)
        )
        label.set_clip_path(axes.patch)


def _shares(axes: Axes, weights: np.ndarray, fps: int | float, colours: Sequence[str]) -> None:
    edges = np.arange(weights.shape[1] + 1) / fps
    axes.axhline(0, color=FAINT, linewidth=0.8)
    for sign in (1, -1):
        base = np.zeros(weights.shape[1])
        for row, colour in zip(np.clip(sign * weights, 0, None), colours, strict=True):
            if row.any():
                axes.stairs(
                    sign * (base + row), edges, baseline=sign * base, fill=True, facecolor=colour, linewidth=0,
                    hatch=None if sign > 0 else "//////", edgecolor="white",
                )  # fmt: skip
                base += row
    lowest = min(0.0, float(np.clip(weights, None, 0).sum(axis=0).min()))
    highest = float(np.clip(weights, 0, None).sum(axis=0).max())
    axes.set(ylim=(1.1 * lowest - 0.02, 1.05 * highest), yticks=[0, 1])
