"""Embeddings on disk: each text is encoded once. Knows files; see `protocol` for what an encoder is."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from pathlib import Path

import torch
from jaxtyping import Float, Int
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor

from stmc.files import write_whole
from stmc.tensors import pad
from stmc.text.protocol import TextEncoder, check

AT_ONCE = 512
"""Texts encoded between two visits to the disk: what a kill can lose."""


class Cached:
    """Another encoder, with every text's words kept in `folder`, one file a text, so that each is encoded once.

    Safe with several processes on one folder: a file appears under its name only when it is complete. A file that is
    damaged or belongs to another text or encoder is made anew. The weights are loaded only if a text is missing.
    """

    def __init__(self, encoder: TextEncoder, folder: str | Path) -> None:
        self.encoder, self.folder = encoder, Path(folder).expanduser()

    @property
    def name(self) -> str:
        """The encoder's."""
        return self.encoder.name

    @property
    def width(self) -> int:
        """The encoder's."""
        return self.encoder.width

    def encode(self, texts: Sequence[str]) -> tuple[Float[Tensor, "batch words width"], Int[Tensor, " batch"]]:
        """See `TextEncoder`; always on the CPU."""
        check(texts)
        words = {text: self._read(text) for text in dict.fromkeys(texts)}
        missing = [text for text, found in words.items() if found is None]
        for start in range(0, len(missing), AT_ONCE):
            chunk = missing[start : start + AT_ONCE]
            for text, row, length in zip(chunk, *self.encoder.encode(chunk), strict=True):
                words[text] = row[:length].cpu().contiguous()
                self._write(text, words[text])
        return pad([words[text] for text in texts])

    def file(self, text: str) -> Path:
        """Where the words of `text` are kept."""
        key = hashlib.sha256(f"{self.name}\0{text}".encode()).hexdigest()
        return self.folder / key[:2] / f"{key[2:]}.safetensors"

    def _read(self, text: str) -> Float[Tensor, "words width"] | None:
        try:
            with safe_open(self.file(text), "pt") as file:
                words, label = file.get_tensor("words"), file.metadata()
        except (FileNotFoundError, SafetensorError):
            return None
        return words if label == self._label(text, words) and words.shape[-1] == self.width else None

    def _write(self, text: str, words: Float[Tensor, "words width"]) -> None:
        label = self._label(text, words)
        write_whole(self.file(text), lambda path: save_file({"words": words}, path, label))

    def _label(self, text: str, words: Tensor) -> dict[str, str]:
        # safetensors notices a file cut short, but not a flipped bit within the numbers.
        digest = hashlib.sha256(words.contiguous().view(torch.uint8).numpy().tobytes()).hexdigest()
        return {"encoder": self.name, "text": text, "sha256": digest}
