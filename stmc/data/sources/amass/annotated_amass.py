"""Annotations by AMASS's paths, and their recordings → a cache.

The cache holds HumanML3D, KIT-ML or BABEL as in the paper's training, or their sentences on CMU's own recordings. This
module converts recordings to clips; it is independent of the files of recordings (see `amass_recordings` and
`cmu_recordings`) and of annotations (see `annotations`).
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
from stmc.data.preparation import LayoutError, Piece, Watch, convert_pieces
from stmc.data.sources.amass.amass_recordings import Recordings, repose
from stmc.data.sources.amass.annotations import Annotated, Annotations, Segment, read_annotations, with_mirror_images
from stmc.data.spans import AnnotatedSpans, CacheBuilder
from stmc.motion.body_model import Skeleton, load_body
from stmc.motion.motion import Motion
from stmc.motion.representation import Representation

TOLERANCE = 0.5
"""Seconds by which an annotation may exceed its recording: clocks and roundings differ."""
CACHE_VERSION = 1
"""Version of the conversion of the same files. Raise it by one with every change that produces other features, clips or
texts: caches of earlier versions are then prepared again."""


@runtime_checkable
class Recording(Protocol):
    """A recording to convert; it can be pickled. `split` overrides that of its annotations, unless it is None."""

    split: str | None

    @property
    def fingerprint(self) -> str:
        """Digest of its content."""
        ...

    def motion(self, skeleton: Skeleton, fps: float | int) -> Motion:
        """Return the whole recording on `skeleton` at `fps`. Raises `ValueError` if it cannot be used."""
        ...

    def features(self, motion: Motion, representation: Representation) -> Float[Tensor, "frames features"]:
        """Compute the features of this motion, or of its mirror image, above the recording's floor."""
        ...


@runtime_checkable
class RecordingSource(Protocol):
    """A source of recordings by AMASS's paths."""

    def check(self, paths: Collection[str], representation: Representation) -> None:
        """Raise `LayoutError` if it is evident that no recording exists, or that none has such features."""
        ...

    def inputs(self, paths: Collection[str]) -> Iterable[Path]:
        """Return the files and folders that recordings depend on."""
        ...

    def read(self, paths: Collection[str]) -> Iterator[tuple[str, Recording | str]]:
        """Yield every path with its recording, or the reason for its absence; one recording is in memory at a time."""
        ...


@dataclass(frozen=True)
class Conversion:
    """The conversion of recordings to clips.

    Segments for training and validation last `shortest` to `longest` seconds, as published; those for testing have any
    duration.

    Args:
        fps: Frame rate of the features.
        representation: Representation of the features.
        offsets: Offsets of the skeleton.
        shortest: Minimum duration in seconds.
        longest: Maximum duration in seconds.
    """

    fps: float | int
    representation: Representation
    offsets: tuple[tuple[float, ...], ...]
    shortest: float | int
    longest: float | int

    def __call__(self, recording: Recording, entries: Sequence[Annotated]) -> Cache:
        """Convert one recording to clips; if it cannot be read, every entry is skipped with the reason.

        Features are those of the whole recording, cut at the times of the segments, as published. Rotations between
        frames are interpolated on the sphere, unlike published.
        """
        skeleton, builder = Skeleton(torch.tensor(self.offsets)), CacheBuilder(self.representation.width)
        name = type(self.representation).__name__.removesuffix("Representation").lower()
        entries = [replace(entry, split=recording.split or entry.split) for entry in entries]
        try:
            motion = recording.motion(skeleton, self.fps)
            for image in (False, True):
                if matching := [entry for entry in entries if entry.mirrored == image]:
                    features = recording.features(repose(motion, skeleton, image), self.representation).float()
                    builder.add(features, *(self._annotated(entry, len(features), builder) for entry in matching))
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
        """Return the first and last frame (exclusive) of a segment; raise `ValueError` if it cannot be used."""
        duration = frames / self.fps
        end = duration if segment.end is None else segment.end
        if end > duration + TOLERANCE or int(segment.start * self.fps) >= frames:
            raise ValueError(f"after the end: {segment.start:g} to {end:g} s of a recording of {duration:g} s")
        if split != "test" and not self.shortest <= end - segment.start <= self.longest:
            kind = "too short" if end - segment.start < self.shortest else "too long"
            raise ValueError(f"{kind}: {end - segment.start:g} s, not {self.shortest:g} to {self.longest:g}")
        begin, after = int(segment.start * self.fps), min(int(end * self.fps), frames)
        if after <= begin:
            raise ValueError(f"too short: less than a frame, {segment.start:g} to {end:g} s")
        return begin, after


def read_both_ways(folder: Path) -> Annotations:
    """Read the annotations of a folder, and add their mirror images; see `annotations`."""
    return with_mirror_images(read_annotations(folder))


@dataclass(frozen=True)
class AnnotatedAmass:
    """A `Preparation` of annotated recordings of AMASS.

    Args:
        source: Folder of the recordings.
        annotations: Folder of `annotations.read_annotations`.
        fps: Frame rate of the features.
        representation: Representation of the features.
        body: SMPL-H files, a folder or one file, whose neutral body (no betas) is posed, as published; None poses the
            default skeleton.
        shortest: Minimum duration in seconds; see `Conversion`.
        longest: Maximum duration in seconds; see `Conversion`.
        recordings: Reader of the source: AMASS's own files, TEACH's processed ones
            (`teach_recordings.TeachRecordings`), or CMU's recordings in AMASS (`cmu_recordings.CmuRecordings`).
        read: Reader of the annotations.
        conversion: Converts a recording with its entries to clips: `Conversion` or `babel_rows.RowConversion`.
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
        """Entries by AMASS's path."""
        jobs: dict[str, list[Annotated]] = {}
        for entry in self._annotated.entries:
            jobs.setdefault(entry.path, []).append(entry)
        return jobs

    def check(self) -> None:
        """Raise `LayoutError` if a folder has the wrong content, and `FileNotFoundError` if there is no body."""
        skipped = self._annotated.skipped
        if not self._jobs:
            raise LayoutError(f"annotations={self.annotations}: none can be used; the first: {': '.join(skipped[0])}")
        self._recordings.check(self._jobs, self.representation)
        assert self._skeleton  # fail now rather than after an hour

    @cached_property
    def _settings(self) -> tuple[object, ...]:
        """Everything that a piece depends on besides its recording."""
        kind = type(self.representation).__qualname__
        kind_of_clips = getattr(
            self.conversion, "func", self.conversion
        ).__qualname__  # of a partial function, or the class itself
        bones = self._skeleton.offsets.tolist()
        return CACHE_VERSION, self.fps, kind, bones, self.shortest, self.longest, kind_of_clips

    def fingerprint(self) -> str:
        """Compute a digest of the recordings, all annotations, the skeleton, the cache version and the settings."""
        return fingerprint(self._recordings.inputs(self._jobs), [*self._settings, self._annotated])

    def prepared(self, scratch: Path, workers: int, watch: Watch) -> Cache:
        """Build the cache; see `Preparation`."""
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

        cache = convert_pieces(pieces(), len(self._jobs), scratch, workers, watch, skipped)
        return cache if self.body is None else replace(cache, skeleton=self._skeleton)
