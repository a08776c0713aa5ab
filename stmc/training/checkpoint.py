"""Checkpoints that survive a kill at any moment, detect damage, and are read without running code."""

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
"""Number of bytes at the end of a checkpoint: the SHA-256 of the bytes that `torch.save` wrote before them."""


class CheckpointError(ValueError):
    """Error for a checkpoint, or a folder of checkpoints, from which training cannot resume; the message says why."""


class Checkpoints:
    """The last `keep` checkpoints in a folder, one file each, named by the number of completed steps."""

    def __init__(self, folder: Path, keep: int = 2) -> None:
        if keep < 1:
            raise ValueError(f"keep={keep}: at least one checkpoint must be kept")
        self.folder, self.keep = Path(folder), keep

    def steps(self) -> list[int]:
        """List the steps of all checkpoints in ascending order."""
        names = [re.fullmatch(r"step-(\d+)\.pt", path.name) for path in self.folder.glob("step-*.pt")]
        return sorted(int(match[1]) for match in names if match)

    def save(self, step: int, state: Mapping[str, Any]) -> None:
        """Write the checkpoint of `step`, then remove old ones, and damaged ones of later steps."""
        content = io.BytesIO()
        torch.save(dict(state), content)
        content.write(hashlib.sha256(content.getbuffer()).digest())
        write_whole(self._path(step), lambda temporary: temporary.write_bytes(content.getbuffer()))
        steps = self.steps()
        kept = [known for known in steps if known <= step][-self.keep :]
        for other in set(steps) - set(kept):
            self._path(other).unlink(missing_ok=True)

    def restore(self, fill: Callable[[int, dict[str, Any]], None], device: torch.device | str = "cpu") -> int:
        """Pass step and state of the newest intact checkpoint to `fill`; return the step, or 0 without checkpoints.

        A damaged checkpoint, or one that `fill` rejects with a `CheckpointError`, is skipped with a warning. Raises
        `CheckpointError` if none is usable.
        """
        damaged: list[str] = []
        for step in reversed(self.steps()):
            try:
                fill(step, self._read(step, device))
            except CheckpointError as error:
                damaged.append(f"{self._path(step).name} is damaged ({error})")
                continue
            if damaged:
                logger.warning("%s: %s; resuming from step %d", self.folder, ", ".join(damaged), step)
            return step
        if damaged:
            raise CheckpointError(f"{self.folder}: {', '.join(damaged)}; remove this folder to start from scratch")
        return 0

    def _read(self, step: int, device: torch.device | str) -> dict[str, Any]:
        """Read a checkpoint. Raises `CheckpointError` for a damaged file."""
        content = memoryview(self._path(step).read_bytes())
        if hashlib.sha256(content[:-_DIGEST]).digest() != content[-_DIGEST:]:
            raise CheckpointError("its checksum is wrong")
        try:
            return torch.load(io.BytesIO(content[:-_DIGEST]), map_location=device, weights_only=True)
        except pickle.UnpicklingError as error:
            raise CheckpointError("it contains more than tensors and plain data") from error

    def _path(self, step: int) -> Path:
        return self.folder / f"step-{step:08d}.pt"
