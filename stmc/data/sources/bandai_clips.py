"""The Bandai Namco Research motion dataset as one of those that `stmc prepare` knows.

Knows what preparing is; how its clips are read and converted is `bandai`'s.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from stmc.data.cache import Cache, fingerprint
from stmc.data.preparation import Watch, code, find_source
from stmc.data.sources import bandai

_CODE = tuple(f"data/sources/{name}" for name in ("archives", "bandai*", "segments"))
_CODE += ("data/cache", "body", "body_model", "bvh", "geometry", "motion", "representation/layout")
_CODE += ("representation/smpl", "untrusted")


@dataclass(frozen=True)
class BandaiClips:
    """`source` is the published `.tar.xz`, or the folder it unpacks to; a `Preparation`. It takes a minute, so nothing
    of a run that was killed is kept."""

    source: str | Path
    fps: float | int

    def check(self) -> Path:
        """The archive or folder. Raises `LayoutError` where there is none."""
        return find_source(self.source, "the dataset's .tar.xz or its unpacked folder")

    def fingerprint(self) -> str:
        """Of the archive or every file of the folder, the code and the frame rate."""
        assets = Path(__file__).parents[2] / "assets"
        inputs = [self.check(), *(assets / f"{name}.json" for name in ("contents", "segments", "skeleton"))]
        return fingerprint(inputs, [self.fps, code(*_CODE)])

    def prepared(self, scratch: Path, workers: int, watch: Watch) -> Cache:
        """See `Preparation`."""
        source = self.check()
        total = bandai.CLIPS if source.is_file() else sum(1 for _ in source.rglob("*.bvh"))
        return bandai.gather(watch(bandai.read_clips(source, self.fps, workers), total), self.fps)
