"""The Bandai Namco Research motion dataset as one of those that scripts/prepare.py knows.

Knows what preparing is; how its clips are read and converted is `bandai`'s.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from stmc.data.cache import Cache, fingerprint
from stmc.data.preparation import LayoutError, Watch
from stmc.data.sources import bandai


@dataclass(frozen=True)
class BandaiClips:
    """`source` is the published `.tar.xz`, or the folder it unpacks to; a `Preparation`. It takes a minute, so nothing
    of a run that was killed is kept."""

    source: str | Path
    fps: float | int

    @property
    def _source(self) -> Path:
        return Path(self.source).expanduser()

    def check(self) -> None:
        """Raises `LayoutError` where there is no such file or folder."""
        if not self._source.exists():
            raise LayoutError(
                f"source={self.source} does not exist; it should be the dataset's .tar.xz or its unpacked folder"
            )

    def fingerprint(self) -> str:
        """Of the archive or every file of the folder, the code and the frame rate."""
        return fingerprint(bandai.inputs(self._source), [self.fps])

    def prepared(self, scratch: Path, workers: int, watch: Watch) -> Cache:
        """See `Preparation`."""
        total = bandai.CLIPS if self._source.is_file() else sum(1 for _ in self._source.rglob("*.bvh"))
        return bandai.gather(watch(bandai.read_clips(self._source, self.fps, workers), total), self.fps)
