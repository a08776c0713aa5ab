"""HumanML3D's processed folder, as its own notebooks produce it → a cache of the 263 features.

The folder holds `new_joint_vecs/`, `new_joints/`, `texts/`, `Mean.npy`, `Std.npy` and the lists of names. Independent
of the formulas of the features (see `representation.humanml3d`) and of AMASS.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property, partial
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from stmc.data.cache import Cache, fingerprint
from stmc.data.preparation import LayoutError, Piece, Watch, convert_pieces
from stmc.data.sources.amass.annotations import SPLITS
from stmc.data.sources.humanml3d.humanml3d_texts import WHOLE, Caption, read_captions
from stmc.data.spans import AnnotatedSpans, CacheBuilder
from stmc.diffusion.statistics import Statistics
from stmc.io.arrays import ArraysError, read_npy
from stmc.io.untrusted import UnreadableError, read_lines
from stmc.motion.representation.layout import HUMANML3D_LAYOUT

CACHE_VERSION = 1
"""Version of the conversion of the same files. Raise it by one with every change that produces other features, clips or
texts: caches of earlier versions are then prepared again."""

FPS = 20

Span = tuple[int, int]
"""Frames [start, end) of a clip."""
SHORTEST, LONGEST = 40, 199
"""Minimum and maximum length of clips in frames, as in all published training on HumanML3D."""
KIT_WIDTH = 251
"""Number of features of KIT-ML's clips, which have 21 joints of another skeleton."""
AT_ONCE = 256
"""Number of clips per piece; each clip is too small for its own."""
_MOST_BYTES = 2**26
"""Maximum size of an array; a clip of ten minutes has 25 MB."""
_FOLDERS, _FILES = ("new_joint_vecs", "texts"), ("Mean.npy", "Std.npy", "train.txt", "val.txt", "test.txt")


@dataclass(frozen=True)
class ProcessedHumanML3D:
    """A `Preparation` of HumanML3D's processed folder. The cache has the folder's own mean and std.

    Args:
        source: The folder `HumanML3D/`.
        shortest: Minimum length of a clip in frames.
        longest: Maximum length of a clip in frames.
        part_entries: Whether a caption of a part of a clip is an entry of its own, drawn once per epoch, as in the
            published loaders; otherwise it is one of the clip's.
    """

    source: str | Path
    shortest: int = SHORTEST
    longest: int = LONGEST
    part_entries: bool = False

    @property
    def _folder(self) -> Path:
        return Path(self.source).expanduser()

    @cached_property
    def _splits(self) -> dict[str, str]:
        """Split of each name. A name in two lists belongs to the first of train, val, test."""
        names: dict[str, str] = {}
        for split in SPLITS:
            for name in " ".join(read_lines(self._folder / f"{split}.txt")).split():
                names.setdefault(name, split)
        return names

    @cached_property
    def _statistics(self) -> Statistics:
        mean, std = (_numbers(self._folder / name) for name in ("Mean.npy", "Std.npy"))
        if mean.shape == (KIT_WIDTH,):
            raise ValueError(
                f"these are KIT-ML's {KIT_WIDTH} features (21 joints of another skeleton, 12.5 fps), which no model "
                "here uses; prepare KIT-ML from AMASS with data=kitml"
            )
        if mean.shape != (HUMANML3D_LAYOUT.width,) or std.shape != mean.shape:
            shapes = f"{tuple(mean.shape)} and {tuple(std.shape)}"
            raise ValueError(f"Mean.npy and Std.npy are {shapes}, not ({HUMANML3D_LAYOUT.width},)")
        return Statistics(mean, std)

    def check(self) -> None:
        """Raise `LayoutError` if a part of the folder is missing, or is not HumanML3D's."""
        folder = self._folder
        missing = [f"{name}/" for name in _FOLDERS if not (folder / name).is_dir()]
        missing += [name for name in _FILES if not (folder / name).is_file()]
        if missing:
            names = sorted(path.name for path in folder.iterdir())[:10] if folder.is_dir() else "no such folder"
            hint = "; texts.zip must be unpacked" if "texts/" in missing and (folder / "texts.zip").exists() else ""
            inner = [
                name for name in ("HumanML3D", "HumanML3D/HumanML3D") if (folder / name / "new_joint_vecs").is_dir()
            ]
            hint += f"; is {folder / inner[0]} meant?" if inner else ""
            raise LayoutError(f"source={folder}: {', '.join(missing)} missing, found {names}{hint}")
        try:
            present = self._statistics and [name for name in self._splits if self._vectors(name).is_file()]
        except ValueError as error:
            raise LayoutError(f"source={folder}: {error}") from error
        if not present:
            raise LayoutError(
                f"source={folder}: new_joint_vecs/ has none of the {len(self._splits)} names in the lists"
            )

    def _vectors(self, name: str) -> Path:
        return self._folder / "new_joint_vecs" / f"{name}.npy"

    def _inputs(self, name: str) -> list[Path]:
        paths = [
            self._vectors(name),
            self._folder / "texts" / f"{name}.txt",
            self._folder / "new_joints" / f"{name}.npy",
        ]
        return [path for path in paths if path.is_file()]

    def fingerprint(self) -> str:
        """Compute a digest of the listed clips, their captions, the statistics, the lists and the cache version."""
        files = [path for name in self._splits for path in self._inputs(name)]
        return fingerprint([*(self._folder / name for name in _FILES), *files], [CACHE_VERSION, *self._choices])

    @property
    def _choices(self) -> tuple[int, int, bool]:
        return self.shortest, self.longest, self.part_entries

    def prepared(self, scratch: Path, workers: int, watch: Watch) -> Cache:
        """Build the cache; see `Preparation`."""
        unsafe = [(name, "malformed name: it is a path") for name in self._splits if Path(name).name != name]
        names = [name for name in self._splits if Path(name).name == name]
        pieces = []
        for start in range(0, len(names), AT_ONCE):
            batch = {name: self._splits[name] for name in names[start : start + AT_ONCE]}
            inputs = [path for name in batch for path in self._inputs(name)]
            convert = partial(convert_clips, self._folder, batch, *self._choices)
            name = fingerprint(inputs, [CACHE_VERSION, batch, *self._choices])
            pieces.append(Piece(f"{names[start]} ...", name, convert))
        return replace(
            convert_pieces(pieces, len(pieces), scratch, workers, watch, unsafe), statistics=self._statistics
        )


def convert_clips(
    folder: Path,
    splits: Mapping[str, str],
    shortest: int = SHORTEST,
    longest: int = LONGEST,
    part_entries: bool = False,
) -> Cache:
    """Convert named clips; unusable ones are skipped with the reason.

    Args:
        folder: HumanML3D's folder.
        splits: Split of each name.
        shortest: Minimum length of a clip in frames.
        longest: Maximum length of a clip in frames.
        part_entries: See `ProcessedHumanML3D`.
    """
    builder = CacheBuilder(HUMANML3D_LAYOUT.width)
    for name, split in splits.items():
        try:
            features, captions = read_clip(folder, name)
        except (ValueError, OSError) as error:
            builder.skipped.append((name, str(error)))
            continue
        spans: dict[tuple[int, int], list[str]] = {}
        for caption in captions:
            if isinstance(caption, str):
                builder.skipped.append((name, caption))
                continue
            begin, end = 0, len(features)
            if (caption.start, caption.end) != WHOLE:
                begin, end = int(caption.start * FPS), min(int(caption.end * FPS), len(features))
            if shortest <= end - begin <= longest:
                spans.setdefault((begin, end), []).append(caption.text)
            else:
                kind = "too long" if end - begin > longest else "too short"
                builder.skipped.append((name, f"{kind}: {end - begin} frames, not {shortest} to {longest}"))
        entries = _entries(name, spans, len(features)) if part_entries else {name: spans}
        builder.add(
            features, *(AnnotatedSpans(entry, split, name[:1] == "M", texts) for entry, texts in entries.items())
        )
    return builder.cache(FPS, "humanml3d")


def _entries(name: str, spans: Mapping[Span, list[str]], frames: int) -> dict[str, dict[Span, list[str]]]:
    """Return the whole clip with all of its captions, and one entry per caption of a part."""
    parts = [(span, text) for span, texts in spans.items() if span != (0, frames) for text in texts]
    whole = {name: {(0, frames): spans[0, frames]}} if (0, frames) in spans else {}
    return whole | {f"{name}-{number}": {span: [text]} for number, (span, text) in enumerate(parts)}


def read_clip(folder: Path, name: str) -> tuple[Float[Tensor, "frames 263"], list[Caption | str]]:
    """Read the features and the captions (or their problems) of the clip `name` in HumanML3D's `folder`.

    Raises `ValueError` if the clip cannot be used.
    """
    vectors, joints = folder / "new_joint_vecs" / f"{name}.npy", folder / "new_joints" / f"{name}.npy"
    texts = folder / "texts" / f"{name}.txt"
    if absent := [path for path in (vectors, texts) if not path.is_file()]:
        raise ValueError(f"no file: {absent[0].relative_to(folder)}")
    features = _numbers(vectors)
    if features.ndim != 2 or features.shape[1] != HUMANML3D_LAYOUT.width:
        raise ValueError(f"wrong shape: features are {tuple(features.shape)}, not (frames, {HUMANML3D_LAYOUT.width})")
    if not SHORTEST <= len(features) <= LONGEST:
        kind = "too long" if len(features) > LONGEST else "too short"
        raise ValueError(f"{kind}: {len(features)} frames, not {SHORTEST} to {LONGEST}")
    if joints.is_file() and (shape := tuple(_numbers(joints).shape)) != (len(features), 22, 3):
        raise ValueError(f"mislabelled: new_joints is {shape}, but new_joint_vecs has {len(features)} frames")
    try:
        captions = read_captions(texts)
    except UnreadableError as error:
        raise ValueError(f"damaged: {error}") from error
    if not captions:
        raise ValueError("no caption: the file is empty")
    return features, captions


def _numbers(path: Path) -> Tensor:
    """Read an array of finite numbers as float32."""
    try:
        array = read_npy(path, _MOST_BYTES)
    except ArraysError as error:
        raise ValueError(f"damaged: {error}") from error
    if array.dtype.kind not in "fiu":
        raise ValueError(f"damaged: {path.name} holds {array.dtype}, not numbers")
    values = torch.from_numpy(array.astype(np.float32))
    if not values.isfinite().all():
        frames = (~values.isfinite()).flatten(1).any(dim=1).nonzero()[:, 0] if values.ndim > 1 else [0]
        raise ValueError(f"not finite: {path.parent.name}/{path.name}, {len(frames)} rows from {int(frames[0])} on")
    return values
