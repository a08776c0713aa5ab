"""Figures of Barquero et al. 2024: the jerk around transitions, of any benchmark, what absolute steps trade, and what a
frame attends to.

Knows records and matplotlib's figures, as `charts` does.
"""

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
"""The curve that is drawn."""


def jerk_curves(results: Sequence[Result]) -> Figure:
    """The mean jerk in each frame around a transition (their Fig. 4): a panel per denoiser, a line with its 95 %
    interval per method, in the same colours everywhere; real motion is dashed.

    Raises `ResultError` where no record has the curve "jerk", where curves are of several lengths, and for two settings
    that the legend could not tell apart.
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
    """What more steps with absolute positions do to subsequences and transitions (their Fig. 5): R-precision, FID of
    transitions and area under the jerk against the share of these steps. Raises as `charts.sweep`."""
    return sweep(results, "ape_steps", ("r_precision", "transition_fid", "area_under_jerk"))


def attention_curves(scores: Float[np.ndarray, "steps frames"], frame: int) -> Figure:
    """How much one frame attends to every other, a curve for each step of denoising, from blue (the noisiest) to red
    (their Fig. 2): `scores` are that frame's, as `denoisers.recorded_attention` has them. Raises `ResultError` for no
    step, and for a frame that is none."""
    steps, frames = scores.shape
    if not steps or not 0 <= frame < frames:
        raise ResultError(f"{steps} steps, and frame {frame} of {frames}")
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
    """The colour of every method, the same for all denoisers. Raises `ResultError` where two settings of one denoiser
    have one name."""
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
    """Frames from the middle of the window, and the values there."""
    values = [estimate(column) for column in zip(*(run.curves[JERK] for run in runs), strict=True)]
    return np.arange(len(values)) - (len(values) - 1) / 2, values
