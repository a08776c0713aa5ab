"""The baselines that transform a timeline: *one text* and *single track* (STMC, section 4.3)."""

from __future__ import annotations

from collections.abc import Iterable

from stmc.motion.body import BodyPart
from stmc.timeline.overlaps import elementary
from stmc.timeline.prompts import Prompt, Timeline
from stmc.timeline.timeline_files import TimelineError

MOST_CHARACTERS = 10_000_000
"""Maximum total length of the texts of a single track, whose size may grow with the square of the number of prompts."""


def one_text(timeline: Timeline, longest_seconds: int | float) -> Timeline:
    r"""Build the *one text* baseline: the whole timeline as a single prompt, "A and then B while C".

    The prompts of a track are joined by " and then ", tracks by " while ". The prompt lasts from 0 to the end of the
    timeline, but no longer than `longest_seconds`, the longest motion of the model.

    Examples:
        >>> timeline = stmc.Timeline.parse("walk # 0 # 4 # legs\nwave # 1 # 3 # right arm")
        >>> [prompt.text for prompt in stmc.one_text(timeline, longest_seconds=10).prompts]
        ['walk while wave']
    """
    text = " while ".join(" and then ".join(prompt.text for prompt in track) for track in timeline.tracks)
    end = min(timeline.duration, longest_seconds)
    return Timeline([Prompt(text, 0.0, end, _union(timeline.prompts))], timeline.name)


def single_track(timeline: Timeline, fps: int | float) -> Timeline:
    r"""Build the *single track* baseline (DiffCollage): cut the timeline wherever a prompt starts or ends.

    Texts that hold at once are joined by " while " in the file's order; gaps stay gaps. Cuts within the same frame
    become one cut, at the earliest of their times, so that every piece has at least one frame (R12).

    Raises:
        TimelineError: If no prompt lasts a frame, or the texts together are longer than `MOST_CHARACTERS`.

    Examples:
        >>> timeline = stmc.Timeline.parse("walk # 0 # 4 # legs\nwave # 1 # 3 # right arm")
        >>> [prompt.text for prompt in stmc.single_track(timeline, fps=20).prompts]
        ['walk', 'walk while wave', 'walk']
    """
    spans = timeline.spans(fps)
    seconds = _seconds_of_frames(timeline, spans)
    joined, characters = [], 0
    for start, end, active in elementary(spans):
        prompts = [timeline.prompts[index] for index in active]
        if prompts:
            text = " while ".join(prompt.text for prompt in prompts)
            characters += len(text)
            if characters > MOST_CHARACTERS:
                raise TimelineError(f"{timeline.place}: more than {MOST_CHARACTERS:,} characters as a single track")
            joined.append(Prompt(text, seconds[start], seconds[end], _union(prompts)))
    if not joined:
        raise TimelineError(f"no prompt lasts a frame at {fps:g} fps; make one longer than {1 / fps:g} seconds")
    return Timeline(joined, timeline.name)


def _seconds_of_frames(timeline: Timeline, spans: Iterable[tuple[int, int]]) -> dict[int, float]:
    earliest: dict[int, float] = {}
    for prompt, span in zip(timeline.prompts, spans, strict=True):
        for seconds, frame in zip((prompt.start, prompt.end), span, strict=True):
            earliest[frame] = min(seconds, earliest.get(frame, seconds))
    return earliest


def _union(prompts: Iterable[Prompt]) -> frozenset[BodyPart]:
    return frozenset().union(*(prompt.claims for prompt in prompts))
