"""Timelines as the page has them, and what it shows of them before anything is sampled: who owns which body part when.

Knows timelines, plans and what a model recognises; knows no motions.
"""

from __future__ import annotations

import warnings
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any

from stmc.io.untrusted import shown
from stmc.model import Model
from stmc.motion.body import BodyPart
from stmc.run.suggestions import Suggest, with_suggestions
from stmc.text.vocabulary import Recognition, Suggestion
from stmc.timeline import Prompt, Timeline, TimelineError, TimelineWarning
from stmc.viewing.colours import owned_seconds
from stmc.viewing.studio.refusals import Refused, take, take_texts

MOST_SECONDS = 300
"""Of a timeline in the studio: five minutes."""

MOST_PROMPTS = 200

MOST_LETTERS = 10_000
"""The letters of the longest text, times the number of texts: as many are embedded before a check is answered."""

MOST_FILE = 100_000
"""Letters of a timelines' file."""


def timeline_of(data: Mapping[str, Any]) -> Timeline:
    """The timeline of a page's JSON. Raises `Refused`, with the number of the prompt that is wrong, from 0."""
    name, listed = take(data, "name", str, ""), take(data, "prompts", list)
    if len(listed) > MOST_PROMPTS:
        raise Refused(422, f"{len(listed)} prompts: {MOST_PROMPTS} at most in the studio", prompt=None)
    _check_letters(listed)
    timeline = _timeline(name, tuple(_prompt(number, each) for number, each in enumerate(listed)))
    if timeline.duration > MOST_SECONDS:
        last = max(range(len(listed)), key=lambda number: timeline.prompts[number].end)
        raise Refused(422, f"{timeline.duration:g} s: {MOST_SECONDS} at most in the studio", prompt=last)
    return timeline


def _check_letters(listed: list[Any]) -> None:
    """Raise `Refused` for more text than is embedded while somebody waits: texts are padded to the longest one."""
    texts = [entry.get("text") if isinstance(entry, dict) else None for entry in listed]
    lengths = [len(text) if isinstance(text, str) else 0 for text in texts]
    longest, different = max(lengths, default=0), len({text for text in texts if isinstance(text, str)})
    if different * longest > MOST_LETTERS:
        message = f"{different} texts of up to {longest} letters: shorten the longest to {MOST_LETTERS // different}"
        raise Refused(422, message, prompt=lengths.index(longest))


def _prompt(number: int, data: Any) -> Prompt:
    try:
        if not isinstance(data, dict):
            raise Refused(422, "a prompt should be an object")
        start, end = (take(data, each, (int, float)) for each in ("start", "end"))
        return Prompt(take(data, "text", str), start, end, take_texts(data, "parts"))
    except (TimelineError, Refused, TypeError) as error:
        raise Refused(422, f"prompt {number + 1}: {error}", prompt=number) from None


def _timeline(name: str, prompts: tuple[Prompt, ...]) -> Timeline:
    try:
        return Timeline(prompts, name=name)
    except TimelineError as error:
        raise Refused(422, str(error), prompt=None) from None


def as_data(timeline: Timeline) -> dict[str, Any]:
    """The JSON that `timeline_of` reads."""
    prompts = [
        {"text": each.text, "start": each.start, "end": each.end, "parts": in_order(each.parts)}
        for each in timeline.prompts
    ]
    return {"name": timeline.name, "prompts": prompts}


def in_order(parts: Collection[BodyPart]) -> list[BodyPart]:
    """Body parts as a list that JSON takes."""
    return [part for part in BodyPart if part in parts]


def read_timelines(name: str, text: str) -> list[Timeline]:
    """The timelines of a file that the page has read; its `name` says which format. Raises `TimelineError`, and
    `Refused` for a longer file than is read while somebody waits."""
    if len(text) > MOST_FILE:
        raise Refused(422, f"{len(text):,} letters: the studio reads files of {MOST_FILE:,} at most")
    return Timeline.parse_all(text, Path(name).suffix)


def write_timeline(timeline: Timeline, kind: str) -> str:
    """What a timeline's file holds, "json" or "txt". Raises `Refused` for another kind, `TimelineError` for what a text
    cannot hold."""
    forms = {"json": Timeline.to_json, "txt": Timeline.to_text}
    if kind not in forms:
        raise Refused(422, f"format={shown(kind)}: choose from {', '.join(forms)}")
    return forms[kind](timeline)


def checked(timeline: Timeline, model: Model, suggest: Suggest) -> dict[str, Any]:
    """What the page shows of a timeline before it is sampled. Raises `Refused` for what cannot be planned.

    The prompts' body parts, which ones the model hardly knows or rarely shows, the rows they lie in, and for every body
    part who owns it when, with the transitions between (seconds).
    """
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", TimelineWarning)
        own = [prompt.parts for prompt in timeline.prompts]
        timeline, suggested = with_suggestions(timeline, suggest)
        try:
            model.plans([timeline])
        except TimelineError as error:
            raise Refused(422, str(error), prompt=None) from None
    doubtful = {each.text: each for each in model.doubtful([timeline])}
    prompts = [
        _described(prompt, row, None if listed else suggested[prompt.text], doubtful.get(prompt.text))
        for prompt, row, listed in zip(timeline.prompts, timeline.rows, own, strict=True)
    ]
    return {
        "prompts": prompts,
        "rows": len(timeline.tracks),
        "duration": timeline.duration,
        **owned_seconds(timeline, model.fps, timeline.frames(model.fps), model.own_sampling.overlap or 0.0),
        "warnings": list(dict.fromkeys(str(each.message) for each in caught)),
    }


def _described(prompt: Prompt, row: int, suggestion: Suggestion | None, doubt: Recognition | None) -> dict[str, Any]:
    return {
        "parts": in_order(prompt.claims),
        "suggested": suggestion is not None,
        "confidence": None if suggestion is None else suggestion.confidence,
        "advice": _advice(doubt),
        "row": row,
    }


def _advice(recognition: Recognition | None) -> dict[str, Any] | None:
    if recognition is None:
        return None
    near = [] if recognition.known else [sentence.text for sentence in recognition.near]
    return {"sentence": recognition.advice, "known": recognition.known, "nearest": near}
