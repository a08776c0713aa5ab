"""Captions for the evaluator of Guo et al. (2022): a GloVe vector and a part of speech for each word.

Depends on HumanML3D's tagged captions and the folder of vectors published with the evaluator; independent of networks.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType

import torch
from jaxtyping import Float, Int
from torch import Tensor

from stmc.io.arrays import ArraysError, read_npy, read_places

MOST_WORDS = 20
"""Maximum number of words of a caption, without the start and end that are added; the rest is ignored."""

PARTS_OF_SPEECH = (
    "VERB", "NOUN", "DET", "ADP", "NUM", "AUX", "PRON", "ADJ", "ADV",
    "Loc_VIP", "Body_VIP", "Obj_VIP", "Act_VIP", "Desc_VIP", "OTHER",
)  # fmt: skip
"""Parts of speech in the order of their one-hot indices; the last one covers all others."""

_SPECIAL: Mapping[str, str] = MappingProxyType({
    "Loc_VIP": "left right clockwise counterclockwise anticlockwise forward back backward up down straight curve",
    "Body_VIP": "arm chin foot feet face hand mouth leg waist eye knee shoulder thigh",
    "Obj_VIP": "stair dumbbell chair window floor car ball handrail baseball basketball",
    "Act_VIP": "walk run swing pick bring kick put squat throw hop dance jump turn stumble stop sit lift lower raise "
    "wash stand kneel stroll rub bend balance flap jog shuffle lean rotate spin spread climb",
    "Desc_VIP": "slowly carefully fast careful slow quickly happy angry sad happily angrily sadly",
})  # fmt: skip
_SPECIAL_OF = {word: kind for kind, words in _SPECIAL.items() for word in words.split()}
"""Words with a fixed part of speech, whatever the tagger says."""


@dataclass(frozen=True, eq=False)
class Glove:
    """Word vectors, and the index of each word's vector in `places`; a missing word is "unk"."""

    vectors: Float[Tensor, "words width"]
    places: Mapping[str, int]

    def __post_init__(self) -> None:
        if missing := [word for word in ("sos", "eos", "unk") if word not in self.places]:
            raise ArraysError(f"the word vectors lack {', '.join(missing)}: they are not those of the evaluator")
        if not 0 <= min(self.places.values()) <= max(self.places.values()) < len(self.vectors):
            raise ArraysError(f"words have places beyond the {len(self.vectors)} vectors")

    @classmethod
    def read(cls, folder: str | Path) -> Glove:
        """Read the published folder `glove/` with `our_vab_data.npy` and `our_vab_idx.pkl`.

        `our_vab_words.pkl` is redundant and is not read. Raises `ArraysError` if a file is missing or damaged; no
        pickle is executed.
        """
        vectors, places = (Path(folder).expanduser() / f"our_vab_{name}" for name in ("data.npy", "idx.pkl"))
        if absent := [path.name for path in (vectors, places) if not path.is_file()]:
            raise ArraysError(f"{folder} has no {' and no '.join(absent)}: it is not the evaluator's glove folder")
        array = read_npy(vectors)
        if array.ndim != 2 or array.dtype.kind != "f":
            raise ArraysError(f"{vectors} must hold a vector for each word, not {array.dtype} of shape {array.shape}")
        return cls(torch.from_numpy(array).float(), read_places(places))

    def encode(
        self, tagged: Sequence[str]
    ) -> tuple[Float[Tensor, "batch words width"], Float[Tensor, "batch words kinds"], Int[Tensor, " batch"]]:
        """Encode captions in HumanML3D's form (`a/DET person/NOUN walk/VERB`).

        Words after the end of a caption are "unk".

        Returns:
            The word vectors [batch, words, width], the one-hot parts of speech [batch, words, kinds], and the number of
                words of each caption [batch], including start and end.
        """
        rows = [["sos/OTHER", *caption.split()[:MOST_WORDS], "eos/OTHER"] for caption in tagged]
        lengths = torch.tensor([len(row) for row in rows])
        rows = [[*row, *["unk/OTHER"] * (MOST_WORDS + 2 - len(row))] for row in rows]
        indices = [[self._look_up(word) for word in row] for row in rows]
        places = torch.tensor([[place for place, _ in row] for row in indices])
        kinds = torch.tensor([[kind for _, kind in row] for row in indices])
        return self.vectors[places], torch.nn.functional.one_hot(kinds, len(PARTS_OF_SPEECH)).float(), lengths

    def _look_up(self, token: str) -> tuple[int, int]:
        """Return the index of the vector and of the part of speech of a tagged word."""
        word, _, tag = token.rpartition("/")
        kind = _SPECIAL_OF.get(word, tag) if word in self.places else "OTHER"
        number = PARTS_OF_SPEECH.index(kind if kind in PARTS_OF_SPEECH else "OTHER")
        return self.places.get(word, self.places["unk"]), number
