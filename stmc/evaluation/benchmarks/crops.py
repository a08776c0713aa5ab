"""The frames of motions that should show each text, and the windows of transitions, for the benchmarks of timelines."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch

from stmc.composing.sampling import INDEPENDENT
from stmc.evaluation.benchmarks.resampling import Rows
from stmc.evaluation.metrics.smoothness import transition_window, window_jerk
from stmc.evaluation.metrics.timeline_metrics import Span
from stmc.motion.motion import Motion
from stmc.timeline import Prompt, Timeline

JERKED_SECONDS = 1
"""Duration in seconds of a transition whose jerk is measured, as on BABEL (FlowMDM, section 4.1): prompts follow too
closely for more."""


def requested_timelines(method: str, timelines: Sequence[Timeline]) -> list[Timeline]:
    """Return the timelines that a method generates motions for: for "independent", one timeline per prompt."""
    if method != INDEPENDENT:
        return list(timelines)
    prompts = [prompt for timeline in timelines for prompt in timeline.prompts]
    return [Timeline((Prompt(prompt.text, 0.0, prompt.end - prompt.start, prompt.parts),)) for prompt in prompts]


def crop_spans(
    method: str, timelines: Sequence[Timeline], lengths: Sequence[int], fps: float | int, numbers: Mapping[str, int]
) -> list[list[Span]]:
    """Return, for each motion, the frames that should show each text, and the index of the text.

    Spans end at the end of the motion; for "one_text" and "independent" they cover the whole motion.

    Args:
        method: Name of the method.
        timelines: Timelines of the benchmark.
        lengths: Length of each motion in frames, in the order of `requested_timelines`.
        fps: Frames per second.
        numbers: Index of each text.
    """
    spans = []
    for timeline, length in zip(requested_timelines(method, timelines), lengths, strict=True):
        whole = [(0, length)] * len(timeline.prompts)
        requested = whole if method in ("one_text", INDEPENDENT) else timeline.spans(fps)
        pairs = zip(requested, timeline.prompts, strict=True)
        spans.append([(start, min(end, length), numbers[prompt.text]) for (start, end), prompt in pairs])
    return spans


def jerk_rows(
    motions: Sequence[Motion], points: Sequence[Sequence[int]], units: Sequence[int], fps: float | int
) -> Rows:
    """Compute the jerk in m/frame³ in the complete windows around the points of each motion, one row per window.

    Args:
        motions: The motions.
        points: Frames of the transitions of each motion.
        units: Index of the unit of each motion.
        fps: Frames per second.
    """
    length, jerks, owners = round(JERKED_SECONDS * fps), [], []
    for motion, frames, unit in zip(motions, points, units, strict=True):
        for point in frames:
            start, end = transition_window(point, length)
            if start >= 0 and end <= len(motion):
                jerks.append(window_jerk(motion.trimmed(start, end), length))
                owners.append(unit)
    return Rows(torch.stack(jerks) if jerks else torch.zeros(0, length - 3), owners)
