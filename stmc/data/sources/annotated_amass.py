"""AMASS and annotations by its paths → a cache: HumanML3D, KIT-ML and BABEL as the paper's training has them.

Knows how a recording becomes features and clips; knows neither AMASS's files (see `amass`) nor the annotations'
(see `annotations`).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from pathlib import Path

import torch

from stmc.body_model import Skeleton, load_body
from stmc.data.cache import Cache, fingerprint
from stmc.data.preparation import LayoutError, Piece, Watch, code, converted
from stmc.data.sources.amass import Recordings, read_recording, reposed
from stmc.data.sources.annotations import Annotated, Annotations, Segment, read_annotations, with_mirror_images
from stmc.data.spans import Album, Described
from stmc.motion import Motion
from stmc.representation import Representation

TOLERANCE = 0.5
"""Seconds that an annotation may go on after its recording has ended: clocks and roundings differ."""

_CODE = ("arrays", "representation", "body", "body_model", "geometry", "motion")
_SOURCES = ("amass", "annotated_amass", "annotations", "bandai_sentences")


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

    def __call__(self, path: Path, entries: Sequence[Annotated]) -> Cache:
        """The clips of one recording; every entry is left out, with the reason, where it cannot be read.

        Features are those of the whole recording (its lowest joint is the floor), cut at the segments' times, as
        published. So is the time grid: a frame stands for the middle of its time (`geometry.sampling_positions`), and
        both rates cover the same seconds. Rotations between frames are on the sphere, which is not as published.
        """
        skeleton, album = Skeleton(torch.tensor(self.offsets)), Album(self.representation.width)
        name = type(self.representation).__name__.removesuffix("Representation").lower()
        try:
            for image, moved in self._both(path, skeleton):
                if chosen := [entry for entry in entries if entry.mirrored == image]:
                    features = self.representation.encode(moved).float()
                    for entry in chosen:
                        album.add(features, self._described(entry, len(features), album))
        except ValueError as error:
            album = Album(self.representation.width)
            album.skipped += [(entry.name, str(error)) for entry in entries]
        return album.cache(self.fps, name)

    def _both(self, path: Path, skeleton: Skeleton) -> Iterator[tuple[bool, Motion]]:
        """The recording and its mirror image at the new frame rate."""
        recorded = read_recording(path, skeleton)
        try:
            motion = recorded.resampled(self.fps)
        except ValueError as error:
            raise ValueError(f"too short: {error}") from error
        for image in (False, True):
            yield image, reposed(motion, skeleton, image)

    def _described(self, entry: Annotated, frames: int, album: Album) -> Described:
        spans: dict[tuple[int, int], list[str]] = {}
        for segment in entry.segments:
            try:
                spans.setdefault(self._span(segment, frames, entry.split), []).append(segment.text)
            except ValueError as error:
                album.skipped.append((entry.name, str(error)))
        return Described(entry.name, entry.split, entry.mirrored, spans)

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


@dataclass(frozen=True)
class AnnotatedAmass:
    """`source` is AMASS's folder, `annotations` that of `annotations.read_annotations`; a `Preparation`.

    `body`: the folder of the SMPL-H files, or one of them, to pose the joints with its neutral body (no betas), as
    published; without it the default skeleton's joints are posed. For `shortest` and `longest` see `Conversion`.
    """

    source: str | Path
    annotations: str | Path
    fps: float | int
    representation: Representation
    body: str | Path | None = None
    shortest: float | int = 2.0
    longest: float | int = 10.0

    @cached_property
    def _annotated(self) -> Annotations:
        return with_mirror_images(read_annotations(Path(self.annotations).expanduser()))

    @cached_property
    def _recordings(self) -> Recordings:
        return Recordings(Path(self.source).expanduser())

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
        if self._skeleton and self._files:
            return
        skipped = self._annotated.skipped
        if not self._jobs:
            raise LayoutError(
                f"annotations={self.annotations}: not one can be used; the first: {': '.join(skipped[0])}"
            )
        wanted = next(iter(self._jobs))
        raise LayoutError(
            f"source={self.source} has none of the {len(self._jobs)} annotated recordings; expected for instance "
            f"{wanted}.npz, found {', '.join(self._recordings.examples)}"
        )

    @cached_property
    def _files(self) -> dict[str, Path]:
        found = {path: self._recordings.find(path) for path in self._jobs}
        return {path: file for path, file in found.items() if file is not None}

    @cached_property
    def _settings(self) -> tuple[object, ...]:
        """All that a piece depends on beside its recording."""
        state = code(*_CODE, "data/cache", "data/spans", *(f"data/sources/{name}" for name in _SOURCES))
        kind = type(self.representation).__qualname__
        bones = self._skeleton.offsets.tolist()
        return state, self.fps, kind, bones, self.shortest, self.longest

    def fingerprint(self) -> str:
        """Of every recording that is annotated, all annotations, the skeleton, the code and the settings."""
        return fingerprint(self._files.values(), [*self._settings, self._annotated])

    def prepared(self, scratch: Path, workers: int, watch: Watch) -> Cache:
        """See `Preparation`."""
        offsets = tuple(tuple(row) for row in self._skeleton.offsets.tolist())
        convert = Conversion(self.fps, self.representation, offsets, self.shortest, self.longest)
        pieces = [
            Piece(
                path, fingerprint([file], [*self._settings, self._jobs[path]]), partial(convert, file, self._jobs[path])
            )
            for path, file in self._files.items()
        ]
        absent = [
            (entry.name, f"no file: {path}.npz")
            for path, entries in self._jobs.items()
            if path not in self._files
            for entry in entries
        ]
        cache = converted(pieces, scratch, workers, watch, [*self._annotated.skipped, *absent])
        return cache if self.body is None else replace(cache, skeleton=self._skeleton)
