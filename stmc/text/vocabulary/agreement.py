"""Agreement of a vocabulary's sentences with the side, the direction and the speed in a prompt.

Depends on sentences and their words; independent of embeddings.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from jaxtyping import Bool
from torch import Tensor

from stmc.text.vocabulary.qualifiers import Qualifiers, agree, mirrored, read_qualifiers, without_defaults
from stmc.text.vocabulary.sentences import Sentence


class Agreement:
    """The qualifiers of `sentences`, read once for all prompts."""

    def __init__(self, sentences: Sequence[Sentence]) -> None:
        qualifiers = [frozenset(read_qualifiers(sentence.text).items()) for sentence in sentences]
        indices = {item: index for index, item in enumerate(dict.fromkeys(qualifiers))}
        names = {sentence.content.name for sentence in sentences}
        self._distinct = [dict(item) for item in indices]
        self._indices = torch.tensor([indices[item] for item in qualifiers])
        self._mirrored = torch.tensor([_has_mirror_image(sentence.content.name, names) for sentence in sentences])

    def of(self, text: str) -> tuple[Bool[Tensor, " sentences"], Bool[Tensor, " sentences"]]:
        """Find the sentences that agree with a text's qualifiers, and those that contradict them.

        A sentence about the other side does neither if the mirrored action is in the vocabulary as well, since the
        mirror image of the sentence may have been dropped.
        """
        requested = read_qualifiers(text)
        other_side = self._agree(read_qualifiers(mirrored(text))) & self._mirrored
        return self._agree(requested), ~self._agree(without_defaults(requested)) & ~other_side

    def _agree(self, requested: Qualifiers) -> Bool[Tensor, " sentences"]:
        return torch.tensor([agree(requested, present) for present in self._distinct])[self._indices]


def _has_mirror_image(name: str, names: set[str]) -> bool:
    """Tell whether an action has a separate mirror image; data without action names are mirrored as a whole."""
    return not name or (mirrored(name) != name and mirrored(name) in names)
