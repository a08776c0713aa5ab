"""The Bandai Namco Research motion dataset as a `Preparation`; `recordings` reads and converts its clips."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from stmc.data.cache import Cache, fingerprint
from stmc.data.preparation import Watch, find_source
from stmc.data.sources.bandai import recordings as bandai

CACHE_VERSION = 2
"""Version of the conversion of the same files. Raise it by one with every change that produces other features, clips or
texts: caches of earlier versions are then prepared again."""


@dataclass(frozen=True)
class BandaiClips:
    """A `Preparation` of the Bandai Namco Research motion dataset, which takes a minute and does not resume.

    Args:
        source: The published `.tar.xz`, or the folder that it unpacks to.
        fps: Frame rate of the features.
    """

    source: str | Path
    fps: float | int

    def check(self) -> Path:
        """Return the archive or folder. Raises `LayoutError` if it does not exist."""
        return find_source(self.source, "the dataset's .tar.xz or its unpacked folder")

    def fingerprint(self) -> str:
        """Compute a digest of the archive or every file of the folder, the cache version and the frame rate."""
        assets = Path(__file__).parents[3] / "assets"
        inputs = [self.check(), *(assets / f"{name}.json" for name in ("contents", "segments", "skeleton"))]
        return fingerprint(inputs, [self.fps, CACHE_VERSION])

    def prepared(self, scratch: Path, workers: int, watch: Watch) -> Cache:
        """Build the cache; see `Preparation`."""
        source = self.check()
        total = bandai.CLIPS if source.is_file() else sum(1 for _ in source.rglob("*.bvh"))
        return bandai.gather(watch(bandai.read_clips(source, self.fps, workers), total), self.fps)
