"""Checkpoints that survive a kill at any moment, and that are noticed when they are damaged; they are read back without
running code.

Knows nothing of what the tensors mean.
"""

from __future__ import annotations

import hashlib
import io
import logging
import pickle
import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import torch

from stmc.io.files import write_whole

logger = logging.getLogger(__name__)

_DIGEST = hashlib.sha256().digest_size
"""Bytes at the end of a checkpoint: the SHA-256 of all before them, which is what `torch.save` wrote."""


class CheckpointError(ValueError):
    """A checkpoint that cannot be gone on from, or a folder without any other; the message says why."""


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
        """Writes the checkpoint of `step`, then removes the ones that are too old, and damaged ones of later steps."""
        content = io.BytesIO()
        torch.save(dict(state), content)
        content.write(hashlib.sha256(content.getbuffer()).digest())
        write_whole(self._path(step), lambda temporary: temporary.write_bytes(content.getbuffer()))
        steps = self.steps()
        kept = [known for known in steps if known <= step][-self.keep :]
        for other in set(steps) - set(kept):
            self._path(other).unlink(missing_ok=True)

    def restore(self, fill: Callable[[int, dict[str, Any]], None], device: torch.device | str = "cpu") -> int:
        """Gives the newest whole checkpoint's step and state to `fill`; returns the step, 0 where there is nothing.

        One that is damaged, or that `fill` refuses with a `CheckpointError` of its own, is passed over with a warning.
        Raises `CheckpointError` where none is left.
        """
        damaged: list[str] = []
        for step in reversed(self.steps()):
            try:
                fill(step, self._read(step, device))
            except CheckpointError as error:
                damaged.append(f"{self._path(step).name} is damaged ({error})")
                continue
            if damaged:
                logger.warning("%s: %s; going on from step %d", self.folder, ", ".join(damaged), step)
            return step
        if damaged:
            raise CheckpointError(f"{self.folder}: {', '.join(damaged)}; remove this folder to begin anew")
        return 0

    def _read(self, step: int, device: torch.device | str) -> dict[str, Any]:
        """Raises `CheckpointError` for a file that is not as it was written."""
        content = memoryview(self._path(step).read_bytes())
        if hashlib.sha256(content[:-_DIGEST]).digest() != content[-_DIGEST:]:
            raise CheckpointError("checksum")
        try:
            return torch.load(io.BytesIO(content[:-_DIGEST]), map_location=device, weights_only=True)
        except pickle.UnpicklingError as error:
            raise CheckpointError("it holds more than tensors and plain data") from error

    def _path(self, step: int) -> Path:
        return self.folder / f"step-{step:08d}.pt"
