"""Body parts suggested for prompts by the sentences that the bundled model was trained with.

Only the model's vocabulary is read, and MiniLM, which sentences are compared with.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cache

from stmc.body import BodyPart
from stmc.run.directories import VOCABULARY, bundled
from stmc.text import TextEncoder
from stmc.timeline import Timeline
from stmc.vocabulary import Suggestion, Vocabulary, read_vocabulary, sentence_encoder, suggest


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
    return suggest([text], *_examples())[0]


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
    texts = list(dict.fromkeys(prompt.text for prompt in timeline.prompts if not prompt.parts))
    if not texts:
        return timeline
    parts = {text: each.parts for text, each in zip(texts, suggest(texts, *_examples()), strict=True)}
    return replace(
        timeline,
        prompts=tuple(
            prompt if prompt.parts or parts[prompt.text] == frozenset(BodyPart)
            else replace(prompt, parts=parts[prompt.text])
            for prompt in timeline.prompts
        ),
    )  # fmt: skip


@cache
def _examples() -> tuple[Vocabulary, TextEncoder]:
    return read_vocabulary(bundled() / VOCABULARY), sentence_encoder()
