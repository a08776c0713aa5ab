"""Elements of figures of results: panels, lines, legends and their style."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, Literal

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes

from stmc.evaluation.results.intervals import Estimate, estimates
from stmc.evaluation.results.naming import REAL, Measure, measures, method_row
from stmc.evaluation.results.result_records import Result, ResultError, Setting
from stmc.viewing.colours import palette
from stmc.viewing.figure import Figure
from stmc.viewing.timeline_figure import FAINT, INK

GRID = "#e6e8ec"
DASHED: Mapping[str, Any] = {"color": INK, "linewidth": 1, "linestyle": (0, (4, 3))}

Groups = dict[Setting, list[Result]]
Point = tuple[float | int, Estimate]


def lines(
    axes: Axes,
    measure: Measure,
    groups: Groups,
    name: Callable[[Setting], str],
    cost: Callable[[Setting, list[Result]], float | int],
    label: str,
) -> None:
    """Draw a line with 95 % intervals for each name, with style and labels.

    Args:
        axes: Axes to draw on.
        measure: Metric on the y axis.
        groups: Runs by setting; each setting is a point.
        name: Function that names the line of a setting.
        cost: Function that places a point on the x axis.
        label: Label of the x axis.
    """
    named: dict[str, list[Point]] = {}
    for setting, runs in groups.items():
        found = estimates(runs).get(measure.key)
        if found is not None:
            named.setdefault(name(setting), []).append((cost(setting, runs), found))
    for colour, (line, points) in zip(palette(len(named)), sorted(named.items()), strict=True):
        points = sorted(points, key=lambda point: point[0])
        half = np.array([point.half or 0.0 for _, point in points])
        axes.errorbar(
            [at for at, _ in points], [point.mean for _, point in points], half if half.any() else None, color=colour,
            marker="o", markersize=4, linewidth=1.6, elinewidth=1.1, capsize=2.5, label=line,
        )  # fmt: skip
    axes.set_xlabel(label, color=INK, fontsize=9)
    axes.set_ylabel(title(measure), color=INK, fontsize=9)
    dress(axes, "both")


def real_line(axes: Axes, measure: Measure, groups: Groups) -> None:
    """Draw the value of real motion, if measured, as a dashed line."""
    for setting, runs in groups.items():
        found = estimates(runs)
        if setting.method == REAL and measure.key in found:
            axes.axhline(found[measure.key].mean, label=method_row(REAL).label, **DASHED)


def select_measures(groups: Groups, keys: Sequence[str] | None = None) -> tuple[Measure, ...]:
    """Select the measures of the records, limited to `keys` if given. Raises `ResultError` if there are none."""
    columns = measures(name for runs in groups.values() for name in estimates(runs) if keys is None or name in keys)
    if not columns:
        wanted = "" if keys is None else f" of {', '.join(keys)}"
        raise ResultError(f"no record has a metric to draw{wanted}")
    return columns


def grid(count: int, wide: float, tall: float) -> tuple[Figure, list[Axes]]:
    """Return a figure with `count` panels, at most four per row; `wide` and `tall` are inches of one panel."""
    columns = min(count, 4)
    rows = -(-count // columns)
    plot = Figure(figsize=(wide * columns, tall * rows), layout="constrained")
    found = list(plot.subplots(rows, columns, squeeze=False).flat)
    for spare in found[count:]:
        spare.remove()
    return plot, found[:count]


def dress(axes: Axes, along: Literal["x", "y", "both"]) -> None:
    """Style axes plainly: without a frame, with grey grid lines `along` "x", "y" or "both"."""
    axes.grid(axis=along, color=GRID, linewidth=0.8)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)
    axes.spines[["left", "bottom"]].set_color(FAINT)
    axes.tick_params(labelsize=8.5, colors=INK, length=0)


def legend(plot: Figure, panels: Iterable[Axes]) -> None:
    """Draw one legend for all panels, with each name once, if there are at least two names.

    The legend is no wider than the figure, whose height grows by that of the legend.
    """
    named: dict[str, Artist] = {}
    for axes in panels:
        named |= {label: handle for handle, label in zip(*axes.get_legend_handles_labels(), strict=True)}
    if len(named) < 2:
        return
    for columns in range(len(named), 0, -1):
        shown = plot.legend(
            list(named.values()), list(named), loc="outside lower center", ncols=columns, frameon=False, fontsize=9
        )
        extent = shown.get_window_extent()
        if columns == 1 or extent.width <= plot.bbox.width:
            plot.set_figheight(plot.get_figheight() + extent.height / plot.dpi)
            return
        shown.remove()


def name_setting(setting: Setting) -> str:
    """Return the names of denoiser and method."""
    return ", ".join(filter(None, (setting.denoiser, method_row(setting.method).label)))


def title(measure: Measure) -> str:
    """Return heading, unit and better direction of a measure."""
    unit = f", {measure.unit}" if measure.unit else ""
    return f"{measure.heading}{unit} {measure.arrow}"
