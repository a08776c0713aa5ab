"""Encode texts before training or sampling: `stmc embed PATH text_encoder=clip`."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import MISSING, dataclass
from pathlib import Path
from typing import Any

from omegaconf import DictConfig
from rich.console import Console

from stmc.cli.commands import command
from stmc.cli.config_parts import build_part
from stmc.settings.records import setting
from stmc.text import Cached, TextEncoder


@dataclass(frozen=True, kw_only=True)
class Settings:
    """Settings of `stmc embed`."""

    texts: str = setting(
        MISSING, "timelines or annotations (.json), one text per line (.txt), or a folder of such files"
    )
    folder: str = setting("cache/text", "folder for the embeddings; training calls it text_cache")
    trusted: tuple[str, ...] = setting((), "your own packages that define the encoder")


@command("embed", Settings, ("texts",))
def main(config: DictConfig) -> None:
    texts = list(dict.fromkeys(["", *texts_in(Path(config.texts).expanduser())]))
    encoder = Cached(build_part(config, "text_encoder", TextEncoder), config.folder)
    missing = encoder.missing(texts)
    if missing:
        encoder.encode(missing)
    Console().print(f"{len(texts)} texts in {encoder.file}, {len(missing)} of them new", soft_wrap=True)


def texts_in(path: Path) -> Iterator[str]:
    """Yield the texts of a file, or of all `.txt` and `.json` files of a folder. Raises `ValueError` if none exists."""
    if not path.exists():
        raise ValueError(f"texts={path} does not exist; expected a .txt or .json file, or a folder of them")
    files = sorted(found for found in path.rglob("*") if found.suffix in (".txt", ".json")) if path.is_dir() else [path]
    found = False
    for file in files:
        try:
            document = file.read_text(encoding="utf-8-sig")
            texts = _in_json(json.loads(document)) if file.suffix == ".json" else _in_lines(document)
            for text in texts:
                found = True
                yield text
        except (UnicodeDecodeError, json.JSONDecodeError) as error:
            raise ValueError(f"{file} cannot be read: {error}") from error
    if not found:
        raise ValueError(f"texts={path} contains no text; a text is a line of a .txt file or a `text` of a .json file")


def _in_lines(document: str) -> Iterator[str]:
    """Yield the part of each line before its first `#`: a plain text, a prompt of a timeline or a HumanML3D caption."""
    for line in document.splitlines():
        text = line.partition("#")[0].strip()
        if text:
            yield text


def _in_json(node: Any) -> Iterator[str]:
    """Yield every value of a key `text` at any depth: prompts of timelines, annotations of motions."""
    if isinstance(node, list):
        for each in node:
            yield from _in_json(each)
    elif isinstance(node, dict):
        for key, value in node.items():
            if key == "text" and isinstance(value, str):
                yield value
            else:
                yield from _in_json(value)
