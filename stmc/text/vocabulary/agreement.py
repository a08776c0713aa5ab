"""Which of a vocabulary's sentences name the side, the direction and the speed that a prompt asks for.

Knows sentences and their words; knows no embeddings.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from jaxtyping import Bool
from torch import Tensor

from stmc.text.vocabulary.qualifiers import Qualifiers, agree, mirrored, read_qualifiers, without_defaults
from stmc.text.vocabulary.sentences import Sentence


class Agreement:
    """The words of `sentences`, read once for all prompts."""

    def __init__(self, sentences: Sequence[Sentence]) -> None:
        words = [frozenset(read_qualifiers(sentence.text).items()) for sentence in sentences]
        places = {each: place for place, each in enumerate(dict.fromkeys(words))}
        names = {sentence.content.name for sentence in sentences}
        self._distinct = [dict(each) for each in places]
        self._places = torch.tensor([places[each] for each in words])
        self._mirrored = torch.tensor([_mirror_image_among(sentence.content.name, names) for sentence in sentences])

    def of(self, text: str) -> tuple[Bool[Tensor, " sentences"], Bool[Tensor, " sentences"]]:
        """Find the sentences that agree with a text's words, and those that contradict them.

        A sentence about the other side does neither, where the action of its mirror image is known as well: its own
        mirror image may be a sentence that was not kept.
        """
        asked = read_qualifiers(text)
        others_side = self._agree(read_qualifiers(mirrored(text))) & self._mirrored
        return self._agree(asked), ~self._agree(without_defaults(asked)) & ~others_side

    def _agree(self, asked: Qualifiers) -> Bool[Tensor, " sentences"]:
        return torch.tensor([agree(asked, known) for known in self._distinct])[self._places]


def _mirror_image_among(name: str, names: set[str]) -> bool:
    """Whether an action has a mirror image of its own; data without names of actions are mirrored as a whole."""
    return not name or (mirrored(name) != name and mirrored(name) in names)
