"""A prepared data set on disk: the features of all clips in one tensor, and a table of what each clip shows.

The one format between preparing data and training on it, whatever the data set; knows neither. A folder holds
`clips.safetensors` ("features": every clip's frames one after the other, raw; and the numbers that come with the data)
and `clips.json` (the table).
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from jaxtyping import Float
from safetensors import SafetensorError
from safetensors.torch import load_file, save_file
from torch import Tensor

from stmc.diffusion.statistics import Statistics
from stmc.io.files import write_whole
from stmc.io.untrusted import UnreadableError, cut, load_json, read_text
from stmc.motion.body_model import Skeleton

FEATURES, TABLE = "clips.safetensors", "clips.json"

HELD_OUT = ("test", "val")
"""The splits that nothing is trained on."""

MOST_BYTES = 256 * 2**20
"""Of the table; forty thousand clips take some 20 MB."""


TOUCHING = 0.3
"""Seconds between the end of one clip and the beginning of another within which their recording passes from one to the
other."""


class CacheError(ValueError):
    """A cache folder that is missing, incomplete or not one; the message says how to make it."""


@dataclass(frozen=True)
class Clip:
    """One clip: frames `[start, end)` of the features; `texts` names its sentences in the table.

    `content` groups clips for balanced sampling and claims body `parts`, as a prompt would; of a `cyclic` clip any trim
    still shows what its texts say. Clips of one `recording` (or one part of it) lie among the features as they do in
    time, with what is between them; of a clip without, nobody knows what comes before and after it. `whole`: the frames
    of all that was recorded before and after it, too; empty where nothing more is known. `annotations`: how many people
    described it. `from_start`: training cuts nothing off the clip's beginning, and, unless it is `cyclic`, nothing off
    its end: reaching out and coming back belong to what happens once.
    """

    name: str
    content: str
    style: str
    texts: str
    parts: tuple[str, ...]
    cyclic: bool
    mirrored: bool
    split: str
    start: int
    end: int
    recording: str = ""
    annotations: int = 1
    whole: tuple[int, ...] = ()
    from_start: bool = False


@dataclass(frozen=True)
class Cache:
    """A prepared data set. `texts` maps a clip's key to its sentences, each with its probability.

    `statistics` are those that belong to the data set, where it has its own; `skeleton` is the body whose motions the
    features are, if it is not the default one.
    """

    fps: float | int
    representation: str
    features: Float[Tensor, "frames features"]
    clips: tuple[Clip, ...]
    texts: dict[str, tuple[tuple[str, float], ...]]
    skipped: tuple[tuple[str, str], ...] = ()
    fingerprint: str = ""
    statistics: Statistics | None = None
    skeleton: Skeleton | None = None

    def __post_init__(self) -> None:
        for clip in self.clips:
            if not 0 <= clip.start < clip.end <= len(self.features):
                raise CacheError(f"clip {clip.name}: frames [{clip.start}, {clip.end}) of {len(self.features)}")
            first, last = clip.whole or (clip.start, clip.end)
            if not 0 <= first <= clip.start < clip.end <= last <= len(self.features):
                raise CacheError(f"clip {clip.name}: frames [{clip.start}, {clip.end}) of recording [{first}, {last})")
            if clip.texts not in self.texts:
                raise CacheError(f"clip {clip.name}: no sentences under {clip.texts!r}")
        finite = self.features.isfinite().all(dim=1)
        if not finite.all():
            frame = int(finite.logical_not().nonzero()[0])
            names = [clip.name for clip in self.clips if clip.start <= frame < clip.end]
            raise CacheError(f"clip {', '.join(names)}: features that are not finite, first in frame {frame} of all")

    def held_out(self, text: str) -> list[Clip]:
        """The clips that nothing is trained on and that have `text` among their sentences."""
        told = {key for key, rows in self.texts.items() if any(text == sentence for sentence, _ in rows)}
        return [clip for clip in self.clips if clip.split in HELD_OUT and clip.texts in told]

    def write(self, folder: Path) -> None:
        """Writes both files, the table last: it marks a complete cache. A kill leaves all of it or none."""
        folder = Path(folder)
        (folder / TABLE).unlink(missing_ok=True)  # it would lend its fingerprint to the new features
        numbers = {"features": self.features}
        if self.statistics:
            numbers |= {"mean": self.statistics.mean, "std": self.statistics.std}
        if self.skeleton:
            numbers["skeleton"] = self.skeleton.offsets
        numbers = {name: values.contiguous() for name, values in numbers.items()}
        write_whole(folder / FEATURES, lambda path: save_file(numbers, path))
        names = ("fps", "representation", "clips", "texts", "skipped", "fingerprint")
        table = {name: getattr(self, name) for name in names}
        table["clips"] = [dataclasses.asdict(clip) for clip in self.clips]
        text = json.dumps(table, indent=1) + "\n"
        write_whole(folder / TABLE, lambda path: path.write_text(text, encoding="utf-8"))

    @classmethod
    def read(cls, folder: Path) -> Cache:
        """Raises `CacheError` where the folder holds no complete cache, or a damaged one."""
        folder = Path(folder)
        table = _table(folder)
        if table is None or not (folder / FEATURES).exists():
            raise CacheError(f"{folder} holds no prepared data; make it with stmc prepare")
        try:
            numbers = load_file(folder / FEATURES)
            return cls(
                fps=table["fps"],
                representation=table["representation"],
                features=numbers["features"],
                clips=tuple(_clip(clip) for clip in table["clips"]),
                texts={key: tuple((text, share) for text, share in rows) for key, rows in table["texts"].items()},
                skipped=tuple((name, why) for name, why in table["skipped"]),
                fingerprint=table["fingerprint"],
                statistics=Statistics(numbers["mean"], numbers["std"]) if "mean" in numbers else None,
                skeleton=Skeleton(numbers["skeleton"]) if "skeleton" in numbers else None,
            )
        except SafetensorError as error:
            raise CacheError(f"{folder / FEATURES} is damaged: {error}; run stmc prepare again") from error
        except (AttributeError, KeyError, TypeError) as error:
            raise CacheError(f"{folder / TABLE} is not a cache's table: {cut(repr(error), 200)}") from error


def fresh(folder: Path, fingerprint: str) -> bool:
    """Whether `folder` holds a complete cache that was made from these very inputs."""
    try:
        table = _table(Path(folder))
    except CacheError:
        return False
    return table is not None and table.get("fingerprint") == fingerprint and (Path(folder) / FEATURES).exists()


def fingerprint(sources: Iterable[Path], settings: Sequence[object]) -> str:
    """A name for the inputs of a cache: every file's place, size and time of change (folders: all files below them),
    the contents of the Python files among them, and the settings. Where a source as a whole lies does not matter."""
    digest = hashlib.sha256(repr(tuple(settings)).encode())
    for source in map(Path, sources):
        below = sorted(file for file in source.rglob("*") if file.is_file())
        for file in below if source.is_dir() else [source]:
            status, place = file.stat(), file.relative_to(source.parent).as_posix()
            code = file.suffix == ".py"
            state = hashlib.sha256(file.read_bytes()).hexdigest() if code else (status.st_size, status.st_mtime_ns)
            digest.update(repr((place, state)).encode())
    return digest.hexdigest()


def assemble(rows: Sequence[tuple[Clip, Float[Tensor, "_ features"]]]) -> tuple[tuple[Clip, ...], Tensor]:
    """Clips and their features, with `start` and `end` set to where each comes to lie in the one tensor: end to end,
    so none is part of a `recording` any more."""
    clips, start = [], 0
    for clip, features in rows:
        place = {"start": start, "end": start + len(features)}
        clips.append(dataclasses.replace(clip, **place, recording="", whole=()))
        start += len(features)
    return tuple(clips), torch.cat([features for _, features in rows])


def read_caches(folders: str | Path | Sequence[str | Path]) -> Cache:
    """The prepared data set in a folder; those in several folders as one.

    Raises `CacheError` as `Cache.read` and `merged` do.
    """
    places = [folders] if isinstance(folders, str | Path) else list(folders)
    caches = [Cache.read(Path(place).expanduser()) for place in places]
    if len(caches) == 1:
        return caches[0]
    return dataclasses.replace(merged(caches), fingerprint=" ".join(cache.fingerprint for cache in caches))


def merged(caches: Sequence[Cache]) -> Cache:
    """All caches as one, their clips in the order given, without a fingerprint. They must be of one kind.

    Statistics that some have of their own are not those of all, and are left out. Raises `CacheError` for caches of
    different kinds or bodies, and where two give the same key to different texts.
    """
    first = caches[0]
    features = torch.empty(sum(len(cache.features) for cache in caches), first.features.shape[1])
    clips: list[Clip] = []
    texts: dict[str, tuple[tuple[str, float], ...]] = {}
    start = 0
    for cache in caches:
        kinds = [(each.fps, each.representation, each.features.shape[1]) for each in (first, cache)]
        if kinds[0] != kinds[1]:
            raise CacheError(f"caches of two kinds: {kinds[0]} and {kinds[1]}")
        bodies = [(each.skeleton or Skeleton.default()).offsets for each in (first, cache)]
        if not torch.equal(*bodies):
            raise CacheError("caches of two bodies: their skeletons differ")
        if twice := [key for key in cache.texts if texts.get(key, cache.texts[key]) != cache.texts[key]]:
            raise CacheError(f"the texts of {', '.join(twice)} differ from one cache to the other")
        features[start : start + len(cache.features)] = cache.features
        clips += [_moved(clip, start) for clip in cache.clips]
        texts |= cache.texts
        start += len(cache.features)
    skipped = tuple(row for cache in caches for row in cache.skipped)
    return dataclasses.replace(
        first, features=features, clips=tuple(clips), texts=texts, skipped=skipped, fingerprint="", statistics=None
    )


def _moved(clip: Clip, by: int) -> Clip:
    whole = tuple(by + frame for frame in clip.whole)
    return dataclasses.replace(clip, start=by + clip.start, end=by + clip.end, whole=whole)


def _clip(row: dict) -> Clip:
    """A clip of the table; earlier ones know no annotations, no recordings and no `from_start`."""
    return Clip(**row | {"parts": tuple(row["parts"]), "whole": tuple(row.get("whole", ()))})


def _table(folder: Path) -> dict | None:
    try:
        table = load_json(read_text(folder / TABLE, MOST_BYTES))
    except FileNotFoundError:
        return None
    except UnreadableError as error:
        raise CacheError(f"{folder / TABLE} is not a cache's table: {error}") from error
    if not isinstance(table, dict):
        raise CacheError(f"{folder / TABLE} is not a cache's table: it holds a {type(table).__name__}")
    return table
