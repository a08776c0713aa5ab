"""Which prompt each body part obeys at every frame (STMC, section 3.3 and Appendix B). Knows no crops, no overlap."""

from __future__ import annotations

import warnings
from itertools import groupby

from stmc.body import BodyPart
from stmc.timeline import Timeline, TimelineError, TimelineWarning, elementary, sinc_order

Run = tuple[int | None, int, int]
"""The index of a prompt, or None where no prompt holds, and the frames [start, end) it owns."""


def assign(timeline: Timeline, fps: int | float) -> dict[BodyPart, tuple[Run, ...]]:
    """For each body part the prompts that own it, in time order, covering [0, frames) without holes.

    Time is cut at every start and end; in each interval the base prompt gets the whole body and the others override the
    parts they claim, in SINC's order (`sinc_order`); neighbouring intervals of one prompt are joined. A moment without
    a prompt belongs to None, for all five parts alike (R3). Ties fall to the file's order (R2).

    Raises:
        TimelineError: If the timeline lasts no frame at all.

    Warns:
        TimelineWarning: For a prompt that lasts no frame, which owns nothing.
    """
    spans = timeline.spans(fps)
    frames = timeline.frames(fps)
    if frames == 0:
        raise TimelineError(f"the timeline's {timeline.duration:g} s are no frame at {fps:g} fps; make it longer")
    for prompt, (start, end) in zip(timeline.prompts, spans, strict=True):
        if start == end:
            message = f"{prompt.text!r} ({prompt.start:g} to {prompt.end:g} s) lasts no frame at {fps:g} fps: left out"
            warnings.warn(message, TimelineWarning, stacklevel=2)
    owners: dict[BodyPart, list[Run]] = {part: [] for part in BodyPart}
    for start, end, (_, *active) in elementary([(0, frames), *spans]):
        for part, owner in _owners(timeline, [index - 1 for index in active]).items():
            owners[part].append((owner, start, end))
    return {part: _joined(runs) for part, runs in owners.items()}


def _owners(timeline: Timeline, active: list[int]) -> dict[BodyPart, int | None]:
    if not active:
        return dict.fromkeys(BodyPart)
    base, *others = sinc_order(timeline.prompts, active)
    owners: dict[BodyPart, int | None] = dict.fromkeys(BodyPart, base)
    for index in others:
        owners |= dict.fromkeys(timeline.prompts[index].claims, index)
    return owners


def _joined(runs: list[Run]) -> tuple[Run, ...]:
    groups = (list(group) for _, group in groupby(runs, key=lambda run: run[0]))
    return tuple((group[0][0], group[0][1], group[-1][2]) for group in groups)
