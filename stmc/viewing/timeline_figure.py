"""Figures of timelines: tracks of prompts, and below them the prompt of each body part."""

from __future__ import annotations

import textwrap

from matplotlib.axes import Axes
from matplotlib.patches import FancyBboxPatch, Rectangle
from matplotlib.ticker import MaxNLocator

from stmc.motion.body import BodyPart
from stmc.timeline import Timeline
from stmc.viewing.colours import NEUTRAL, ink, owners, palette, transitions
from stmc.viewing.figure import Figure

INK, FAINT = "#1d2330", "#8a919e"
_TRACK, _PART = 1.0, 0.46
"""Heights of a row of prompts and of the row of a body part."""
_ROW_INCHES = 0.42


def plot_timeline(
    timeline: Timeline, fps: int | float = 20, overlap: int | float = 0.0, width: int | float = 10.0
) -> Figure:
    """Plot the tracks of a timeline as bars with their texts, and below them the five body parts.

    Transitions are hatched. The figure is not registered with pyplot: save it, or show it in a notebook.

    Args:
        timeline: Timeline to plot.
        fps: Frames per second to which spans of body parts are rounded; the bundled model has 20.
        overlap: Length of transitions in seconds.
        width: Width in inches.

    Examples:
        >>> timeline = stmc.Timeline.parse("walk # 0 # 4 # legs\\nwave # 1 # 3 # right arm")
        >>> stmc.plot_timeline(timeline, overlap=0.5).savefig("timeline.svg")
    """
    rows = len(timeline.tracks) * _TRACK + 5 * _PART + 0.35
    plot = Figure(figsize=(width, _ROW_INCHES * rows + 0.85), layout="constrained")
    axes = plot.add_subplot()
    draw_tracks(axes, timeline, fps, overlap)
    if timeline.name:
        axes.set_title(timeline.name, loc="left", fontsize=11, color=INK, fontweight="bold")
    return plot


def draw_tracks(axes: Axes, timeline: Timeline, fps: int | float, overlap: int | float) -> None:
    """Draw tracks and body parts into `axes`, with seconds along x.

    Args:
        axes: Axes to draw on.
        timeline: Timeline to draw.
        fps: Frames per second.
        overlap: Length of transitions in seconds.
    """
    count, duration = len(timeline.tracks), timeline.duration
    parts_top = count * _TRACK + 0.35
    bottom = parts_top + len(BodyPart) * _PART
    axes.set(xlim=(0, duration), ylim=(bottom, -0.05))
    _prompts(axes, timeline)
    _parts(axes, timeline, fps, overlap, parts_top)
    ticks = [parts_top + (index + 0.5) * _PART for index in range(len(BodyPart))]
    names = [f"track {row + 1}" if count > 1 else "prompts" for row in range(count)]
    axes.set_yticks([(row + 0.5) * _TRACK for row in range(count)] + ticks, [*names, *BodyPart])
    axes.xaxis.set_major_locator(MaxNLocator(nbins=12, steps=[1, 2, 5, 10]))
    axes.set_xlabel("seconds", color=FAINT, fontsize=9)
    axes.tick_params(length=0, labelsize=9, colors=INK)
    axes.tick_params(axis="x", colors=FAINT)
    axes.grid(axis="x", color="#e6e8ec", linewidth=0.8)
    axes.set_axisbelow(True)
    axes.spines[:].set_visible(False)


def _prompts(axes: Axes, timeline: Timeline) -> None:
    inches = axes.figure.bbox.width / axes.figure.dpi * 0.86 / timeline.duration
    for row, prompt, colour in zip(timeline.rows, timeline.prompts, palette(len(timeline.prompts)), strict=True):
        left, wide = prompt.start, prompt.end - prompt.start
        _bar(axes, left, row * _TRACK + 0.08, wide, _TRACK - 0.16, colour, inches)
        room = max(3, int(wide * inches * 12.5) - 1)
        lines = textwrap.wrap(prompt.text, room, max_lines=2, placeholder=" …") or [prompt.text[:room]]
        axes.text(
            left + wide / 2, (row + 0.5) * _TRACK, "\n".join(lines), ha="center", va="center", fontsize=9,
            color=ink(colour), linespacing=1.05, clip_on=True,
        )  # fmt: skip


def _parts(axes: Axes, timeline: Timeline, fps: int | float, overlap: int | float, top: float) -> None:
    colours = palette(len(timeline.prompts))
    for index, spans in enumerate(owners(timeline, fps, timeline.frames(fps)).values()):
        low, tall = top + index * _PART + 0.05, _PART - 0.10
        for owner, start, end in spans:
            colour = NEUTRAL if owner is None else colours[owner]
            width = (end - start) / fps
            axes.add_patch(Rectangle((start / fps, low), width, tall, facecolor=colour, linewidth=0, alpha=0.9))
        for left, right in transitions(spans, fps, overlap):
            axes.add_patch(
                Rectangle(
                    (left / fps, low), (right - left) / fps, tall, facecolor=NEUTRAL, edgecolor="white", hatch="//////",
                    linewidth=0,
                )
            )  # fmt: skip


def _bar(axes: Axes, left: float, low: float, wide: float, tall: float, colour: str, inches: int | float) -> None:
    """Draw a bar with corners that stay round although seconds and rows have different scales."""
    corner = min(0.06 / inches, wide / 2)
    shape = f"round,pad=0,rounding_size={corner}"
    aspect = inches / _ROW_INCHES  # seconds per row's unit, so that corners are circles on paper
    axes.add_patch(
        FancyBboxPatch((left, low), wide, tall, shape, mutation_aspect=aspect, facecolor=colour, edgecolor="white")
    )
