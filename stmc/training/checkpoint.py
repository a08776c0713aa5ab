"""Files that are whole or absent: checkpoints that survive a kill at any moment, and weights to ship.

Checkpoints are read back without unpickling code. Knows nothing of what the tensors mean.
"""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import torch
from safetensors.torch import save_file
from torch import Tensor


def write_whole(path: Path, write: Callable[[Path], object]) -> None:
    """Lets `write` fill a temporary file beside `path`, and renames it only once its bytes are on the disk."""
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        write(temporary)
        with temporary.open("rb") as file:
            os.fsync(file.fileno())
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)


def save_weights(path: Path, tensors: Mapping[str, Tensor]) -> None:
    """A safetensors file of `tensors` in their own precision."""
    copies = {name: tensor.detach().cpu().contiguous() for name, tensor in tensors.items()}
    write_whole(path, lambda temporary: save_file(copies, temporary))


class Checkpoints:
    """The last `keep` checkpoints in a folder, one file each, named by the step after which it was written."""

    def __init__(self, folder: Path, keep: int = 2) -> None:
        if keep < 1:
            raise ValueError(f"at least one checkpoint must be kept, not {keep}")
        self.folder, self.keep = Path(folder), keep

    def steps(self) -> list[int]:
        """The steps there are checkpoints of, in rising order."""
        names = [re.fullmatch(r"step-(\d+)\.pt", path.name) for path in self.folder.glob("step-*.pt")]
        return sorted(int(match[1]) for match in names if match)

    def save(self, step: int, state: Mapping[str, Any]) -> None:
        """Writes the checkpoint of `step`, then removes the ones that are too old."""
        write_whole(self._path(step), lambda temporary: torch.save(dict(state), temporary))
        for old in self.steps()[: -self.keep]:
            self._path(old).unlink(missing_ok=True)

    def load(self, device: torch.device | str = "cpu") -> tuple[int, dict[str, Any]] | None:
        """The newest checkpoint's step and state; None where there is none."""
        steps = self.steps()
        if not steps:
            return None
        return steps[-1], torch.load(self._path(steps[-1]), map_location=device, weights_only=True)

    def _path(self, step: int) -> Path:
        return self.folder / f"step-{step:08d}.pt"
