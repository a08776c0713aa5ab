"""Timelines: `Prompt`, `Timeline`, their two file formats, and the baselines that are another timeline."""

from stmc.timeline.baselines import one_text, single_track
from stmc.timeline.files import TimelineError
from stmc.timeline.prompts import Prompt, Timeline, TimelineWarning, elementary, sinc_order

__all__ = [
    "Prompt",
    "Timeline",
    "TimelineError",
    "TimelineWarning",
    "elementary",
    "one_text",
    "sinc_order",
    "single_track",
]
