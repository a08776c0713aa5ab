"""The Bandai Namco Research motion dataset as one of those that `stmc prepare` knows.

Knows what preparing is; how its clips are read and converted is `bandai`'s.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from stmc.data.cache import Cache, fingerprint
from stmc.data.preparation import Watch, find_source
from stmc.data.sources.bandai import recordings as bandai

CACHE_VERSION = 1
"""Of what this module makes of the same files. Raise it by one with every change that makes other features, clips or
texts of them: caches that were prepared before are then made again."""


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
        """Of the archive or every file of the folder, the version of the cache and the frame rate."""
        assets = Path(__file__).parents[3] / "assets"
        inputs = [self.check(), *(assets / f"{name}.json" for name in ("contents", "segments", "skeleton"))]
        return fingerprint(inputs, [self.fps, CACHE_VERSION])

    def prepared(self, scratch: Path, workers: int, watch: Watch) -> Cache:
        """See `Preparation`."""
        source = self.check()
        total = bandai.CLIPS if source.is_file() else sum(1 for _ in source.rglob("*.bvh"))
        return bandai.gather(watch(bandai.read_clips(source, self.fps, workers), total), self.fps)
