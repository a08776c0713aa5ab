"""The prompt that owns each body part at every frame (STMC, section 3.3 and Appendix B).

Independent of crops and overlaps.
"""

from __future__ import annotations

from stmc.io.untrusted import quote
from stmc.motion.body import BodyPart
from stmc.timeline import Timeline, TimelineError
from stmc.timeline.advice import advise
from stmc.timeline.overlaps import Precedence, sweep

Run = tuple[int | None, int, int]
"""The index of a prompt, or None if no prompt holds, and the frames [start, end) it owns."""


def assign(timeline: Timeline, fps: int | float, frames: int | None = None) -> dict[BodyPart, tuple[Run, ...]]:
    r"""Compute, for each body part, the prompts that own it, in time order, covering [0, frames) without holes.

    Time is cut at every start and end. In each interval the base prompt gets the whole body and the others override the
    parts they claim, in SINC's order (`Precedence`); adjacent intervals of one prompt are merged. A time without a
    prompt belongs to None, for all five parts (R3). The file's order breaks ties (R2).

    Args:
        timeline: The timeline.
        fps: Frames per second.
        frames: Number of frames to cover, with a gap after the last prompt; None, and fewer than the timeline has: the
            timeline's own.

    Raises:
        TimelineError: If the timeline lasts no frame at all.

    Warns:
        TimelineWarning: Once, if prompts last no frame and so own nothing.

    Examples:
        >>> timeline = stmc.Timeline.parse("walk # 0 # 4 # legs\nwave # 1 # 3 # right arm")
        >>> stmc.assign(timeline, fps=20)[stmc.BodyPart.RIGHT_ARM]
        ((0, 0, 20), (1, 20, 60), (0, 60, 80))
    """
    spans = timeline.spans(fps)
    frames = max(timeline.frames(fps), frames or 0)
    if frames == 0:
        seconds = f"{timeline.duration:g} s are less than a frame at {fps:g} fps"
        raise TimelineError(f"{timeline.place}: the timeline's {seconds}; make it longer")
    _warn_of_empty_spans(timeline, spans, fps)
    precedence = Precedence([prompt.parts for prompt in timeline.prompts])
    owners: dict[BodyPart, list[Run]] = {part: [] for part in BodyPart}
    whole = len(spans)  # index of a span of the whole timeline, so that the sweep includes a gap at its start
    for start, end, ended, started in sweep([*spans, (0, frames)]):
        precedence.update(ended, [index for index in started if index != whole])
        for part, runs in owners.items():
            owner = precedence.owner(part)
            if runs and runs[-1][0] == owner:
                runs[-1] = (owner, runs[-1][1], end)
            else:
                runs.append((owner, start, end))
    return {part: tuple(runs) for part, runs in owners.items()}


def _warn_of_empty_spans(timeline: Timeline, spans: tuple[tuple[int, int], ...], fps: int | float) -> None:
    empty = [prompt for prompt, (start, end) in zip(timeline.prompts, spans, strict=True) if start == end]
    if empty:
        first, more = empty[0], f", and {len(empty) - 1} more" if len(empty) > 1 else ""
        message = f"{quote(first.text)} ({first.start:g} to {first.end:g} s) lasts no frame at {fps:g} fps"
        advise(f"{message} and is left out{more}")
