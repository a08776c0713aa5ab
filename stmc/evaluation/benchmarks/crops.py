"""Which frames of which motion should show which text, and where its transitions are: what the benchmarks of timelines
share.

Knows timelines, motions and methods by name; knows no evaluator and no measure but jerk.
"""

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
"""Of a transition whose jerk is measured, as of BABEL's (FlowMDM, section 4.1): prompts follow too soon for more."""


def asked_of(method: str, timelines: Sequence[Timeline]) -> list[Timeline]:
    """The timelines that a method makes motions of: for "independent" each prompt as a timeline."""
    if method != INDEPENDENT:
        return list(timelines)
    prompts = [prompt for timeline in timelines for prompt in timeline.prompts]
    return [Timeline((Prompt(each.text, 0.0, each.end - each.start, each.parts),)) for each in prompts]


def crop_spans(
    method: str, timelines: Sequence[Timeline], lengths: Sequence[int], fps: float | int, numbers: Mapping[str, int]
) -> list[list[Span]]:
    """For each motion, one per timeline of `asked_of` and of these `lengths` in frames, the frames that should show
    each text and the text's number. None goes on beyond its motion's end; of "one_text" and "independent" it is the
    whole motion."""
    spans = []
    for timeline, length in zip(asked_of(method, timelines), lengths, strict=True):
        whole = [(0, length)] * len(timeline.prompts)
        asked = whole if method in ("one_text", INDEPENDENT) else timeline.spans(fps)
        named = zip(asked, timeline.prompts, strict=True)
        spans.append([(start, min(end, length), numbers[prompt.text]) for (start, end), prompt in named])
    return spans


def jerk_rows(
    motions: Sequence[Motion], points: Sequence[Sequence[int]], units: Sequence[int], fps: float | int
) -> Rows:
    """Jerk in m/frame³ in the windows around the points of each motion that lie within it, a row each."""
    length, jerks, owners = round(JERKED_SECONDS * fps), [], []
    for motion, chosen, unit in zip(motions, points, units, strict=True):
        for point in chosen:
            start, end = transition_window(point, length)
            if start >= 0 and end <= len(motion):
                jerks.append(window_jerk(motion.trimmed(start, end), length))
                owners.append(unit)
    return Rows(torch.stack(jerks) if jerks else torch.zeros(0, length - 3), owners)
