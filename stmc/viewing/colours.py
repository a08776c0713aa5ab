"""Colours of prompts in all figures, pictures and pages, and of body parts over time."""

from __future__ import annotations

import math

import numpy as np
from jaxtyping import Float

from stmc.motion.body import BodyPart
from stmc.motion.motion import Motion
from stmc.timeline import Timeline
from stmc.timeline.planning import assign

NEUTRAL = "#b9bec7"
"""Colour of gaps and of the middle of transitions."""

_PALETTE = ("#0072b2", "#e69f00", "#009e73", "#cc79a7", "#56b4e9", "#d55e00", "#f0e442")
"""Colours of Okabe and Ito (2008), safe for the colour-blind, ordered so that neighbours differ strongly."""

Spans = tuple[tuple[int | None, int, int], ...]


def palette(count: int) -> tuple[str, ...]:
    """Return `count` colours as "#rrggbb", one per prompt in order. After seven, they are darker or lighter shades."""
    shades = ((0.0, 0.0), (0.45, 0.0), (0.45, 1.0))
    return tuple(
        as_hex(mix(as_rgb(_PALETTE[index % len(_PALETTE)]), *shades[index // len(_PALETTE) % len(shades)]))
        for index in range(count)
    )


def as_rgb(colour: str) -> Float[np.ndarray, " 3"]:
    """Convert "#rrggbb" to red, green and blue from 0 to 1."""
    return np.array([int(colour[at : at + 2], 16) for at in (1, 3, 5)]) / 255.0


def as_hex(rgb: Float[np.ndarray, " 3"]) -> str:
    """Convert red, green and blue from 0 to 1 to "#rrggbb"."""
    return "#" + "".join(f"{round(255 * value):02x}" for value in np.clip(rgb, 0.0, 1.0))


def mix(rgb: np.ndarray, share: float, other: np.ndarray | float) -> np.ndarray:
    """Mix `rgb` with a `share` (0 to 1) of another colour or grey.

    Args:
        rgb: Colour.
        share: Share of the other colour.
        other: Other colour, or the brightness of a grey.
    """
    return (1.0 - share) * rgb + share * np.asarray(other)


def ink(colour: str) -> str:
    """Return the text colour with the higher contrast on `colour` (WCAG 2.2, 1.4.3)."""
    luminance = as_rgb(colour) ** 2.2 @ np.array([0.2126, 0.7152, 0.0722])
    return "#ffffff" if luminance < 0.206 else "#1d2330"


def owners(timeline: Timeline, fps: int | float, frames: int) -> dict[BodyPart, Spans]:
    """Return the prompts of body parts by `assign`, cut to `frames` or filled up with None.

    Args:
        timeline: Timeline of the prompts.
        fps: Frames per second.
        frames: Number of frames.
    """
    owned: dict[BodyPart, Spans] = {}
    for part, spans in assign(timeline, fps).items():
        kept = [(owner, start, min(end, frames)) for owner, start, end in spans if start < frames]
        reached = kept[-1][2] if kept else 0
        owned[part] = (*kept, *([(None, reached, frames)] if reached < frames else []))
    return owned


def transition_seconds(motion: Motion, overlap: int | float | None) -> int | float:
    """Return the length in seconds of the transitions to show: `overlap`, or that of sampling if None."""
    return (motion.overlap or 0.0) if overlap is None else overlap


def transitions(spans: Spans, fps: int | float, overlap: int | float) -> list[tuple[float, float]]:
    """Return the transitions between spans as (start, end) in frames.

    Args:
        spans: Spans of a body part.
        fps: Frames per second.
        overlap: Length of transitions in seconds, cut at the ends of the motion.
    """
    if overlap <= 0:
        return []
    half = overlap * fps / 2
    last = spans[-1][2]
    return [(max(start - half, 0.0), min(start + half, last)) for _, start, _ in spans[1:]]


def owned_seconds(
    timeline: Timeline, fps: int | float, frames: int, overlap: int | float
) -> dict[str, dict[str, list]]:
    """Return "owners" and "transitions" of each body part, in seconds, for pages.

    Owners are [index of a prompt or None, start, end]; transitions are [start, end].

    Args:
        timeline: Timeline of the prompts.
        fps: Frames per second.
        frames: Number of frames.
        overlap: Length of transitions in seconds.
    """
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
    """Return the colour (0 to 1) of each of the five body parts, in the order of `BodyPart`, at each frame.

    A part has the colour of its prompt and fades through neutral in transitions; gaps are neutral.

    Args:
        timeline: Timeline of the prompts; None: the first colour everywhere.
        fps: Frames per second.
        frames: Number of frames.
        overlap: Length of transitions in seconds.
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
        for left, right in transitions(owned[part], fps, overlap):
            centre, half = (left + right) / 2, max((right - left) / 2, 1e-9)
            near = slice(int(left), math.ceil(right))
            share = np.clip(1.0 - np.abs(middle[near] - centre) / half, 0.0, 1.0)[:, None]
            result[near, index] = (1 - share) * result[near, index] + share * neutral
    return result
