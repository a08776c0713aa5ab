"""Timelines: `Prompt`, `Timeline`, their two file formats, and the baselines that transform a timeline."""

from stmc.timeline.advice import (
    PromptWarning,
    RarelyShownWarning,
    TimelineWarning,
    UnknownPromptWarning,
    advise,
    advise_prompt,
)
from stmc.timeline.baseline_timelines import one_text, single_track
from stmc.timeline.live_timeline import LiveTimeline
from stmc.timeline.prompts import Prompt, Timeline
from stmc.timeline.timeline_files import TimelineError

__all__ = [
    "LiveTimeline",
    "Prompt",
    "PromptWarning",
    "RarelyShownWarning",
    "Timeline",
    "TimelineError",
    "TimelineWarning",
    "UnknownPromptWarning",
    "advise",
    "advise_prompt",
    "one_text",
    "single_track",
]
