"""JSON of timelines for the page, and their check before sampling, with the prompts of body parts over time.

This module knows timelines, plans and the recognition of prompts; it knows no motions.
"""

from __future__ import annotations

import warnings
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any

from stmc.model import Model
from stmc.motion.body import BodyPart
from stmc.run.suggestions import Suggest, with_suggestions
from stmc.text.vocabulary import Recognition, Suggestion
from stmc.timeline import Prompt, Timeline, TimelineError, TimelineWarning
from stmc.viewing.colours import owned_seconds
from stmc.viewing.studio.json_schemas import Schema
from stmc.viewing.studio.request_errors import RequestError, take, take_texts
from stmc.viewing.studio.responses import Advice, CheckedPrompt, CheckedTimeline, PromptData, TimelineData

MOST_SECONDS = 300
"""Maximum duration of a timeline in the studio: five minutes."""

MOST_PROMPTS = 200

MOST_LETTERS = 10_000
"""Maximum of the longest text's length times the number of texts, which a check embeds before it answers."""

MOST_FILE = 100_000
"""Maximum number of characters of a file of timelines."""

TIMELINE_FILES = {"json": Timeline.to_json, "txt": Timeline.to_text}
"""Kinds of files of timelines, and what writes them."""

PROMPT: Schema = {
    "type": "object",
    "required": ["text", "start", "end"],
    "properties": {
        "text": {"type": "string", "minLength": 1, "maxLength": MOST_LETTERS, "description": "the action"},
        "start": {"type": "number", "minimum": 0, "description": "start (s)"},
        "end": {"type": "number", "exclusiveMinimum": 0, "maximum": MOST_SECONDS, "description": "end (s)"},
        "parts": {
            "type": "array",
            "items": {"type": "string", "enum": list(BodyPart)},
            "description": "body parts that the text describes; none: likely ones are suggested",
        },
    },
}
"""JSON Schema of the prompts that `timeline_of` reads."""

TIMELINE: Schema = {
    "type": "object",
    "required": ["prompts"],
    "properties": {
        "name": {"type": "string", "description": "name of the timeline"},
        "prompts": {"type": "array", "minItems": 1, "maxItems": MOST_PROMPTS, "items": PROMPT},
    },
}
"""JSON Schema of the objects that `timeline_of` reads."""

TIMELINE_TEXT: Schema = {
    "type": "string",
    "maxLength": MOST_FILE,
    "description": "a prompt a line: text # start # end # body part # body part (seconds)",
}
"""JSON Schema of the texts that `timeline_of` reads."""


def timeline_of(data: Mapping[str, Any] | str) -> Timeline:
    """Read a timeline from JSON: an object, or a text. Raises `RequestError`, with the index of the invalid prompt."""
    if isinstance(data, str):
        timeline = _timeline_of_text(data)
    else:
        name, listed = take(data, "name", str, ""), take(data, "prompts", list)
        _check_prompts(listed)
        timeline = _timeline(name, tuple(_prompt(number, each) for number, each in enumerate(listed)))
    if timeline.duration > MOST_SECONDS:
        last = max(range(len(timeline.prompts)), key=lambda number: timeline.prompts[number].end)
        raise RequestError(422, f"{timeline.duration:g} s: {MOST_SECONDS} at most in the studio", prompt=last)
    return timeline


def _timeline_of_text(text: str) -> Timeline:
    try:
        _check_file(text)
        timeline = Timeline.parse(text)
    except TimelineError as error:
        raise RequestError(422, str(error), prompt=None) from None
    _check_prompts([{"text": prompt.text} for prompt in timeline.prompts])
    return timeline


def _check_prompts(listed: list[Any]) -> None:
    """Raise `RequestError` for too many prompts, or if their texts, padded to the longest, take too long to embed."""
    if len(listed) > MOST_PROMPTS:
        raise RequestError(422, f"{len(listed)} prompts: {MOST_PROMPTS} at most in the studio", prompt=None)
    texts = [entry.get("text") if isinstance(entry, dict) else None for entry in listed]
    lengths = [len(text) if isinstance(text, str) else 0 for text in texts]
    longest, different = max(lengths, default=0), len({text for text in texts if isinstance(text, str)})
    if different * longest > MOST_LETTERS:
        message = f"{different} texts of up to {longest} letters: shorten the longest to {MOST_LETTERS // different}"
        raise RequestError(422, message, prompt=lengths.index(longest))


def _prompt(number: int, data: Any) -> Prompt:
    try:
        if not isinstance(data, dict):
            raise RequestError(422, "a prompt should be an object")
        start, end = (take(data, each, (int, float)) for each in ("start", "end"))
        return Prompt(take(data, "text", str), start, end, take_texts(data, "parts"))
    except (TimelineError, RequestError, TypeError) as error:
        raise RequestError(422, f"prompt {number + 1}: {error}", prompt=number) from None


def _timeline(name: str, prompts: tuple[Prompt, ...]) -> Timeline:
    try:
        return Timeline(prompts, name=name)
    except TimelineError as error:
        raise RequestError(422, str(error), prompt=None) from None


def as_data(timeline: Timeline) -> TimelineData:
    """Return the JSON data that `timeline_of` reads."""
    prompts: list[PromptData] = [
        {"text": each.text, "start": each.start, "end": each.end, "parts": sort_parts(each.parts)}
        for each in timeline.prompts
    ]
    return {"name": timeline.name, "prompts": prompts}


def sort_parts(parts: Collection[BodyPart]) -> list[BodyPart]:
    """Return body parts as an ordered list for JSON."""
    return [part for part in BodyPart if part in parts]


def read_timelines(name: str, text: str) -> list[Timeline]:
    """Read the timelines of a file in the format of its `name`.

    Raises `TimelineError` for invalid timelines, and `RequestError` for a file that is too long.
    """
    _check_file(text)
    return Timeline.parse_all(text, Path(name).suffix)


def _check_file(text: str) -> None:
    if len(text) > MOST_FILE:
        raise RequestError(422, f"{len(text):,} letters: the studio reads files of {MOST_FILE:,} at most")


def write_timeline(timeline: Timeline, kind: str) -> str:
    """Write a timeline as the text of a file of a kind in `TIMELINE_FILES`.

    Raises `TimelineError` for a timeline that "txt" cannot represent.
    """
    return TIMELINE_FILES[kind](timeline)


def check_timeline(timeline: Timeline, model: Model, suggest: Suggest) -> CheckedTimeline:
    """Check a timeline before sampling. Raises `RequestError` if it cannot be planned.

    The result has the body parts, advice and row of each prompt, and for every body part its prompts and transitions
    over time, in seconds.

    Args:
        timeline: Timeline to check.
        model: Model to sample with.
        suggest: Function that suggests body parts.
    """
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", TimelineWarning)
        own = [prompt.parts for prompt in timeline.prompts]
        texts = list(dict.fromkeys(prompt.text for prompt in timeline.prompts))
        suggestions = dict(zip(texts, suggest(texts), strict=True))
        timeline, _ = with_suggestions(timeline, lambda some: [suggestions[text] for text in some])
        try:
            model.plans([timeline])
        except TimelineError as error:
            raise RequestError(422, str(error), prompt=None) from None
    recognitions = {each.text: each for each in model.recognise(texts)}
    restate_from = model.own_sampling.restate_from
    prompts = [
        _describe_prompt(prompt, row, suggestions[prompt.text], not listed, recognitions.get(prompt.text), restate_from)
        for prompt, row, listed in zip(timeline.prompts, timeline.rows, own, strict=True)
    ]
    owned = owned_seconds(timeline, model.fps, timeline.frames(model.fps), model.own_sampling.overlap or 0.0)
    return {
        "prompts": prompts,
        "rows": len(timeline.tracks),
        "duration": timeline.duration,
        "owners": owned["owners"],
        "transitions": owned["transitions"],
        "warnings": list(dict.fromkeys(str(each.message) for each in caught)),
    }


def _describe_prompt(
    prompt: Prompt,
    row: int,
    suggestion: Suggestion,
    suggested: bool,
    recognition: Recognition | None,
    restate_from: float | int | None,
) -> CheckedPrompt:
    doubt = None if recognition is None or recognition.works else recognition
    read = prompt.text if recognition is None else recognition.read_from(restate_from)
    return {
        "read_as": None if read == prompt.text else read,
        "parts": sort_parts(prompt.claims),
        "suggested": suggested,
        "confidence": suggestion.confidence if suggested else None,
        "needs": [] if doubt is not None and not doubt.known else sort_parts(suggestion.needs),
        "advice": _advice(doubt),
        "row": row,
    }


def _advice(recognition: Recognition | None) -> Advice | None:
    if recognition is None:
        return None
    near = [] if recognition.known else [sentence.text for sentence in recognition.near]
    return {"sentence": recognition.advice, "known": recognition.known, "nearest": near}
