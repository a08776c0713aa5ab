"""Checkpoints that survive a kill at any moment; they are read back without running code.

Knows nothing of what the tensors mean.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch

from stmc.files import write_whole


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
