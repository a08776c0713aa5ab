"""The motions of one run on the disk, a file each: whoever makes one, on whichever machine, and in whatever order.

Knows numbers and motions; knows no timeline, no method and no benchmark.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from shutil import rmtree

import torch
from safetensors.torch import load_file, save_file

from stmc.io.files import write_whole
from stmc.motion.motion import Motion

_TENSORS = ("rotations", "translation", "joints")
_SECONDS = "seconds"


@dataclass(frozen=True)
class Samples:
    """A folder of motions by their numbers, at `fps` frames a second."""

    folder: Path
    fps: float | int

    def missing(self, numbers: Iterable[int]) -> list[int]:
        """Those that are not there yet, in their order."""
        found = {path.stem for path in self.folder.glob("*.safetensors")}
        return [number for number in numbers if self._path(number).stem not in found]

    def write(self, number: int, motion: Motion, seconds: float | None = None) -> None:
        """Keeps a motion, and the seconds that it took where that says something."""
        tensors = {name: getattr(motion, name).contiguous() for name in _TENSORS}
        if seconds is not None:
            tensors[_SECONDS] = torch.tensor(seconds, dtype=torch.float64)
        write_whole(self._path(number), partial(save_file, tensors))

    def read(self, number: int) -> tuple[Motion, float | None]:
        """What was written."""
        tensors = load_file(self._path(number))
        seconds = tensors.pop(_SECONDS, None)
        return Motion(*(tensors[name] for name in _TENSORS), self.fps), None if seconds is None else float(seconds)

    def remove(self) -> None:
        """Once they are measured; nothing happens where they are gone already."""
        rmtree(self.folder, ignore_errors=True)

    def _path(self, number: int) -> Path:
        return self.folder / f"{number:06d}.safetensors"
