"""The chart of `stmc benchmark-length`: time and memory of sampling against the length of a timeline."""

from __future__ import annotations

from pathlib import Path

from matplotlib.axes import Axes

from stmc.evaluation.results.chart_axes import DASHED, dress, grid, legend
from stmc.evaluation.results.naming import method_row
from stmc.viewing.colours import palette
from stmc.viewing.figure import Figure
from stmc.viewing.timeline_figure import INK

_MEBIBYTE = 2**20


def length_chart(rows: list[dict]) -> Figure:
    """Draw time and memory of sampling against the length of the timeline, with a line per run.

    Dashed lines are proportional to the length and pass through the longest timeline; they have slope one on the
    logarithmic axes.
    """
    plot, panels = grid(2, wide=4.4, tall=3.2)
    timed = all("seconds" in row for row in rows)
    _draw(panels[0], rows, "seconds" if timed else "relative_time", 1)
    _draw(panels[1], rows, "sampling_bytes", _MEBIBYTE)
    for axes, label in zip(panels, ("seconds" if timed else "time / shortest", "memory of sampling, MiB"), strict=True):
        axes.set_ylabel(label, color=INK, fontsize=9)
    legend(plot, panels)
    return plot


def _draw(axes: Axes, rows: list[dict], key: str, unit: int) -> None:
    """Draw one panel; values that are not above 0 (memory that loading already needed) are left out."""
    runs = list(dict.fromkeys((row["method"], row["model"]) for row in rows))
    for colour, run in zip(palette(len(runs)), runs, strict=True):
        own = [row for row in rows if (row["method"], row["model"]) == run and row[key] > 0]
        lengths, values = [row["length"] for row in own], [row[key] / unit for row in own]
        named = [other for other, _ in runs].count(run[0]) > 1
        label = f"{method_row(run[0]).label}, {Path(run[1] or 'bundled').name}" if named else method_row(run[0]).label
        axes.plot(lengths, values, color=colour, marker="o", markersize=4, linewidth=1.6, label=label)
        if own:
            straight = [values[-1] / lengths[-1] * length for length in lengths]
            axes.plot(lengths, straight, zorder=1, label="straight line", **DASHED)
    axes.set_xscale("log")
    axes.set_yscale("log")
    lengths = sorted({row["length"] for row in rows})
    axes.set_xticks(lengths, [f"{length / 60:g} min" if length >= 60 else f"{length:g} s" for length in lengths])
    axes.minorticks_off()
    axes.set_xlabel("length of the timeline", color=INK, fontsize=9)
    dress(axes, "both")
