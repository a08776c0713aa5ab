"""Suggested body parts for prompts, from the sentences that the bundled model was trained with.

Only the model's vocabulary is read, and MiniLM, which compares sentences.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache, partial

from stmc.motion.body import BodyPart
from stmc.run.directories import bundled
from stmc.run.model_vocabulary import VOCABULARY
from stmc.text import TextEncoder
from stmc.text.vocabulary import Suggestion, read_vocabulary, sentence_encoder, suggest
from stmc.timeline import Timeline

Suggest = Callable[[Sequence[str]], Sequence[Suggestion]]
"""Texts → the body parts that each text probably describes."""


def suggest_parts(text: str) -> Suggestion:
    """Suggest the body parts that a prompt describes, with a confidence.

    The suggestion is a starting point: 44 of MTT's 60 atomic prompts, which influenced no choice, get exactly their
    parts.

    Examples:
        >>> suggestion = stmc.suggest_parts("wave with the left hand")
        >>> sorted(suggestion.parts)
        [<BodyPart.LEFT_ARM: 'left arm'>]
        >>> sorted(stmc.suggest_parts("walk backwards").parts)
        [<BodyPart.LEGS: 'legs'>]
    """
    return _bundled_suggest()([text])[0]


def with_suggested_parts(timeline: Timeline) -> Timeline:
    r"""Add suggested body parts to every prompt that lists none; other prompts stay unchanged.

    Prompts about the whole body still list none, and so yield to prompts that list some.

    Examples:
        >>> timeline = stmc.Timeline.parse("walk forwards # 0 # 4\nwave with the right hand # 1 # 3")
        >>> for prompt in stmc.with_suggested_parts(timeline).prompts:
        ...     print(prompt.text, *prompt.parts)
        walk forwards legs
        wave with the right hand right arm
    """
    return with_suggestions(timeline, _bundled_suggest())[0]


def with_suggestions(timeline: Timeline, suggest: Suggest) -> tuple[Timeline, dict[str, Suggestion]]:
    """Add suggested body parts with any `Suggest` function; also return the suggestion for each text without parts."""
    texts = list(dict.fromkeys(prompt.text for prompt in timeline.prompts if not prompt.parts))
    suggestions = dict(zip(texts, suggest(texts), strict=True)) if texts else {}
    prompts = tuple(
        prompt
        if prompt.parts or suggestions[prompt.text].parts == frozenset(BodyPart)
        else replace(prompt, parts=suggestions[prompt.text].parts)
        for prompt in timeline.prompts
    )
    return (replace(timeline, prompts=prompts) if texts else timeline), suggestions


def suggester(encoder: TextEncoder) -> Suggest:
    """Create a `Suggest` function that compares texts, encoded by `encoder`, with the bundled model's sentences."""
    return partial(suggest, examples=read_vocabulary(bundled() / VOCABULARY), encoder=encoder)


@cache
def _bundled_suggest() -> Suggest:
    return suggester(sentence_encoder())
