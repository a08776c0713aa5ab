"""Body parts suggested for prompts by the sentences that the bundled model was trained with.

Only the model's vocabulary is read, and MiniLM, which sentences are compared with.
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
"""Texts → what body parts each seems to be about."""


def suggest_parts(text: str) -> Suggestion:
    """The body parts that a prompt seems to be about, and how sure that is.

    A guess to start from: of MTT's 60 atomic prompts, which nothing was chosen by, 44 are given exactly their parts.

    Examples:
        >>> suggestion = stmc.suggest_parts("wave with the left hand")
        >>> sorted(suggestion.parts)
        [<BodyPart.LEFT_ARM: 'left arm'>]
        >>> sorted(stmc.suggest_parts("walk backwards").parts)
        [<BodyPart.LEGS: 'legs'>]
    """
    return _own()([text])[0]


def with_suggested_parts(timeline: Timeline) -> Timeline:
    """The timeline with suggested body parts for every prompt that lists none; the others stay as they are.

    Whatever concerns the whole body goes on listing none, and so yields to prompts that list some.

    Examples:
        >>> timeline = stmc.Timeline.parse("walk forwards # 0 # 4\\nwave with the right hand # 1 # 3")
        >>> for prompt in stmc.with_suggested_parts(timeline).prompts:
        ...     print(prompt.text, *prompt.parts)
        walk forwards legs
        wave with the right hand right arm
    """
    return with_suggestions(timeline, _own())[0]


def with_suggestions(timeline: Timeline, suggest: Suggest) -> tuple[Timeline, dict[str, Suggestion]]:
    """The same with any suggestions, and what was suggested for each text that lists no body parts."""
    texts = list(dict.fromkeys(prompt.text for prompt in timeline.prompts if not prompt.parts))
    found = dict(zip(texts, suggest(texts), strict=True)) if texts else {}
    prompts = tuple(
        prompt
        if prompt.parts or found[prompt.text].parts == frozenset(BodyPart)
        else replace(prompt, parts=found[prompt.text].parts)
        for prompt in timeline.prompts
    )
    return (replace(timeline, prompts=prompts) if texts else timeline), found


def suggester(encoder: TextEncoder) -> Suggest:
    """Suggestions by the bundled model's sentences, compared with what `encoder` makes of the texts."""
    return partial(suggest, examples=read_vocabulary(bundled() / VOCABULARY), encoder=encoder)


@cache
def _own() -> Suggest:
    return suggester(sentence_encoder())
