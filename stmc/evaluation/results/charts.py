"""Figures of results: bars with intervals, quality against steps and time, and sweeps of a setting.

This module knows records and matplotlib's figures. Figures are not registered with pyplot: save them, or show them in
a notebook.
"""

from __future__ import annotations

from collections.abc import Sequence

from matplotlib.axes import Axes
from matplotlib.ticker import LogLocator, NullLocator

from stmc.evaluation.results.chart_axes import (
    Groups,
    dress,
    grid,
    legend,
    lines,
    name_setting,
    real_line,
    select_measures,
    title,
)
from stmc.evaluation.results.intervals import estimate, estimates
from stmc.evaluation.results.naming import REAL, SETTINGS, Measure, place, variant
from stmc.evaluation.results.result_records import Result, ResultError, Setting, by_setting, check_only_varied
from stmc.viewing.colours import palette
from stmc.viewing.figure import Figure
from stmc.viewing.timeline_figure import INK

SECONDS = "seconds"
"""Key of the metric with the sampling time of one motion."""
_SAMPLERS = {"ddpm": "DDPM", "ddim": "DDIM", "dpm_solver": "DPM-Solver++"}


def bars(results: Sequence[Result]) -> Figure:
    """Draw a panel per metric with a group of bars per denoiser and a bar with its 95 % interval per method.

    Colours are the same in all panels; the ground truth is a dashed line. Raises `ResultError` if no record has a known
    metric.
    """
    groups = by_setting(results)
    made = {setting: runs for setting, runs in groups.items() if setting.method != REAL}
    columns = select_measures(made)
    names = list(dict.fromkeys(variant(setting) for setting in sorted(made, key=place)))
    plot, panels = grid(len(columns), wide=max(2.4, 0.24 * len(made) + 1.3), tall=2.9)
    for axes, measure in zip(panels, columns, strict=True):
        _bar_panel(axes, measure, made, dict(zip(names, palette(len(names)), strict=True)))
        real_line(axes, measure, groups)
    legend(plot, panels)
    return plot


def quality_against_cost(results: Sequence[Result], keys: Sequence[str] = ("recall_3", "fid", "fid_plus")) -> Figure:
    """Draw a row per metric of `keys` that the records have, with a line and 95 % intervals per sampler.

    The left panel shows the metric against steps, the right one against seconds per motion, on logarithmic axes. Raises
    `ResultError` if `results` differ in more than sampler, noise scale and steps, such as in method or denoiser.
    """
    groups = {setting: runs for setting, runs in by_setting(results).items() if setting.sampling.steps is not None}
    check_only_varied(groups, ("sampler", "noise_scale", "steps"))
    columns = select_measures(groups, keys)
    timed = all(SECONDS in result.metrics for runs in groups.values() for result in runs)
    plot = Figure(figsize=(4.4 * (1 + timed), 2.9 * len(columns)), layout="constrained")
    rows = plot.subplots(len(columns), 1 + timed, squeeze=False, sharey="row")
    for row, measure in zip(rows, columns, strict=True):
        lines(row[0], measure, groups, _sampler, _steps, "steps")
        if timed:
            lines(row[1], measure, groups, _sampler, _mean_seconds, "seconds per motion")
            row[1].set_ylabel("")
    steps = sorted({_steps(setting, runs) for setting, runs in groups.items()})
    for axes in rows.flat:
        axes.set_xscale("log")
        axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        axes.xaxis.set_major_formatter("{x:g}")
        axes.xaxis.set_minor_locator(NullLocator())
    for axes in rows[:, 0]:
        axes.set_xticks(steps, map(str, steps))
    legend(plot, list(rows.flat))
    return plot


def sweep(results: Sequence[Result], varied: str, keys: Sequence[str] | None = None) -> Figure:
    """Draw metrics against a numeric setting, such as the overlap, with a line and 95 % intervals per method.

    There is a panel per metric and a line per denoiser and method; real motion is a dashed line. Raises `ResultError`
    if no record has the setting, or if records differ in other settings.

    Args:
        results: Records to draw.
        varied: Name of the setting on the x axis.
        keys: Metrics to draw; None: all.
    """
    real = {setting: runs for setting, runs in by_setting(results).items() if setting.method == REAL}
    groups = {setting: runs for setting, runs in by_setting(results).items() if setting.value(varied) is not None}
    if not groups:
        raise ResultError(f"no record has {varied}")
    check_only_varied(groups, (varied, "denoiser", "method"))
    columns = select_measures(groups, keys)
    plot, panels = grid(len(columns), wide=3.0, tall=2.6)
    for axes, measure in zip(panels, columns, strict=True):
        lines(axes, measure, groups, name_setting, lambda setting, runs: setting.value(varied), SETTINGS[varied])
        real_line(axes, measure, real)
    legend(plot, panels)
    return plot


def _bar_panel(axes: Axes, measure: Measure, groups: Groups, colours: dict[str, str]) -> None:
    """Draw the bars of each denoiser side by side; further settings of a method share its colour."""
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
    axes.set_title(title(measure), fontsize=9.5, color=INK)
    dress(axes, "y")


def _steps(setting: Setting, runs: list[Result]) -> int:
    assert setting.sampling.steps is not None
    return setting.sampling.steps


def _mean_seconds(setting: Setting, runs: list[Result]) -> float:
    return estimate([run.metrics[SECONDS] for run in runs]).mean


def _sampler(setting: Setting) -> str:
    sampler, scale = str(setting.sampling.sampler or "–"), setting.sampling.noise_scale
    name = _SAMPLERS.get(sampler, sampler)
    return f"{name}, {scale}" if scale else name
