"""Validation of PyTorch checkpoints before PyTorch reads them: their pickles terminate, whatever they contain.

PyTorch's own reader of plain weights executes no code of a file, but it hashes the keys of dicts, and a key of a few
hundred bytes can be a tuple of 2**34 steps. Depends on the two layouts that `torch.save` writes; independent of the
names of weights.
"""

from __future__ import annotations

import io
import pickle
import zipfile
from pathlib import Path
from typing import Any, ClassVar

from stmc.io.arrays.numpy_files import LARGEST, ArraysError
from stmc.io.arrays.pickles import Dispatch, SafeUnpickler, StandIn

_LEGACY = 5
"""Number of pickles at the beginning of a file of PyTorch before 1.6: magic number, version, system, content, names of
the storages."""


def check_checkpoint(path: Path) -> None:
    """Raise `ArraysError` if a checkpoint has keys that are neither texts nor numbers; other damage is not detected."""
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
    """A stand-in for any name, and for the result of calling it."""

    def __call__(self, *_: object) -> _Callable:
        return self


class _Inert(SafeUnpickler):
    """An unpickler that replaces every name by a stand-in and discards its state."""

    def find_class(self, module: str, name: str) -> Any:
        """Return a harmless callable for any name."""
        return self._dict if (module, name) == ("collections", "OrderedDict") else _Callable

    def persistent_load(self, pid: object) -> _Callable:
        """Return a stand-in for a storage."""
        return _Callable()

    def load_build(self) -> None:
        """Discard a state."""
        self.stack.pop()

    dispatch: ClassVar[Dispatch] = SafeUnpickler.dispatch | {pickle.BUILD[0]: load_build}
