"""Timelines: `Prompt`, `Timeline`, their two file formats, and the baselines that are another timeline."""

from stmc.timeline.advice import TimelineWarning, UnknownPromptWarning, advise
from stmc.timeline.baselines import one_text, single_track
from stmc.timeline.files import TimelineError
from stmc.timeline.prompts import Prompt, Timeline

__all__ = [
    "Prompt",
    "Timeline",
    "TimelineError",
    "TimelineWarning",
    "UnknownPromptWarning",
    "advise",
    "one_text",
    "single_track",
]
