"""Figures of Barquero et al. 2024: jerk around transitions, trade-off of absolute steps, and attention of a frame."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Float
from matplotlib import colormaps
from matplotlib.axes import Axes

from stmc.evaluation.results.chart_axes import DASHED, Groups, dress, grid, legend
from stmc.evaluation.results.charts import sweep
from stmc.evaluation.results.intervals import Estimate, estimate
from stmc.evaluation.results.naming import REAL, method_row, place, variant
from stmc.evaluation.results.result_records import Result, ResultError, by_setting
from stmc.viewing.colours import palette
from stmc.viewing.figure import Figure
from stmc.viewing.timeline_figure import INK

JERK = "jerk"
"""Key of the curve to draw."""


def jerk_curves(results: Sequence[Result]) -> Figure:
    """Draw the mean jerk at each frame around a transition (FlowMDM, Fig. 4).

    There is a panel per denoiser and a line with its 95 % interval per method; real motion is dashed. Raises
    `ResultError` if no record has the curve "jerk", if curves differ in length, or if two settings have the same name.
    """
    groups = by_setting(result for result in results if JERK in result.curves)
    if not groups:
        raise ResultError(f"no record has a curve {JERK!r}")
    lengths = {len(run.curves[JERK]) for runs in groups.values() for run in runs}
    if len(lengths) > 1:
        raise ResultError(
            f"curves {JERK!r} of {', '.join(map(str, sorted(lengths)))} frames; choose those of one length"
        )
    denoisers = sorted({setting.denoiser for setting in groups if setting.method != REAL}) or [""]
    colours = _colours(groups)
    plot, panels = grid(len(denoisers), wide=5.6 if len(denoisers) == 1 else 4.4, tall=3.4)
    for axes, denoiser in zip(panels, denoisers, strict=True):
        own = {setting: runs for setting, runs in groups.items() if setting.denoiser == denoiser}
        real = {setting: runs for setting, runs in groups.items() if setting.method == REAL}
        _draw_curves(axes, own | real, colours)
        axes.axvline(0, color=INK, linewidth=0.6)
        axes.set_title(denoiser, fontsize=9.5, color=INK)
        axes.set_xlabel("frames from the transition's middle", color=INK, fontsize=9)
        dress(axes, "both")
    top = max(axes.get_ylim()[1] for axes in panels)
    for axes in panels:
        axes.set_ylim(0, top)
    panels[0].set_ylabel("largest jerk of a joint, m/frame³", color=INK, fontsize=9)
    legend(plot, panels)
    return plot


def trade_off(results: Sequence[Result]) -> Figure:
    """Draw metrics against the share of steps with absolute positions (FlowMDM, Fig. 5).

    The metrics are R-precision, FID of transitions and area under the jerk.

    Raises the errors of `charts.sweep`.
    """
    return sweep(results, "ape_steps", ("r_precision", "transition_fid", "area_under_jerk"))


def attention_curves(scores: Float[np.ndarray, "steps frames"], frame: int) -> Figure:
    """Draw the attention of one frame to all frames, with a curve per denoising step (FlowMDM, Fig. 2).

    Colours range from blue, the noisiest step, to red. `scores` are those of `frame`, as in
    `denoisers.recorded_attention`. Raises `ResultError` for no steps, or a frame out of range.
    """
    steps, frames = scores.shape
    if not steps or not 0 <= frame < frames:
        raise ResultError(
            f"cannot draw {steps} steps and frame {frame} of {frames}; need a step, and a frame below {frames}"
        )
    plot, [axes] = grid(1, wide=5.6, tall=3.4)
    for step, row in enumerate(scores):
        colour = colormaps["coolwarm"](step / max(1, steps - 1))
        axes.plot(np.arange(frames) - frame, row, color=colour, linewidth=1.0)
    axes.axvline(0, color=INK, linewidth=0.6)
    axes.set_ylim(bottom=0)
    axes.set_xlabel("frames from the one that attends", color=INK, fontsize=9)
    axes.set_ylabel("attention, mean of layers and heads", color=INK, fontsize=9)
    dress(axes, "both")
    return plot


def _colours(groups: Groups) -> dict[str, str]:
    """Return a colour per method, for all denoisers.

    Raises `ResultError` if two settings of a denoiser have the same name.
    """
    made = sorted((setting for setting in groups if setting.method != REAL), key=place)
    labels = [(setting.denoiser, variant(setting)) for setting in made]
    if twice := [label for label in labels if labels.count(label) > 1]:
        raise ResultError(f"{', '.join(filter(None, twice[0]))} has several settings; choose one")
    names = list(dict.fromkeys(name for _, name in labels))
    return dict(zip(names, palette(len(names)), strict=True))


def _draw_curves(axes: Axes, groups: Groups, colours: Mapping[str, str]) -> None:
    for setting in sorted(groups, key=place):
        frames, found = _curve(groups[setting])
        mean, half = np.array([each.mean for each in found]), np.array([each.half or 0.0 for each in found])
        if setting.method == REAL:
            axes.plot(frames, mean, label=method_row(REAL).label, **DASHED)
            continue
        name = variant(setting)
        axes.plot(frames, mean, color=colours[name], linewidth=1.6, label=name)
        axes.fill_between(frames, mean - half, mean + half, color=colours[name], alpha=0.15, linewidth=0)


def _curve(runs: Sequence[Result]) -> tuple[np.ndarray, list[Estimate]]:
    """Return frames relative to the middle of the window, and the estimates there."""
    values = [estimate(column) for column in zip(*(run.curves[JERK] for run in runs), strict=True)]
    return np.arange(len(values)) - (len(values) - 1) / 2, values
