"""Which colour means which prompt, in every figure, picture and page, and how body parts wear them over time."""

from __future__ import annotations

import math

import numpy as np
from jaxtyping import Float

from stmc.motion.body import BodyPart
from stmc.motion.motion import Motion
from stmc.timeline import Timeline
from stmc.timeline.planning import assign

NEUTRAL = "#b9bec7"
"""Nobody's: gaps, and the middle of transitions."""

_PALETTE = ("#0072b2", "#e69f00", "#009e73", "#cc79a7", "#56b4e9", "#d55e00", "#f0e442")
"""Okabe and Ito's colours (2008), told apart also by the colour-blind, in an order that keeps neighbours far apart."""

Spans = tuple[tuple[int | None, int, int], ...]


def palette(count: int) -> tuple[str, ...]:
    """`count` colours as "#rrggbb", one per prompt in the timeline's order. After seven, darker and lighter shades."""
    shades = ((0.0, 0.0), (0.45, 0.0), (0.45, 1.0))
    return tuple(
        as_hex(mix(as_rgb(_PALETTE[index % len(_PALETTE)]), *shades[index // len(_PALETTE) % len(shades)]))
        for index in range(count)
    )


def as_rgb(colour: str) -> Float[np.ndarray, " 3"]:
    """Red, green and blue from 0 to 1 of "#rrggbb"."""
    return np.array([int(colour[at : at + 2], 16) for at in (1, 3, 5)]) / 255.0


def as_hex(rgb: Float[np.ndarray, " 3"]) -> str:
    """ "#rrggbb" of red, green and blue from 0 to 1."""
    return "#" + "".join(f"{round(255 * value):02x}" for value in np.clip(rgb, 0.0, 1.0))


def mix(rgb: np.ndarray, share: float, other: np.ndarray | float) -> np.ndarray:
    """`rgb` with a `share` (0 to 1) of another colour, or of a grey."""
    return (1.0 - share) * rgb + share * np.asarray(other)


def ink(colour: str) -> str:
    """The colour of text that is legible on `colour`: the one with the higher contrast (WCAG 2.2, 1.4.3)."""
    luminance = as_rgb(colour) ** 2.2 @ np.array([0.2126, 0.7152, 0.0722])
    return "#ffffff" if luminance < 0.206 else "#1d2330"


def owners(timeline: Timeline, fps: int | float, frames: int) -> dict[BodyPart, Spans]:
    """`assign`'s owners cut to `frames`, or filled up with nobody's."""
    owned: dict[BodyPart, Spans] = {}
    for part, spans in assign(timeline, fps).items():
        kept = [(owner, start, min(end, frames)) for owner, start, end in spans if start < frames]
        reached = kept[-1][2] if kept else 0
        owned[part] = (*kept, *([(None, reached, frames)] if reached < frames else []))
    return owned


def transition_seconds(motion: Motion, overlap: int | float | None) -> int | float:
    """Seconds of the transitions to show: `overlap`, or else those that the motion was sampled with."""
    return (motion.overlap or 0.0) if overlap is None else overlap


def transitions(spans: Spans, fps: int | float, overlap: int | float) -> list[tuple[float, float]]:
    """Where one owner hands over to the next: (start, end) in frames, `overlap` seconds long, within the spans."""
    if overlap <= 0:
        return []
    half = overlap * fps / 2
    last = spans[-1][2]
    return [(max(start - half, 0.0), min(start + half, last)) for _, start, _ in spans[1:]]


def owned_seconds(
    timeline: Timeline, fps: int | float, frames: int, overlap: int | float
) -> dict[str, dict[str, list]]:
    """For pages: the "owners" of each body part as [prompt's index or None, start, end], and the "transitions" between
    them as [start, end], in seconds."""
    owned = owners(timeline, fps, frames)
    return {
        "owners": {part: [[who, start / fps, end / fps] for who, start, end in spans] for part, spans in owned.items()},
        "transitions": {
            part: [[start / fps, end / fps] for start, end in transitions(spans, fps, overlap)]
            for part, spans in owned.items()
        },
    }


def part_colours(
    timeline: Timeline | None, fps: int | float, frames: int, overlap: int | float = 0.0
) -> Float[np.ndarray, "frames parts 3"]:
    """The colour (0 to 1) of each of the five body parts, in `BodyPart`'s order, in each frame.

    A part wears the colour of the prompt that owns it and fades through neutral for the `overlap` (seconds) around each
    hand-over; a gap is neutral. Without a timeline everything wears the first colour.
    """
    if timeline is None:
        return np.broadcast_to(as_rgb(_PALETTE[0]), (frames, len(BodyPart), 3)).copy()
    colours = [*map(as_rgb, palette(len(timeline.prompts)))]
    neutral = as_rgb(NEUTRAL)
    result = np.empty((frames, len(BodyPart), 3))
    middle = np.arange(frames) + 0.5
    owned = owners(timeline, fps, frames)
    for index, part in enumerate(BodyPart):
        for owner, start, end in owned[part]:
            result[start:end, index] = neutral if owner is None else colours[owner]
        for start, end in transitions(owned[part], fps, overlap):
            centre, half = (start + end) / 2, max((end - start) / 2, 1e-9)
            near = slice(int(start), math.ceil(end))
            share = np.clip(1.0 - np.abs(middle[near] - centre) / half, 0.0, 1.0)[:, None]
            result[near, index] = (1 - share) * result[near, index] + share * neutral
    return result
