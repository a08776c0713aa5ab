"""The motions of one run on disk, one file each, written by any process on any machine in any order."""

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
    """A folder of motions by index, at `fps` frames per second."""

    folder: Path
    fps: float | int

    def missing(self, numbers: Iterable[int]) -> list[int]:
        """Return the indices that have no file yet, in order."""
        written = {path.stem for path in self.folder.glob("*.safetensors")}
        return [number for number in numbers if self._path(number).stem not in written]

    def write(self, number: int, motion: Motion, seconds: float | None = None) -> None:
        """Write a motion.

        Args:
            number: Index of the motion.
            motion: The motion.
            seconds: Duration of its computation, or None.
        """
        tensors = {name: getattr(motion, name).contiguous() for name in _TENSORS}
        if seconds is not None:
            tensors[_SECONDS] = torch.tensor(seconds, dtype=torch.float64)
        write_whole(self._path(number), partial(save_file, tensors))

    def read(self, number: int) -> tuple[Motion, float | None]:
        """Read a motion and the duration of its computation."""
        tensors = load_file(self._path(number))
        seconds = tensors.pop(_SECONDS, None)
        rotations, translation, joints = (tensors[name] for name in _TENSORS)
        motion = Motion(rotations, translation, joints, self.fps)
        return motion, None if seconds is None else float(seconds)

    def remove(self) -> None:
        """Delete the folder, if it exists, after the motions are measured."""
        rmtree(self.folder, ignore_errors=True)

    def _path(self, number: int) -> Path:
        return self.folder / f"{number:06d}.safetensors"
