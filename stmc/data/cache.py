"""A prepared data set on disk: the features of all clips in one tensor, and a table of the clips.

It is the only format between data preparation and training, whatever the data set. A folder holds `clips.safetensors`
("features": every clip's raw frames, concatenated; and the numbers of the data set) and `clips.json` (the table).
Independent of preparation and training.
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
from stmc.io.untrusted import UnreadableError, load_json, read_text, truncate
from stmc.motion.body_model import Skeleton

FEATURES, TABLE = "clips.safetensors", "clips.json"

HELD_OUT = ("test", "val")
"""Splits that are never used for training."""
MOST_BYTES = 256 * 2**20
"""Maximum size of the table; 40,000 clips take about 20 MB."""
TOUCHING = 0.3
"""Maximum gap in seconds between two clips of a recording that count as continuous."""


class CacheError(ValueError):
    """A cache folder that is missing, incomplete or invalid; the message says how to make it."""


@dataclass(frozen=True)
class Clip:
    """One clip: frames `[start, end)` of the features.

    Args:
        name: Name of the clip.
        content: Action of the clip, which groups clips for balanced sampling.
        style: Style of the clip.
        texts: Key of its sentences in the table.
        parts: Body parts that the action claims, as a prompt would.
        cyclic: Whether any part of the clip still shows its texts.
        mirrored: Whether the clip is a mirror image.
        split: "train", "val" or "test".
        start: First frame.
        end: Frame after the last.
        recording: Recording (or part of one) that contains the clip. Clips of one recording lie among the features as
            they do in time, with the frames between them; empty if nothing is known of the frames before and after the
            clip.
        annotations: Number of people who described the clip.
        whole: First and last frame of the whole recording, or empty if unknown.
        from_start: Training never cuts off the beginning of the clip nor, unless it is `cyclic`, its end: reaching out
            and coming back belong to a one-shot action.
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
    """A prepared data set.

    Args:
        fps: Frame rate of the features.
        representation: Name of the representation.
        features: Features of all clips, [frames, features].
        clips: The clips.
        texts: Sentences of each key, with their probabilities.
        skipped: Names of omitted clips, with the reasons.
        fingerprint: Digest of the inputs.
        statistics: Statistics of the data set, if it has its own.
        skeleton: Body of the features; None is the default skeleton.

    Raises:
        CacheError: If a clip is out of range or has no sentences, or a feature is not finite.
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
                raise CacheError(
                    f"clip {clip.name}: frames [{clip.start}, {clip.end}) exceed the {len(self.features)} features"
                )
            first, last = clip.whole or (clip.start, clip.end)
            if not 0 <= first <= clip.start < clip.end <= last <= len(self.features):
                raise CacheError(
                    f"clip {clip.name}: frames [{clip.start}, {clip.end}) exceed the recording [{first}, {last})"
                )
            if clip.texts not in self.texts:
                raise CacheError(f"clip {clip.name}: no sentences under {clip.texts!r}")
        finite = self.features.isfinite().all(dim=1)
        if not finite.all():
            frame = int(finite.logical_not().nonzero()[0])
            names = [clip.name for clip in self.clips if clip.start <= frame < clip.end]
            raise CacheError(f"clip {', '.join(names)}: features are not finite, first in frame {frame}")

    def held_out(self, text: str) -> list[Clip]:
        """Return the clips that are never used for training and have `text` among their sentences."""
        keys = {key for key, rows in self.texts.items() if any(text == sentence for sentence, _ in rows)}
        return [clip for clip in self.clips if clip.split in HELD_OUT and clip.texts in keys]

    def write(self, folder: Path) -> None:
        """Write both files, the table last, because it marks a complete cache. A kill leaves all or nothing."""
        folder = Path(folder)
        (folder / TABLE).unlink(missing_ok=True)  # otherwise it would give its fingerprint to the new features
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
        """Read a cache. Raises `CacheError` if the folder holds no complete cache, or a damaged one."""
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
                texts={
                    key: tuple((text, probability) for text, probability in rows)
                    for key, rows in table["texts"].items()
                },
                skipped=tuple((name, reason) for name, reason in table["skipped"]),
                fingerprint=table["fingerprint"],
                statistics=Statistics(numbers["mean"], numbers["std"]) if "mean" in numbers else None,
                skeleton=Skeleton(numbers["skeleton"]) if "skeleton" in numbers else None,
            )
        except SafetensorError as error:
            raise CacheError(f"{folder / FEATURES} is damaged: {error}; run stmc prepare again") from error
        except (AttributeError, KeyError, TypeError) as error:
            raise CacheError(f"{folder / TABLE} is not a cache's table: {truncate(repr(error), 200)}") from error


def is_current(folder: Path, fingerprint: str) -> bool:
    """Return whether `folder` holds a complete cache made from exactly these inputs."""
    try:
        table = _table(Path(folder))
    except CacheError:
        return False
    return table is not None and table.get("fingerprint") == fingerprint and (Path(folder) / FEATURES).exists()


def fingerprint(sources: Iterable[Path], settings: Sequence[object]) -> str:
    """Compute a digest of the inputs of a cache.

    It covers the relative path, size and modification time of every file (of folders, all files below them), the
    contents of Python files among them, and the settings. The location of a source as a whole does not matter.
    """
    digest = hashlib.sha256(repr(tuple(settings)).encode())
    for source in map(Path, sources):
        below = sorted(file for file in source.rglob("*") if file.is_file())
        for file in below if source.is_dir() else [source]:
            status, path = file.stat(), file.relative_to(source.parent).as_posix()
            code = file.suffix == ".py"
            state = hashlib.sha256(file.read_bytes()).hexdigest() if code else (status.st_size, status.st_mtime_ns)
            digest.update(repr((path, state)).encode())
    return digest.hexdigest()


def assemble(rows: Sequence[tuple[Clip, Float[Tensor, "_ features"]]]) -> tuple[tuple[Clip, ...], Tensor]:
    """Concatenate the features of clips, and set the `start` and `end` of each.

    No clip is part of a `recording` any more.
    """
    clips, start = [], 0
    for clip, features in rows:
        end = start + len(features)
        clips.append(dataclasses.replace(clip, start=start, end=end, recording="", whole=()))
        start = end
    return tuple(clips), torch.cat([features for _, features in rows])


def read_caches(folders: str | Path | Sequence[str | Path]) -> Cache:
    """Read the prepared data set in a folder, or those in several folders as one.

    Raises `CacheError` as `Cache.read` and `merge_caches` do.
    """
    paths = [folders] if isinstance(folders, str | Path) else list(folders)
    caches = [Cache.read(Path(path).expanduser()) for path in paths]
    if len(caches) == 1:
        return caches[0]
    return dataclasses.replace(merge_caches(caches), fingerprint=" ".join(cache.fingerprint for cache in caches))


def merge_caches(caches: Sequence[Cache]) -> Cache:
    """Merge caches of one kind, with their clips in the given order and without a fingerprint.

    Statistics of single caches are dropped, because they do not describe all of them. Raises `CacheError` if caches
    have different kinds or bodies, or if two give the same key to different texts.
    """
    first = caches[0]
    features = torch.empty(sum(len(cache.features) for cache in caches), first.features.shape[1])
    clips: list[Clip] = []
    texts: dict[str, tuple[tuple[str, float], ...]] = {}
    start = 0
    for cache in caches:
        kinds = [(part.fps, part.representation, part.features.shape[1]) for part in (first, cache)]
        if kinds[0] != kinds[1]:
            raise CacheError(f"caches must have one kind, but these have {kinds[0]} and {kinds[1]}")
        bodies = [(part.skeleton or Skeleton.default()).offsets for part in (first, cache)]
        if not torch.equal(*bodies):
            raise CacheError("caches must have one body, but their skeletons differ")
        if conflicts := [key for key in cache.texts if texts.get(key, cache.texts[key]) != cache.texts[key]]:
            raise CacheError(f"the texts of {', '.join(conflicts)} differ between caches")
        features[start : start + len(cache.features)] = cache.features
        clips += [_shift(clip, start) for clip in cache.clips]
        texts |= cache.texts
        start += len(cache.features)
    skipped = tuple(row for cache in caches for row in cache.skipped)
    return dataclasses.replace(
        first, features=features, clips=tuple(clips), texts=texts, skipped=skipped, fingerprint="", statistics=None
    )


def _shift(clip: Clip, by: int) -> Clip:
    whole = tuple(by + frame for frame in clip.whole)
    return dataclasses.replace(clip, start=by + clip.start, end=by + clip.end, whole=whole)


def _clip(row: dict) -> Clip:
    """Build a clip from the table; earlier tables lack annotations, recordings and `from_start`."""
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
