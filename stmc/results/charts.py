"""Results as figures: bars with intervals, quality against steps and time, the sweep of overlaps.

Knows records and matplotlib's figures. No figure is known to pyplot: save it, or show it in a notebook.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullLocator

from stmc.results.intervals import Estimate, estimate, estimates
from stmc.results.naming import HEADINGS, REAL, Measure, measures, method, place, variant
from stmc.results.records import Result, ResultError, Setting, by_setting, refuse_other_differences
from stmc.viewing.colours import palette
from stmc.viewing.tracks import FAINT, INK

SECONDS = "seconds"
"""The metric that says how long one motion took."""
_GRID = "#e6e8ec"
_SAMPLERS = {"ddpm": "DDPM", "ddim": "DDIM", "dpm_solver": "DPM-Solver++"}

Groups = dict[Setting, list[Result]]
Point = tuple[float, Estimate]


def bars(results: Sequence[Result]) -> Figure:
    """A panel per metric, a group of bars per denoiser, a bar with its 95 % interval per method; the same colours in
    all panels. The ground truth is a dashed line.

    Raises `ResultError` for no record of a known metric.
    """
    groups = by_setting(results)
    made = {setting: runs for setting, runs in groups.items() if setting.method != REAL}
    columns = _shown(made)
    names = list(dict.fromkeys(variant(setting) for setting in sorted(made, key=place)))
    plot, panels = _panels(len(columns), wide=max(2.4, 0.24 * len(made) + 1.3), tall=2.9)
    for axes, measure in zip(panels, columns, strict=True):
        _bar_panel(axes, measure, made, dict(zip(names, palette(len(names)), strict=True)))
        for setting, runs in groups.items():
            found = estimates(runs)
            if setting.method == REAL and measure.key in found:
                axes.axhline(
                    found[measure.key].mean, color=INK, linewidth=1, linestyle=(0, (4, 3)), label=method(REAL).label
                )
    _legend(plot, panels)
    return plot


def quality_against_cost(results: Sequence[Result], keys: Sequence[str] = ("recall_3", "fid", "fid_plus")) -> Figure:
    """Rows: the metrics `keys` (those that the records have); left against the steps, right against the seconds a
    motion takes; a line per sampler, with 95 % intervals. Both axes of cost are logarithmic.

    `results` are of one method of one denoiser. Raises `ResultError` where they differ in more than sampler, spread of
    the noise, and steps.
    """
    groups = {setting: runs for setting, runs in by_setting(results).items() if setting.steps is not None}
    refuse_other_differences(groups, ("sampler", "spread", "steps"))
    columns = _shown(groups, keys)
    timed = all(SECONDS in result.metrics for runs in groups.values() for result in runs)
    plot = Figure(figsize=(4.4 * (1 + timed), 2.9 * len(columns)), layout="constrained")
    grid = plot.subplots(len(columns), 1 + timed, squeeze=False, sharey="row")
    for row, measure in zip(grid, columns, strict=True):
        _lines(row[0], measure, groups, _sampler, lambda setting, runs: setting.steps, "steps")
        if timed:
            _lines(row[1], measure, groups, _sampler, _mean_seconds, "seconds per motion")
            row[1].set_ylabel("")
    steps = sorted({setting.steps for setting in groups})
    for axes in grid.flat:
        axes.set_xscale("log")
        axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        axes.xaxis.set_major_formatter("{x:g}")
        axes.xaxis.set_minor_locator(NullLocator())
    for axes in grid[:, 0]:
        axes.set_xticks(steps, map(str, steps))
    _legend(plot, list(grid.flat))
    return plot


def sweep(results: Sequence[Result], varied: str) -> Figure:
    """A panel per metric against a setting that is a number, such as the overlap; a line per denoiser and method, with
    95 % intervals. Raises `ResultError` for records without it, or that differ in other settings."""
    groups = {setting: runs for setting, runs in by_setting(results).items() if getattr(setting, varied) is not None}
    if not groups:
        raise ResultError(f"no record has {varied}")
    refuse_other_differences(groups, (varied, "denoiser", "method"))
    columns = _shown(groups)
    plot, panels = _panels(len(columns), wide=3.0, tall=2.6)
    for axes, measure in zip(panels, columns, strict=True):
        _lines(axes, measure, groups, _who, lambda setting, runs: getattr(setting, varied), HEADINGS[varied].lower())
    _legend(plot, panels)
    return plot


def _bar_panel(axes: Axes, measure: Measure, groups: Groups, colours: dict[str, str]) -> None:
    """Each denoiser's bars side by side; a setting more than one of a method stands beside it in the same colour."""
    position, ticks = 0.0, []
    denoisers = dict.fromkeys(setting.denoiser for setting in groups)
    for denoiser in denoisers:
        own = sorted((each for each in groups if each.denoiser == denoiser), key=place)
        ticks.append((position + (len(own) - 1) / 2, denoiser))
        for setting in own:
            found = estimates(groups[setting]).get(measure.key)
            if found is not None:
                label = variant(setting)
                axes.bar(position, found.mean, 0.86, color=colours[label], label=label)
                if found.half is not None:
                    axes.errorbar(position, found.mean, found.half, color=INK, linewidth=1.1, capsize=2.5)
            position += 1
        position += 0.8
    axes.set_xticks([at for at, _ in ticks], [name for _, name in ticks])
    axes.set_title(_title(measure), fontsize=9.5, color=INK)
    _dress(axes, "y")


def _lines(
    axes: Axes,
    measure: Measure,
    groups: Groups,
    name: Callable[[Setting], str],
    cost: Callable[[Setting, list[Result]], float | int],
    label: str,
) -> None:
    lines: dict[str, list[Point]] = {}
    for setting, runs in groups.items():
        found = estimates(runs).get(measure.key)
        if found is not None:
            lines.setdefault(name(setting), []).append((cost(setting, runs), found))
    for colour, (line, points) in zip(palette(len(lines)), sorted(lines.items()), strict=True):
        points = sorted(points, key=lambda point: point[0])
        half = np.array([point.half or 0.0 for _, point in points])
        axes.errorbar(
            [at for at, _ in points], [point.mean for _, point in points], half if half.any() else None, color=colour,
            marker="o", markersize=4, linewidth=1.6, elinewidth=1.1, capsize=2.5, label=line,
        )  # fmt: skip
    axes.set_xlabel(label, color=INK, fontsize=9)
    axes.set_ylabel(_title(measure), color=INK, fontsize=9)
    _dress(axes, "both")


def _shown(groups: Groups, keys: Sequence[str] | None = None) -> tuple[Measure, ...]:
    columns = measures(name for runs in groups.values() for name in estimates(runs) if keys is None or name in keys)
    if not columns:
        wanted = "" if keys is None else f" of {', '.join(keys)}"
        raise ResultError(f"no record has a metric to draw{wanted}")
    return columns


def _panels(count: int, wide: float, tall: float) -> tuple[Figure, list[Axes]]:
    """At most four panels in a row."""
    columns = min(count, 4)
    rows = -(-count // columns)
    plot = Figure(figsize=(wide * columns, tall * rows + 0.4), layout="constrained")
    panels = list(plot.subplots(rows, columns, squeeze=False).flat)
    for spare in panels[count:]:
        spare.remove()
    return plot, panels[:count]


def _dress(axes: Axes, grid: str) -> None:
    axes.grid(axis=grid, color=_GRID, linewidth=0.8)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)
    axes.spines[["left", "bottom"]].set_color(FAINT)
    axes.tick_params(labelsize=8.5, colors=INK, length=0)


def _legend(plot: Figure, panels: Iterable[Axes]) -> None:
    """One for all panels, each name once, where there is something to tell apart."""
    named = {}
    for axes in panels:
        named |= {label: handle for handle, label in zip(*axes.get_legend_handles_labels(), strict=True)}
    if len(named) > 1:
        plot.legend(
            named.values(),
            named.keys(),
            loc="outside lower center",
            ncols=min(len(named), 6),
            frameon=False,
            fontsize=9,
        )


def _mean_seconds(setting: Setting, runs: list[Result]) -> float:
    return estimate([run.metrics[SECONDS] for run in runs]).mean


def _sampler(setting: Setting) -> str:
    name = _SAMPLERS.get(setting.sampler or "", setting.sampler or "–")
    return f"{name}, {setting.spread}" if setting.spread else name


def _who(setting: Setting) -> str:
    return ", ".join(filter(None, (setting.denoiser, method(setting.method).label)))


def _title(measure: Measure) -> str:
    unit = f", {measure.unit}" if measure.unit else ""
    return f"{measure.heading}{unit} {measure.arrow}"
