"""PyTorch's checkpoints before PyTorch reads them: their pickles end, whatever they hold.

PyTorch's own reader of plain weights runs no code of a file, but it hashes the keys of dicts, and a key of a few
hundred bytes can be a tuple of 2**34 steps. Knows the two layouts that `torch.save` writes; knows no weight by name.
"""

from __future__ import annotations

import io
import pickle
import zipfile
from pathlib import Path
from typing import Any

from stmc.io.arrays.numpy_files import LARGEST, ArraysError
from stmc.io.arrays.pickles import SafeUnpickler, StandIn

_LEGACY = 5
"""Pickles at the beginning of a file of PyTorch before 1.6: mark, version, system, content, names of the storages."""


def check_checkpoint(path: Path) -> None:
    """Raise `ArraysError` for a checkpoint with keys that are neither texts nor numbers; damage may remain."""
    if not zipfile.is_zipfile(path):
        with path.open("rb") as file:
            _check(io.BytesIO(file.read(LARGEST)), _LEGACY)
        return
    with zipfile.ZipFile(path) as archive:
        for info in archive.infolist():
            if info.filename.endswith(".pkl"):
                if info.file_size > LARGEST:
                    raise ArraysError(f"a pickle of {info.file_size} bytes")
                _check(io.BytesIO(archive.read(info)), 1)


def _check(stream: io.BytesIO, pickles: int) -> None:
    size = len(stream.getbuffer())
    for _ in range(pickles):
        _Inert(stream, size).load()


class _Callable(StandIn):
    """What a name becomes, and what is made by calling it."""

    def __call__(self, *_: object) -> _Callable:
        return self


class _Inert(SafeUnpickler):
    """Every name is a stand-in; nothing is kept of it."""

    def find_class(self, module: str, name: str) -> Any:
        """A harmless callable, for any name."""
        return self._dict if (module, name) == ("collections", "OrderedDict") else _Callable

    def persistent_load(self, pid: object) -> _Callable:
        """What a storage becomes."""
        return _Callable()

    def load_build(self) -> None:
        """A state, which is left aside."""
        self.stack.pop()

    dispatch = SafeUnpickler.dispatch | {pickle.BUILD[0]: load_build}
