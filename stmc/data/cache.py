"""A prepared data set on disk: the features of all clips in one tensor, and a table of what each clip shows.

The one format between preparing data and training on it, whatever the data set; knows neither. A folder holds
`clips.safetensors` ("features": every clip's frames one after the other, raw) and `clips.json` (the table).
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import os
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from jaxtyping import Float
from safetensors.torch import load_file, save_file
from torch import Tensor

FEATURES, TABLE = "clips.safetensors", "clips.json"


class CacheError(ValueError):
    """A cache folder that is missing, incomplete or not one; the message says how to make it."""


@dataclass(frozen=True)
class Clip:
    """One clip: frames `[start, end)` of the features; `texts` names its sentences in the table.

    `content` groups clips for balanced sampling; of a `cyclic` clip any trim still shows what its texts say.
    """

    name: str
    content: str
    style: str
    texts: str
    cyclic: bool
    mirrored: bool
    split: str
    start: int
    end: int


@dataclass(frozen=True)
class Cache:
    """A prepared data set. `texts` maps a clip's key to its sentences, each with its probability."""

    fps: float
    representation: str
    features: Float[Tensor, "frames features"]
    clips: tuple[Clip, ...]
    texts: dict[str, tuple[tuple[str, float], ...]]
    skipped: tuple[tuple[str, str], ...] = ()
    fingerprint: str = ""

    def __post_init__(self) -> None:
        for clip in self.clips:
            if not 0 <= clip.start < clip.end <= len(self.features):
                raise CacheError(f"clip {clip.name}: frames [{clip.start}, {clip.end}) of {len(self.features)}")
            if clip.texts not in self.texts:
                raise CacheError(f"clip {clip.name}: no sentences under {clip.texts!r}")

    def write(self, folder: Path) -> None:
        """Writes both files, each under a temporary name first; the table last, so that it marks a complete cache."""
        folder = Path(folder)
        folder.mkdir(parents=True, exist_ok=True)
        temporary = folder / f".{FEATURES}.{os.getpid()}"
        save_file({"features": self.features.contiguous()}, temporary)
        temporary.replace(folder / FEATURES)
        table = {
            field.name: getattr(self, field.name) for field in dataclasses.fields(self) if field.name != "features"
        } | {"clips": [dataclasses.asdict(clip) for clip in self.clips]}
        temporary = folder / f".{TABLE}.{os.getpid()}"
        temporary.write_text(json.dumps(table, indent=1) + "\n", encoding="utf-8")
        temporary.replace(folder / TABLE)

    @classmethod
    def read(cls, folder: Path) -> Cache:
        """Raises `CacheError` where the folder holds no complete cache."""
        table = _table(Path(folder))
        if table is None or not (Path(folder) / FEATURES).exists():
            raise CacheError(f"{folder} holds no prepared data; make it with scripts/prepare.py")
        return cls(
            fps=table["fps"],
            representation=table["representation"],
            features=load_file(Path(folder) / FEATURES)["features"],
            clips=tuple(Clip(**clip) for clip in table["clips"]),
            texts={key: tuple((text, share) for text, share in rows) for key, rows in table["texts"].items()},
            skipped=tuple((name, why) for name, why in table["skipped"]),
            fingerprint=table["fingerprint"],
        )


def fresh(folder: Path, fingerprint: str) -> bool:
    """Whether `folder` holds a complete cache that was made from these very inputs."""
    try:
        table = _table(Path(folder))
    except CacheError:
        return False
    return table is not None and table["fingerprint"] == fingerprint and (Path(folder) / FEATURES).exists()


def fingerprint(sources: Iterable[Path], settings: Sequence[object]) -> str:
    """A name for the inputs of a cache: every file's path, size and time of change (folders: all files below them), the
    contents of the Python files among them, and the settings."""
    digest = hashlib.sha256(repr(tuple(settings)).encode())
    for source in map(Path, sources):
        for file in sorted(source.rglob("*")) if source.is_dir() else [source]:
            status = file.stat()
            state = file.read_bytes() if file.suffix == ".py" else f"{status.st_size} {status.st_mtime_ns}".encode()
            digest.update(file.name.encode() + state)
    return digest.hexdigest()


def assemble(rows: Sequence[tuple[Clip, Float[Tensor, "frames features"]]]) -> tuple[tuple[Clip, ...], Tensor]:
    """Clips and their features, with `start` and `end` set to where each comes to lie in the one tensor."""
    clips, start = [], 0
    for clip, features in rows:
        clips.append(dataclasses.replace(clip, start=start, end=start + len(features)))
        start += len(features)
    return tuple(clips), torch.cat([features for _, features in rows])


def _table(folder: Path) -> dict | None:
    try:
        return json.loads((folder / TABLE).read_text(encoding="utf-8"))
    except FileNotFoundError:
        return None
    except json.JSONDecodeError as error:
        raise CacheError(f"{folder / TABLE} is not a cache's table: {error}") from error
