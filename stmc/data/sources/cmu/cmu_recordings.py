"""CMU's own recordings at AMASS's paths: annotations of AMASS also describe the motion capture behind it.

Maps recordings to paths; independent of annotations. A recording has the same name and the same clock in both: AMASS's
frames are CMU's (`docs/data.md` describes how far that was checked).
"""

from __future__ import annotations

import hashlib
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

from jaxtyping import Float
from torch import Tensor

from stmc.data.preparation import LayoutError
from stmc.data.sources.cmu import catalogue as cmu
from stmc.data.sources.cmu.cmu_clips import encode_above_floor
from stmc.data.sources.segments import splits
from stmc.motion.body_model import Skeleton
from stmc.motion.motion import Motion
from stmc.motion.representation import Representation, SmplRepresentation

DATA_SET = "CMU"
"""First part of the paths."""


@dataclass(frozen=True)
class CmuRecording:
    """One recording of CMU; see `annotated_amass.Recording`.

    A recording that our own segments hold out from training is held out here too, so that both can be used together.
    """

    source: cmu.Source

    @property
    def split(self) -> str | None:
        """The split of `segments.splits`, or None."""
        return splits().get(self.source.name)

    @property
    def fingerprint(self) -> str:
        """Digest of its text, its skeleton and its split."""
        return hashlib.sha256(repr((self.source, self.split)).encode()).hexdigest()

    def motion(self, skeleton: Skeleton, fps: float | int) -> Motion:
        """Read the recording; see `catalogue.read`."""
        return cmu.read(self.source, Skeleton(skeleton.offsets.double()), fps)

    def features(self, motion: Motion, representation: Representation) -> Float[Tensor, "frames features"]:
        """Compute 205 features above the floor that `catalogue` found, as in `cmu_clips`."""
        return encode_above_floor(motion)


class CmuRecordings:
    """The recordings in a folder or archive of `catalogue.read_sources`; see `annotated_amass.RecordingSource`."""

    def __init__(self, source: Path) -> None:
        self._source = Path(source)
        if not self._source.exists():
            raise LayoutError(f"source={source} does not exist; it should be a folder of CMU's recordings or a .tar.xz")

    def check(self, paths: Collection[str], representation: Representation) -> None:
        """Raise `LayoutError` if no path is CMU's, or the representation does not have 205 features.

        The source itself is read only once, by `read`.
        """
        if not isinstance(representation, SmplRepresentation):
            kind = type(representation).__name__
            raise LayoutError(f"CMU's recordings have 205 features; use SmplRepresentation instead of {kind}")
        if not any(map(_recording, paths)):
            first = next(iter(paths))
            raise LayoutError(f"none of the {len(paths)} annotated recordings is CMU's; the first: {first}")

    def inputs(self, paths: Collection[str]) -> list[Path]:
        """Return the source as a whole."""
        return [self._source]

    def read(self, paths: Collection[str]) -> Iterator[tuple[str, CmuRecording | str]]:
        """Yield every path with its recording, in the source's order, or the reason for its absence."""
        waiting = {name: path for path in paths if (name := _recording(path))}
        for path in paths:
            if waiting.get(_recording(path) or "") != path:
                yield path, f"not CMU's: {path}"
        reasons = dict[str, str]()
        for source in cmu.read_sources(self._source):
            if isinstance(source, tuple):
                reasons[source[0]] = source[1]
            elif requested := waiting.pop(source.name, None):
                yield requested, CmuRecording(source)
        for name, path in waiting.items():
            yield path, reasons.get(name, f"no file: {name}.amc or .bvh")


def _recording(path: str) -> str | None:
    """Return the name of CMU's recording at AMASS's path, `14_06` for `CMU/14/14_06_poses`, or None."""
    parts = PurePosixPath(path)
    return parts.name.removesuffix("_poses").removesuffix("_stageii") if parts.parts[0] == DATA_SET else None
