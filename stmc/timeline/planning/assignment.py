"""Which prompt each body part obeys at every frame (STMC, section 3.3 and Appendix B). Knows no crops, no overlap."""

from __future__ import annotations

from stmc.io.untrusted import shown
from stmc.motion.body import BodyPart
from stmc.timeline import Timeline, TimelineError
from stmc.timeline.advice import advise
from stmc.timeline.overlaps import Precedence, sweep

Run = tuple[int | None, int, int]
"""The index of a prompt, or None where no prompt holds, and the frames [start, end) it owns."""


def assign(timeline: Timeline, fps: int | float) -> dict[BodyPart, tuple[Run, ...]]:
    """For each body part the prompts that own it, in time order, covering [0, frames) without holes.

    Time is cut at every start and end; in each interval the base prompt gets the whole body and the others override the
    parts they claim, in SINC's order (`Precedence`); neighbouring intervals of one prompt are joined. A moment without
    a prompt belongs to None, for all five parts alike (R3). Ties fall to the file's order (R2).

    Raises:
        TimelineError: If the timeline lasts no frame at all.

    Warns:
        TimelineWarning: One, for prompts that last no frame and so own nothing.

    Examples:
        >>> timeline = stmc.Timeline.parse("walk # 0 # 4 # legs\\nwave # 1 # 3 # right arm")
        >>> stmc.assign(timeline, fps=20)[stmc.BodyPart.RIGHT_ARM]
        ((0, 0, 20), (1, 20, 60), (0, 60, 80))
    """
    spans = timeline.spans(fps)
    frames = timeline.frames(fps)
    if frames == 0:
        seconds = f"{timeline.duration:g} s are less than a frame at {fps:g} fps"
        raise TimelineError(f"{timeline.place}: the timeline's {seconds}; make it longer")
    _advise_of_moments(timeline, spans, fps)
    precedence = Precedence([prompt.parts for prompt in timeline.prompts])
    owners: dict[BodyPart, list[Run]] = {part: [] for part in BodyPart}
    whole = len(spans)  # a span of the whole timeline, so that a gap at its start is swept too
    for start, end, ended, started in sweep([*spans, (0, frames)]):
        precedence.update(ended, [index for index in started if index != whole])
        for part, runs in owners.items():
            owner = precedence.owner(part)
            if runs and runs[-1][0] == owner:
                runs[-1] = (owner, runs[-1][1], end)
            else:
                runs.append((owner, start, end))
    return {part: tuple(runs) for part, runs in owners.items()}


def _advise_of_moments(timeline: Timeline, spans: tuple[tuple[int, int], ...], fps: int | float) -> None:
    moments = [prompt for prompt, (start, end) in zip(timeline.prompts, spans, strict=True) if start == end]
    if moments:
        first, more = moments[0], f", and {len(moments) - 1} more" if len(moments) > 1 else ""
        what = f"{shown(first.text)} ({first.start:g} to {first.end:g} s) lasts no frame at {fps:g} fps"
        advise(f"{what}: left out{more}")
