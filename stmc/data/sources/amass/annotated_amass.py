"""Annotations by AMASS's paths and the recordings that they are of → a cache: HumanML3D, KIT-ML and BABEL as the
paper's training has them, or their sentences on CMU's own recordings.

Knows how a recording becomes clips; knows neither the recordings' files (see `amass` and `cmu_recordings`) nor the
annotations' (see `annotations`).
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor

from stmc.data.cache import Cache, fingerprint
from stmc.data.preparation import LayoutError, Piece, Watch, converted
from stmc.data.sources.amass.amass_recordings import Recordings, reposed
from stmc.data.sources.amass.annotations import Annotated, Annotations, Segment, read_annotations, with_mirror_images
from stmc.data.spans import AnnotatedSpans, CacheBuilder
from stmc.motion.body_model import Skeleton, load_body
from stmc.motion.motion import Motion
from stmc.motion.representation import Representation

TOLERANCE = 0.5
"""Seconds that an annotation may go on after its recording has ended: clocks and roundings differ."""

CACHE_VERSION = 1
"""Of what this module makes of the same files. Raise it by one with every change that makes other features, clips or
texts of them: caches that were prepared before are then made again."""


@runtime_checkable
class Recording(Protocol):
    """A recording on its way to clips; it can be pickled. `split`: where it belongs whatever its annotations say, or
    None."""

    split: str | None

    @property
    def fingerprint(self) -> str:
        """A name for its contents."""
        ...

    def motion(self, skeleton: Skeleton, fps: float | int) -> Motion:
        """The whole recording on `skeleton` at `fps`. Raises `ValueError` for one that cannot be used."""
        ...

    def features(self, motion: Motion, representation: Representation) -> Float[Tensor, "frames features"]:
        """The features of this motion, or of its mirror image, above the recording's floor."""
        ...


@runtime_checkable
class RecordingSource(Protocol):
    """Where the recordings at AMASS's paths are to be found."""

    def check(self, paths: Collection[str], representation: Representation) -> None:
        """Raises `LayoutError` where it can be told that not one is there, or can become such features."""
        ...

    def inputs(self, paths: Collection[str]) -> Iterable[Path]:
        """The files and folders that they depend on."""
        ...

    def read(self, paths: Collection[str]) -> Iterator[tuple[str, Recording | str]]:
        """Every path with its recording, or the reason why there is none; one at a time is in memory."""
        ...


@dataclass(frozen=True)
class Conversion:
    """How a recording becomes clips: at `fps`, on the skeleton with these bones, as `representation`.

    Segments for training and validation last `shortest` to `longest` seconds, as published; those for testing anything.
    """

    fps: float | int
    representation: Representation
    offsets: tuple[tuple[float, ...], ...]
    shortest: float | int
    longest: float | int

    def __call__(self, recording: Recording, entries: Sequence[Annotated]) -> Cache:
        """The clips of one recording; every entry is left out, with the reason, where it cannot be read.

        Features are those of the whole recording, cut at the segments' times, as published. Rotations between frames
        are on the sphere, which is not as published.
        """
        skeleton, builder = Skeleton(torch.tensor(self.offsets)), CacheBuilder(self.representation.width)
        name = type(self.representation).__name__.removesuffix("Representation").lower()
        entries = [replace(entry, split=recording.split or entry.split) for entry in entries]
        try:
            motion = recording.motion(skeleton, self.fps)
            for image in (False, True):
                if chosen := [entry for entry in entries if entry.mirrored == image]:
                    features = recording.features(reposed(motion, skeleton, image), self.representation).float()
                    builder.add(features, *(self._annotated(entry, len(features), builder) for entry in chosen))
        except ValueError as error:
            builder = CacheBuilder(self.representation.width)
            builder.skipped += [(entry.name, str(error)) for entry in entries]
        return builder.cache(self.fps, name)

    def _annotated(self, entry: Annotated, frames: int, builder: CacheBuilder) -> AnnotatedSpans:
        spans: dict[tuple[int, int], list[str]] = {}
        for segment in entry.segments:
            try:
                spans.setdefault(self._span(segment, frames, entry.split), []).append(segment.text)
            except ValueError as error:
                builder.skipped.append((entry.name, str(error)))
        return AnnotatedSpans(entry.name, entry.split, entry.mirrored, spans)

    def _span(self, segment: Segment, frames: int, split: str) -> tuple[int, int]:
        """First and last frame (excluded) of a segment; `ValueError` for one that cannot be used."""
        recorded = frames / self.fps
        end = recorded if segment.end is None else segment.end
        if end > recorded + TOLERANCE or int(segment.start * self.fps) >= frames:
            raise ValueError(f"after the end: {segment.start:g} to {end:g} s of a recording of {recorded:g} s")
        if split != "test" and not self.shortest <= end - segment.start <= self.longest:
            kind = "too short" if end - segment.start < self.shortest else "too long"
            raise ValueError(f"{kind}: {end - segment.start:g} s, not {self.shortest:g} to {self.longest:g}")
        begin, after = int(segment.start * self.fps), min(int(end * self.fps), frames)
        if after <= begin:
            raise ValueError(f"too short: less than a frame, {segment.start:g} to {end:g} s")
        return begin, after


def read_both_ways(folder: Path) -> Annotations:
    """The annotations of a folder, and their mirror images: see `annotations`."""
    return with_mirror_images(read_annotations(folder))


@dataclass(frozen=True)
class AnnotatedAmass:
    """`source` is AMASS's folder, `annotations` that of `annotations.read_annotations`; a `Preparation`.

    `recordings` says how to read the source: AMASS's own files, TEACH's processed ones
    (`teach_recordings.TeachRecordings`), or the recordings of CMU's that AMASS is made of
    (`cmu_recordings.CmuRecordings`). `body`: the folder of the SMPL-H files, or one of them, to pose the joints with
    its neutral body (no betas), as published; without it the default skeleton's joints are posed. For `shortest` and
    `longest` see `Conversion`. `read` makes annotations of their folder; `conversion` makes clips of a recording with
    its entries: `Conversion`, or `babel_rows.RowConversion`.
    """

    source: str | Path
    annotations: str | Path
    fps: float | int
    representation: Representation
    body: str | Path | None = None
    shortest: float | int = 2.0
    longest: float | int = 10.0
    recordings: Callable[[Path], RecordingSource] = Recordings
    read: Callable[[Path], Annotations] = read_both_ways
    conversion: Callable[..., Callable[[Recording, Sequence[Annotated]], Cache]] = Conversion

    @cached_property
    def _annotated(self) -> Annotations:
        return self.read(Path(self.annotations).expanduser())

    @cached_property
    def _recordings(self) -> RecordingSource:
        return self.recordings(Path(self.source).expanduser())

    @cached_property
    def _skeleton(self) -> Skeleton:
        if self.body is None:
            return Skeleton.default()
        return load_body(Path(self.body).expanduser(), "smplh").skeleton

    @cached_property
    def _jobs(self) -> dict[str, list[Annotated]]:
        """AMASS's path → its entries."""
        jobs: dict[str, list[Annotated]] = {}
        for entry in self._annotated.entries:
            jobs.setdefault(entry.path, []).append(entry)
        return jobs

    def check(self) -> None:
        """Raises `LayoutError` where a folder is not what it should be, `FileNotFoundError` where no body is."""
        skipped = self._annotated.skipped
        if not self._jobs:
            raise LayoutError(
                f"annotations={self.annotations}: not one can be used; the first: {': '.join(skipped[0])}"
            )
        self._recordings.check(self._jobs, self.representation)
        assert self._skeleton  # read now, not after an hour

    @cached_property
    def _settings(self) -> tuple[object, ...]:
        """All that a piece depends on beside its recording."""
        kind = type(self.representation).__qualname__
        kind_of_clips = getattr(self.conversion, "func", self.conversion).__qualname__  # of a partial one, or itself
        bones = self._skeleton.offsets.tolist()
        return CACHE_VERSION, self.fps, kind, bones, self.shortest, self.longest, kind_of_clips

    def fingerprint(self) -> str:
        """Of every annotated recording, all annotations, the skeleton, the version of the cache and the settings."""
        return fingerprint(self._recordings.inputs(self._jobs), [*self._settings, self._annotated])

    def prepared(self, scratch: Path, workers: int, watch: Watch) -> Cache:
        """See `Preparation`."""
        offsets = tuple(tuple(row) for row in self._skeleton.offsets.tolist())
        convert = self.conversion(self.fps, self.representation, offsets, self.shortest, self.longest)
        skipped = list(self._annotated.skipped)

        def pieces() -> Iterator[Piece]:
            for path, recording in self._recordings.read(self._jobs):
                entries = self._jobs[path]
                if isinstance(recording, str):
                    skipped.extend((entry.name, recording) for entry in entries)
                else:
                    inputs = fingerprint([], [recording.fingerprint, *self._settings, entries])
                    yield Piece(path, inputs, partial(convert, recording, entries))

        cache = converted(pieces(), len(self._jobs), scratch, workers, watch, skipped)
        return cache if self.body is None else replace(cache, skeleton=self._skeleton)
