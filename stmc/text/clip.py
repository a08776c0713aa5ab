"""CLIP's texts in the three ways that published motion models read them."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from typing import Any, Literal

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor, nn

from stmc.text.pretrained import check_width, encode, load, transformers

CLIP = "openai/clip-vit-base-patch32"
REMEDY = f"hf download {CLIP}"


class Clip:
    """CLIP's text features, one word of `width` numbers a text: projected into the space shared with images, not
    normalised; what STMC (appendix D) and MDM are conditioned on.

    `source` is a folder or a hub name; ViT-B/32, the default, has width 512. Of a text only the first `tokens` count,
    its start and end among them; None: as many as CLIP has positions, 77. MDM reads 22 (of its captions the longer ones
    are cut) from weights in half precision: `weights` "fp16" rounds all but the norms' to it. The arithmetic is in
    float32 all the same, so that every device gives the same numbers.

    STMC's authors encoded with OpenAI's `clip` on a GPU, which has weights and arithmetic in half precision: their
    embeddings differ from those of "fp32" as much as half precision can tell, from those of "fp16" by the arithmetic.
    """

    def __init__(
        self,
        source: str = CLIP,
        width: int = 512,
        tokens: int | None = None,
        weights: Literal["fp32", "fp16"] = "fp32",
        device: str = "cpu",
        batch: int = 256,
    ) -> None:
        if weights not in ("fp32", "fp16"):
            raise ValueError(f"unknown weights {weights!r}; choose from fp32, fp16")
        if tokens is not None and tokens < 2:
            raise ValueError(f"tokens={tokens}: a text has at least its start and its end")
        self.source, self.width, self.tokens, self.weights = source, width, tokens, weights
        self.device, self.batch = device, batch

    @property
    def name(self) -> str:
        """The source of the weights, and what is done with them but for the defaults."""
        cut = "" if self.tokens is None else f" {self.tokens} tokens"
        return f"{self.source}{cut}{'' if self.weights == 'fp32' else ' fp16'}"

    def encode(self, texts: Sequence[str]) -> tuple[Float[Tensor, "batch words width"], Int[Tensor, " batch"]]:
        """See `TextEncoder`; on the encoder's device. Raises `WeightsNotFound`."""
        tokenizer, model = self._loaded
        limit = min(self.tokens or model.config.max_position_embeddings, model.config.max_position_embeddings)
        return encode(texts, tokenizer, limit, self._words, self.batch, model.device)

    def _words(self, tokens: Int[Tensor, "batch _"]) -> Float[Tensor, "batch words width"]:
        return self._loaded[1](input_ids=tokens).text_embeds[:, None]

    @cached_property
    def _loaded(self) -> tuple[Any, torch.nn.Module]:
        CLIPTextModelWithProjection = transformers().CLIPTextModelWithProjection

        tokenizer, model = load(self.source, CLIPTextModelWithProjection.from_pretrained, self.device, REMEDY)
        check_width(self.source, model.config.projection_dim, self.width)
        if self.weights == "fp16":
            _round(model)
        return tokenizer, model


class ClipTokens:
    """CLIP's features at each of its positions, before the projection: what MotionDiffuse reads.

    A text has as many words as CLIP has positions (77): behind its end it is filled up with token 0, as CLIP's own
    tokenizer does, and the features there count too. The word at the text's end comes first, since it stands for the
    whole; the others follow in their order. `source` is a folder or a hub name; ViT-B/32, the default, has width 512.
    """

    def __init__(self, source: str = CLIP, width: int = 512, device: str = "cpu", batch: int = 256) -> None:
        self.source, self.width, self.device, self.batch = source, width, device, batch

    @property
    def name(self) -> str:
        """The source of the weights."""
        return f"{self.source} positions"

    def encode(self, texts: Sequence[str]) -> tuple[Float[Tensor, "batch words width"], Int[Tensor, " batch"]]:
        """See `TextEncoder`; on the encoder's device. Raises `WeightsNotFound`."""
        tokenizer, model = self._loaded
        limit = model.config.max_position_embeddings
        return encode(texts, tokenizer, limit, self._words, self.batch, model.device)

    def _words(self, tokens: Int[Tensor, "batch _"]) -> Float[Tensor, "batch words width"]:
        model, end = self._loaded[1], tokens.shape[1] - 1
        filled = F.pad(tokens, (0, model.config.max_position_embeddings - tokens.shape[1]))
        features = model(input_ids=filled).last_hidden_state
        return torch.cat([features[:, end : end + 1], features[:, :end], features[:, end + 1 :]], dim=1)

    @cached_property
    def _loaded(self) -> tuple[Any, torch.nn.Module]:
        CLIPTextModel = transformers().CLIPTextModel

        tokenizer, model = load(self.source, CLIPTextModel.from_pretrained, self.device, REMEDY)
        check_width(self.source, model.config.hidden_size, self.width)
        return tokenizer, model


@torch.no_grad()
def _round(model: nn.Module) -> None:
    """All weights but those of norms to the nearest number that half precision has."""
    for module in model.modules():
        if not isinstance(module, nn.LayerNorm):
            for parameter in module.parameters(recurse=False):
                parameter.copy_(parameter.half())
