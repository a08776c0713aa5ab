"""How a model reads timelines, by its vocabulary: in its own words, and with actions that happen once.

Depends on timelines and the recognition of prompts; independent of plans and networks.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

from stmc.text.vocabulary import Recogniser
from stmc.timeline import Timeline


def in_own_words(
    timelines: Sequence[Timeline], recogniser: Recogniser, confidence: float | int | None
) -> tuple[Timeline, ...]:
    """Replace prompts by the first training sentence of their action, where its probability is at least `confidence`.

    A small network shows these sentences best. Prompts that say more than an action in plain words stay, as do unknown
    ones; with a `confidence` of 1 or None, all do.
    """
    if confidence is None or confidence >= 1:
        return tuple(timelines)
    texts = [prompt.text for timeline in timelines for prompt in timeline.prompts]
    words = {each.text: each.read_from(confidence) for each in recogniser(texts)}
    return tuple(_with_texts(timeline, words) for timeline in timelines)


def _with_texts(timeline: Timeline, words: Mapping[str, str]) -> Timeline:
    prompts = tuple(replace(prompt, text=words.get(prompt.text, prompt.text)) for prompt in timeline.prompts)
    return timeline if prompts == timeline.prompts else replace(timeline, prompts=prompts)


def one_shot_texts(timelines: Sequence[Timeline], recogniser: Recogniser, longest: float) -> frozenset[str]:
    """Find texts that describe a one-shot action, in prompts of more than `longest` seconds."""
    prompts = (prompt for timeline in timelines for prompt in timeline.prompts)
    long = [prompt.text for prompt in prompts if prompt.end - prompt.start > longest]
    return frozenset(recognition.text for recognition in recogniser(long) if recognition.happens_once)
