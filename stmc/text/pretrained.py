"""Pre-trained models on disk or on the hub, and texts through them without padding. Knows no particular model."""

from __future__ import annotations

import pickle
import warnings
from collections.abc import Callable, Iterator, Sequence
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
from stmc.io.files import sha256
from stmc.text.text_encoder import check


class WeightsNotFound(FileNotFoundError):
    """The weights of a text encoder are neither on this machine nor to be had from the hub; the message says how to get
    them."""


def transformers() -> ModuleType:
    """The package, imported at first use. Its import warns notebooks of a progress bar that is never shown."""
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
    """Each distinct text once, cut after `limit` tokens, together with texts of as many tokens only: with no padding
    there is nothing that could leak from a text to its batch mates."""
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
) -> tuple[Any, torch.nn.Module]:
    """Tokenizer and float32 model of a folder or of the hub (its local cache first).

    From safetensors, or where there are none from a checkpoint that holds nothing but tensors. Raises `WeightsNotFound`
    where there is no model, one that lacks weights, or, with `sha256`, one whose model.safetensors has another digest.
    `revision`: of the hub's.
    """
    AutoTokenizer = transformers().AutoTokenizer

    attempts = [True] if Path(source).is_dir() else [True, False]
    for local in attempts:
        try:
            with _quiet():
                if sha256:
                    _check_digest(source, sha256, revision, local)
                model, report = build(
                    source,
                    local_files_only=local,
                    weights_only=True,
                    output_loading_info=True,
                    trust_remote_code=False,  # else a hub's model may ask to run its own code
                    revision=revision,
                    **settings,
                )
                tokenizer = AutoTokenizer.from_pretrained(
                    source, local_files_only=local, trust_remote_code=False, revision=revision
                )
            break
        except WeightsNotFound:
            raise
        except (OSError, ValueError, SafetensorError, pickle.UnpicklingError) as error:
            if local is attempts[-1]:
                raise WeightsNotFound(
                    f"no weights of a text encoder at {source!r}. Get them with: {remedy}, or give `source` a folder "
                    "with config.json, model.safetensors and the tokenizer's files. transformers says: "
                    f"{' '.join(str(error).split())}"
                ) from error
    if report["missing_keys"]:
        missing = ", ".join(sorted(report["missing_keys"]))
        raise WeightsNotFound(f"the weights at {source!r} are those of another model, or incomplete: no {missing}")
    return tokenizer, model.float().eval().requires_grad_(False).to(device)


def _check_digest(source: str, expected: str, revision: str | None, local: bool) -> None:
    """Raises `WeightsNotFound` where the weights at `source` are not those of the SHA-256 `expected`."""
    cached_file = transformers().utils.cached_file

    path = cached_file(source, "model.safetensors", local_files_only=local, revision=revision)
    digest = sha256(Path(path))
    if digest != expected:
        raise WeightsNotFound(
            f"{path} holds other weights than this encoder's: its SHA-256 is {digest}, not {expected}. Give `source` a "
            "folder with the right ones, or `revision` the hub's commit that has them"
        )


def check_width(source: str, found: int, expected: int) -> None:
    """Raises `ValueError` where a model has another width than its encoder was told."""
    if found != expected:
        raise ValueError(f"the text encoder at {source!r} has width {found}, not {expected}")


@contextmanager
def _quiet() -> Iterator[None]:
    """Without transformers' own progress bars and reports of weights that are not needed; those missing are errors."""
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
