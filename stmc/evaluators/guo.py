"""The motion and text feature extractors of Guo et al. (2022), the evaluator of most published tables.

They define R-precision, matching score, FID, diversity and multimodality there. Parameter names and shapes are those of
`text_mot_match/model/finest.tar`. Independent of the computation of features, word vectors, files (see `published`) and
metrics.
"""

from __future__ import annotations

import torch
from einops import rearrange, repeat
from jaxtyping import Float, Int
from torch import Tensor, nn
from torch.nn.utils.rnn import pack_padded_sequence

STRIDE = 4
"""Number of frames that become one movement."""


class MovementEncoder(nn.Module):
    """Two convolutions over time: four frames of `features` numbers become one movement of `width` numbers."""

    def __init__(self, features: int, hidden: int = 512, width: int = 512) -> None:
        super().__init__()
        self.main = nn.Sequential(
            nn.Conv1d(features, hidden, 4, 2, 1),
            nn.Dropout(0.2),
            nn.LeakyReLU(0.2),
            nn.Conv1d(hidden, width, 4, 2, 1),
            nn.Dropout(0.2),
            nn.LeakyReLU(0.2),
        )
        self.out_net = nn.Linear(width, width)

    def forward(self, motion: Float[Tensor, "batch frames features"]) -> Float[Tensor, "batch movements width"]:
        movements = self.main(rearrange(motion, "batch frames features -> batch features frames"))
        return self.out_net(rearrange(movements, "batch width movements -> batch movements width"))


class _RecurrentReader(nn.Module):
    """A bidirectional recurrent network; its two last states become one vector."""

    def __init__(self, features: int, hidden: int, width: int = 512) -> None:
        super().__init__()
        self.input_emb = nn.Linear(features, hidden)
        self.gru = nn.GRU(hidden, hidden, batch_first=True, bidirectional=True)
        self.output_net = nn.Sequential(
            nn.Linear(2 * hidden, hidden), nn.LayerNorm(hidden), nn.LeakyReLU(0.2), nn.Linear(hidden, width)
        )
        self.hidden = nn.Parameter(torch.randn(2, 1, hidden))

    def read(
        self, sequence: Float[Tensor, "batch words features"], lengths: Int[Tensor, " batch"]
    ) -> Float[Tensor, "batch width"]:
        """Return the vector of each padded sequence."""
        start = repeat(self.hidden, "ends 1 hidden -> ends batch hidden", batch=len(sequence)).contiguous()
        packed = pack_padded_sequence(self.input_emb(sequence), lengths.cpu(), batch_first=True, enforce_sorted=False)
        _, last = self.gru(packed, start)
        return self.output_net(rearrange(last, "ends batch hidden -> batch (ends hidden)"))


class SequenceReader(_RecurrentReader):
    """A recurrent reader of padded sequences of the given lengths."""

    def forward(
        self, sequence: Float[Tensor, "batch words features"], lengths: Int[Tensor, " batch"]
    ) -> Float[Tensor, "batch width"]:
        return self.read(sequence, lengths)


class TextReader(_RecurrentReader):
    """A recurrent reader of word vectors, with an embedding of the part of speech (one-hot) added to each."""

    def __init__(self, words: int = 300, parts_of_speech: int = 15, hidden: int = 512, width: int = 512) -> None:
        super().__init__(words, hidden, width)
        self.pos_emb = nn.Linear(parts_of_speech, words)

    def forward(
        self,
        words: Float[Tensor, "batch words width"],
        parts_of_speech: Float[Tensor, "batch words kinds"],
        lengths: Int[Tensor, " batch"],
    ) -> Float[Tensor, "batch _"]:
        return self.read(words + self.pos_emb(parts_of_speech), lengths)


class GuoEvaluator(nn.Module):
    """The three networks together; a caption and its motion are close in Euclidean distance.

    Features must be normalised with the evaluator's own mean and standard deviation. Rows are returned in the order of
    the input (the published wrapper sorts them by length).

    Args:
        seen: Number of leading features that are used: of HumanML3D's 263 all but the contacts, of BABEL's 135 all.
        movements: Hidden and output width of the movement encoder.
        motion_hidden: Hidden width of the motion encoder.
        words: Width of a word vector.
        text_hidden: Hidden width of the text encoder.
        width: Width of the embeddings.
    """

    def __init__(
        self,
        seen: int = 259,
        movements: tuple[int, int] = (512, 512),
        motion_hidden: int = 1024,
        words: int = 300,
        text_hidden: int = 512,
        width: int = 512,
    ) -> None:
        super().__init__()
        self.seen = seen
        self.movement_encoder = MovementEncoder(seen, *movements)
        self.text_encoder = TextReader(words, hidden=text_hidden, width=width)
        self.motion_encoder = SequenceReader(movements[1], motion_hidden, width)

    def motions(
        self, motion: Float[Tensor, "batch frames features"], lengths: Int[Tensor, " batch"]
    ) -> Float[Tensor, "batch width"]:
        """Embed normalised motions of the given lengths, at least four frames each.

        The padding has a small influence: the convolutions see up to three frames after the end. Raises `ValueError` if
        a motion is too short.
        """
        if int(lengths.min()) < STRIDE:
            raise ValueError(f"a motion of {int(lengths.min())} frames is too short: the evaluator needs {STRIDE}")
        return self.motion_encoder(self.movement_encoder(motion[..., : self.seen]), lengths // STRIDE)

    def texts(
        self,
        words: Float[Tensor, "batch words width"],
        parts_of_speech: Float[Tensor, "batch words kinds"],
        lengths: Int[Tensor, " batch"],
    ) -> Float[Tensor, "batch _"]:
        """Embed captions with the given numbers of tokens, including start and end.

        Args:
            words: Word vectors, [batch, words, width].
            parts_of_speech: One-hot parts of speech, [batch, words, kinds].
            lengths: Number of tokens of each caption, [batch].
        """
        return self.text_encoder(words, parts_of_speech, lengths)
