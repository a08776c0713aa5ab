"""Pre-trained models on disk or on the hub, and unpadded encoding with them. Independent of particular models."""

from __future__ import annotations

import pickle
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import Any

import torch
from jaxtyping import Float, Int
from safetensors import SafetensorError
from torch import Tensor

from stmc.diffusion.tensors import pad
from stmc.io.arrays import ArraysError, check_checkpoint
from stmc.io.files import sha256
from stmc.text.text_encoder import check


class WeightsNotFound(FileNotFoundError):
    """The weights of a text encoder are neither on this machine nor available from the hub.

    The message says how to get them.
    """


def transformers() -> ModuleType:
    """Import the package at first use, without its warning in notebooks about a progress bar."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="IProgress not found")
        return import_module("transformers")


@torch.no_grad()
def encode(
    texts: Sequence[str],
    tokenizer: Callable[..., Any],
    limit: int,
    words: Callable[[Tensor], Tensor],
    batch: int,
    device: torch.device,
) -> tuple[Float[Tensor, "batch words width"], Int[Tensor, " batch"]]:
    """Encode each distinct text once, truncated to `limit` tokens.

    Only texts with the same number of tokens share a batch: without padding nothing can leak between texts.

    Args:
        texts: Texts to encode.
        tokenizer: Tokenizer of the model.
        limit: Maximum number of tokens.
        words: Function from token ids [batch, tokens] to words [batch, words, width].
        batch: Maximum number of texts encoded at once.
        device: Device of the token ids.

    Returns:
        The words, padded with zeros, and the number of words of each text.
    """
    check(texts)
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


def load(
    source: str,
    build: Callable[..., Any],
    device: str,
    remedy: str,
    sha256: str | None = None,
    revision: str | None = None,
    **settings: bool,
) -> tuple[Any, Any]:
    """Load the tokenizer and the float32 model from a folder or from the hub (its local cache first).

    Weights come from safetensors or, if there are none, from pytorch_model.bin, if it holds nothing but tensors.

    Args:
        source: Folder or hub name.
        build: The `from_pretrained` of the model's class.
        device: Device of the model.
        remedy: Command that gets the weights, for the error message.
        sha256: Expected digest of model.safetensors; None accepts any.
        revision: Revision on the hub.
        **settings: Further arguments of `build`.

    Raises:
        WeightsNotFound: If there is no model, if weights are missing, or if model.safetensors has another digest.
    """
    attempts = [True] if Path(source).is_dir() else [True, False]
    for local in attempts:
        try:
            with _quiet_transformers():
                if sha256:
                    _check_digest(source, sha256, revision, local)
                tokenizer, model, report = _load_parts(source, build, revision, local, settings)
            break
        except WeightsNotFound:
            raise
        except (OSError, ValueError, SafetensorError, pickle.UnpicklingError) as error:
            if local is attempts[-1]:
                raise WeightsNotFound(
                    f"no weights of a text encoder at {source!r}. Get them with: {remedy}, or set `source` to a folder "
                    "with config.json, model.safetensors and the tokenizer's files. transformers says: "
                    f"{' '.join(str(error).split())}"
                ) from error
    if report["missing_keys"]:
        missing = ", ".join(sorted(report["missing_keys"]))
        raise WeightsNotFound(f"the weights at {source!r} belong to another model or are incomplete: no {missing}")
    return tokenizer, model.float().eval().requires_grad_(False).to(device)


def _has_safetensors(source: str, revision: str | None, local: bool) -> bool:
    """Return whether the weights at `source` are safetensors.

    Raises `OSError` if there are none, and `ValueError` for a pytorch_model.bin whose pickle might never end.
    """
    cached_file = transformers().utils.cached_file
    from huggingface_hub.errors import LocalEntryNotFoundError

    missing: OSError | None = None
    for name in ("model.safetensors", "model.safetensors.index.json", "pytorch_model.bin"):
        try:
            path = cached_file(source, name, local_files_only=local, revision=revision)
        except OSError as error:
            if not local and isinstance(error.__cause__, LocalEntryNotFoundError):  # there is no connection
                raise
            missing = missing or error
            continue
        if name != "pytorch_model.bin":
            return True
        try:
            check_checkpoint(Path(path))
        except Exception as error:  # a damaged pickle can raise any exception
            raise ArraysError(f"{path} is not a checkpoint of tensors, and is not loaded: {error}") from error
        return False
    assert missing is not None
    raise missing


def _load_parts(
    source: str, build: Callable[..., Any], revision: str | None, local: bool, settings: Mapping[str, bool]
) -> tuple[Any, Any, dict[str, Any]]:
    """Load the tokenizer, the model and the report of its missing weights; see `load`."""
    place = {"revision": revision, "local_files_only": local}
    place |= {"trust_remote_code": False}  # otherwise a model of the hub may ask to run its own code
    safe = {"use_safetensors": _has_safetensors(source, revision, local), "weights_only": True}
    model, report = build(source, output_loading_info=True, **safe, **place, **settings)
    return transformers().AutoTokenizer.from_pretrained(source, **place), model, report


def _check_digest(source: str, expected: str, revision: str | None, local: bool) -> None:
    """Raise `WeightsNotFound` unless the weights at `source` have the SHA-256 `expected`."""
    cached_file = transformers().utils.cached_file

    path = cached_file(source, "model.safetensors", local_files_only=local, revision=revision)
    digest = sha256(Path(path))
    if digest != expected:
        raise WeightsNotFound(
            f"{path} does not hold the weights of this encoder: its SHA-256 is {digest}, not {expected}. Set "
            "`source` to a folder with the right weights, or `revision` to the commit of the hub that has them"
        )


def check_width(source: str, found: int, expected: int) -> None:
    """Raise `ValueError` if the width of a model differs from the width of its encoder."""
    if found != expected:
        raise ValueError(f"the text encoder at {source!r} has width {found}, not {expected}")


@contextmanager
def _quiet_transformers() -> Iterator[None]:
    """Hide transformers' progress bars and its reports about unused weights; missing weights are errors."""
    logging = transformers().utils.logging

    level, bars = logging.get_verbosity(), logging.is_progress_bar_enabled()
    logging.set_verbosity_error()
    logging.disable_progress_bar()
    try:
        yield
    finally:
        logging.set_verbosity(level)
        if bars:
            logging.enable_progress_bar()
