"""CLIP text features, in the three variants that published motion models use."""

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
    """CLIP's text features, one word per text: projected into the space shared with images, not normalised.

    STMC (appendix D) and MDM are conditioned on them. All arithmetic is in float32, so that every device gives the same
    numbers. The authors of STMC encoded with OpenAI's `clip` on a GPU, with weights and arithmetic in half precision:
    their embeddings differ from those of "fp32" within half precision, and from those of "fp16" by the arithmetic
    alone.

    Args:
        source: Folder or hub name of the weights; the default is ViT-B/32.
        width: Width of the features; 512 for ViT-B/32.
        tokens: Maximum number of tokens read, including start and end; None uses all 77 positions of CLIP. MDM reads
            22, which cuts longer captions.
        weights: "fp16" rounds all weights, except those of norms, to half precision, as MDM does.
        device: Device of the model and of the results.
        batch: Maximum number of texts encoded at once.

    Raises:
        ValueError: If `weights` is unknown or `tokens` is below 2.
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
            raise ValueError(f"tokens={tokens} must be at least 2, for the start and the end of a text")
        self.source, self.width, self.tokens, self.weights = source, width, tokens, weights
        self.device, self.batch = device, batch

    @property
    def name(self) -> str:
        """The source of the weights, and the settings that differ from the defaults."""
        limit = "" if self.tokens is None else f" {self.tokens} tokens"
        return f"{self.source}{limit}{'' if self.weights == 'fp32' else ' fp16'}"

    def encode(self, texts: Sequence[str]) -> tuple[Float[Tensor, "batch words width"], Int[Tensor, " batch"]]:
        """Encode texts on the encoder's device; see `TextEncoder`. Raises `WeightsNotFound`."""
        tokenizer, model = self._loaded
        limit = min(self.tokens or model.config.max_position_embeddings, model.config.max_position_embeddings)
        return encode(texts, tokenizer, limit, self._words, self.batch, model.device)

    def _words(self, tokens: Int[Tensor, "batch _"]) -> Float[Tensor, "batch words width"]:
        return self._loaded[1](input_ids=tokens).text_embeds[:, None]

    @cached_property
    def _loaded(self) -> tuple[Any, Any]:
        CLIPTextModelWithProjection = transformers().CLIPTextModelWithProjection

        tokenizer, model = load(self.source, CLIPTextModelWithProjection.from_pretrained, self.device, REMEDY)
        check_width(self.source, model.config.projection_dim, self.width)
        if self.weights == "fp16":
            _round_to_half(model)
        return tokenizer, model


class ClipTokens:
    """CLIP's features at each of its positions, before the projection; MotionDiffuse reads them.

    A text has as many words as CLIP has positions (77): it is padded with token 0, as in CLIP's own tokenizer, and the
    features of the padding count too. The word at the text's end comes first, because it represents the whole text; the
    others follow in order.

    Args:
        source: Folder or hub name of the weights; the default is ViT-B/32.
        width: Width of the features; 512 for ViT-B/32.
        device: Device of the model and of the results.
        batch: Maximum number of texts encoded at once.
    """

    def __init__(self, source: str = CLIP, width: int = 512, device: str = "cpu", batch: int = 256) -> None:
        self.source, self.width, self.device, self.batch = source, width, device, batch

    @property
    def name(self) -> str:
        """The source of the weights."""
        return f"{self.source} positions"

    def encode(self, texts: Sequence[str]) -> tuple[Float[Tensor, "batch words width"], Int[Tensor, " batch"]]:
        """Encode texts on the encoder's device; see `TextEncoder`. Raises `WeightsNotFound`."""
        tokenizer, model = self._loaded
        limit = model.config.max_position_embeddings
        return encode(texts, tokenizer, limit, self._words, self.batch, model.device)

    def _words(self, tokens: Int[Tensor, "batch _"]) -> Float[Tensor, "batch words width"]:
        model, end = self._loaded[1], tokens.shape[1] - 1
        padded = F.pad(tokens, (0, model.config.max_position_embeddings - tokens.shape[1]))
        features = model(input_ids=padded).last_hidden_state
        return torch.cat([features[:, end : end + 1], features[:, :end], features[:, end + 1 :]], dim=1)

    @cached_property
    def _loaded(self) -> tuple[Any, Any]:
        CLIPTextModel = transformers().CLIPTextModel

        tokenizer, model = load(self.source, CLIPTextModel.from_pretrained, self.device, REMEDY)
        check_width(self.source, model.config.hidden_size, self.width)
        return tokenizer, model


@torch.no_grad()
def _round_to_half(model: nn.Module) -> None:
    """Round all weights, except those of norms, to half precision."""
    for module in model.modules():
        if not isinstance(module, nn.LayerNorm):
            for parameter in module.parameters(recurse=False):
                parameter.copy_(parameter.half())
