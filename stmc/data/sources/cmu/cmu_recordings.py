"""CMU's own recordings at AMASS's paths: what people wrote about AMASS is true of the motion capture it was made from.

Knows whose recordings have which paths; knows no annotation. A recording has the same name in both, and the same
clock: AMASS's frames are CMU's (`docs/data.md` says how far that was checked).
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
from stmc.data.sources.cmu.cmu_clips import encoded
from stmc.data.sources.segments import splits
from stmc.motion.body_model import Skeleton
from stmc.motion.motion import Motion
from stmc.motion.representation import Representation, SmplRepresentation

DATA_SET = "CMU"
"""The first part of the paths."""


@dataclass(frozen=True)
class CmuRecording:
    """One recording of CMU's; see `annotated_amass.Recording`. One that our own segments keep from training is kept
    from it here, too, so that both may be trained on together."""

    source: cmu.Source

    @property
    def split(self) -> str | None:
        """See `segments.splits`."""
        return splits().get(self.source.name)

    @property
    def fingerprint(self) -> str:
        """Of its text, that of its skeleton, and its split."""
        return hashlib.sha256(repr((self.source, self.split)).encode()).hexdigest()

    def motion(self, skeleton: Skeleton, fps: float | int) -> Motion:
        """See `cmu.read`."""
        return cmu.read(self.source, Skeleton(skeleton.offsets.double()), fps)

    def features(self, motion: Motion, representation: Representation) -> Float[Tensor, "frames features"]:
        """Above the floor that `cmu` found, as in `cmu_clips`; the representation is known to be of 205 features."""
        return encoded(motion)


class CmuRecordings:
    """The recordings in any folder or archive that `cmu.read_sources` reads; see `annotated_amass.RecordingSource`."""

    def __init__(self, source: Path) -> None:
        self._source = Path(source)
        if not self._source.exists():
            raise LayoutError(f"source={source} does not exist; it should be a folder of CMU's recordings or a .tar.xz")

    def check(self, paths: Collection[str], representation: Representation) -> None:
        """Raises `LayoutError` where not one path is CMU's, and for others than 205 features. A source is looked
        through only once, when it is read."""
        if not isinstance(representation, SmplRepresentation):
            kind = type(representation).__name__
            raise LayoutError(f"CMU's recordings become 205 features: representation is SmplRepresentation, not {kind}")
        if not any(map(_recording, paths)):
            first = next(iter(paths))
            raise LayoutError(f"not one of the {len(paths)} annotated recordings is CMU's; the first: {first}")

    def inputs(self, paths: Collection[str]) -> list[Path]:
        """The source as a whole."""
        return [self._source]

    def read(self, paths: Collection[str]) -> Iterator[tuple[str, CmuRecording | str]]:
        """Every path with its recording, in the source's order, or the reason why there is none."""
        waiting = {name: path for path in paths if (name := _recording(path))}
        for path in paths:
            if waiting.get(_recording(path)) != path:
                yield path, f"not CMU's: {path}"
        reasons = dict[str, str]()
        for source in cmu.read_sources(self._source):
            if isinstance(source, tuple):
                reasons[source[0]] = source[1]
            elif path := waiting.pop(source.name, None):
                yield path, CmuRecording(source)
        for name, path in waiting.items():
            yield path, reasons.get(name, f"no file: {name}.amc or .bvh")


def _recording(path: str) -> str | None:
    """The name of CMU's recording at AMASS's path: `14_06` of `CMU/14/14_06_poses`; None of other data sets' paths."""
    places = PurePosixPath(path)
    return places.name.removesuffix("_poses").removesuffix("_stageii") if places.parts[0] == DATA_SET else None
