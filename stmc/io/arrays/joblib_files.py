"""Lists of dicts written by joblib, such as TEACH's `.pth.tar` files of AMASS, read without executing their code.

Such a file is a pickle in which each array is an object that names its type and shape, followed in the stream by the
bytes of the array. It is read like other untrusted pickles (see `pickles`): every name becomes harmless or is rejected.
Depends on joblib's format since version 0.10; independent of the names of arrays.
"""

from __future__ import annotations

import io
import mmap
import pickle
import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from stmc.io.arrays.numpy_files import ArraysError
from stmc.io.arrays.pickles import Dispatch, SafeUnpickler, StandIn, array_of, as_array, byte_count

LARGEST = 2**29
"""Maximum size of a compressed file's content in bytes; a plain file is memory-mapped, whatever its size."""
_UNSUPPORTED_COMPRESSIONS = {
    b"BZ": "bz2",
    b"\xfd7zXZ": "xz",
    b"]\x00": "lzma",
    b'\x04"M\x18': "lz4",
    b"ZF": "that of joblib 0.9",
}
"""Compressions that joblib supports and this reader does not, by the first bytes of a file."""

_ALIGNMENT = 16
"""Bytes to which joblib 1.2 and later align an array; the byte before the padding holds its length."""


def read_joblib(path: Path, arrays: Sequence[str], texts: Sequence[str] = ()) -> list[dict[str, np.ndarray | str]]:
    """Read the named `arrays` and `texts` of every dict in a list written by joblib; other entries are ignored.

    The file is plain, or compressed by zlib or gzip. Arrays of a plain file are memory-mapped, read only, so that the
    file may be larger than the memory; a compressed file is decompressed in memory, up to `LARGEST` bytes. Numbers
    become arrays without axes.

    Args:
        path: The file.
        arrays: Names of the arrays.
        texts: Names of the texts.

    Raises:
        ArraysError: If the file refers to a function or class other than arrays, is damaged, or has another format.
    """
    try:
        content = _content(path)
        records = _Unpickler(content).load()
        if not isinstance(records, list) or not all(isinstance(record, dict) for record in records):
            raise ArraysError("it is not a list of dicts")
        return [_select(record, number, arrays, texts) for number, record in enumerate(records)]
    except ArraysError as error:
        raise ArraysError(f"{path}: {error}") from error
    except Exception as error:  # a damaged pickle can raise any exception
        reason = f"{type(error).__name__}: {error}"[:200]
        raise ArraysError(f"{path} is not a joblib file, or is damaged: {reason}") from error


def _select(record: dict, number: int, arrays: Sequence[str], texts: Sequence[str]) -> dict[str, np.ndarray | str]:
    if missing := [name for name in (*arrays, *texts) if name not in record]:
        raise ArraysError(f"entry {number} has no {', '.join(missing)}")
    for name in texts:
        if not isinstance(record[name], str):
            raise ArraysError(f"{name} of entry {number} is a {type(record[name]).__name__}, not a text")
    values = {name: as_array(record[name], f"{name} of entry {number}") for name in arrays}
    return values | {name: record[name] for name in texts}


def _content(path: Path) -> bytes | mmap.mmap:
    """Return the bytes of the pickle, decompressed if necessary."""
    with path.open("rb") as file:
        beginning = file.read(8)
        for mark, name in _UNSUPPORTED_COMPRESSIONS.items():
            if beginning.startswith(mark):
                raise ArraysError(f"its compression, {name}, is not supported; supported are none, zlib and gzip")
        if not beginning:
            raise ArraysError("it is empty")
        if not _is_packed(beginning):
            return mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
        file.seek(0)
        unpacking = zlib.decompressobj(32 + zlib.MAX_WBITS)  # zlib or gzip, according to the first bytes
        unpacked = io.BytesIO()
        while not unpacking.eof and (packed := unpacking.unconsumed_tail or file.read(2**20)):
            unpacked.write(unpacking.decompress(packed, 2**24))
            if unpacked.tell() > LARGEST:
                raise ArraysError(f"its content exceeds {LARGEST} bytes; save it without compression")
        if not unpacking.eof:
            raise ArraysError("it is truncated")
        return unpacked.getvalue()


def _is_packed(beginning: bytes) -> bool:
    """Return whether a file starts like gzip, or like zlib (its two bytes are a multiple of 31 and name deflate)."""
    return beginning[:2] == b"\x1f\x8b" or (
        beginning[0] & 15 == 8 and len(beginning) > 1 and int.from_bytes(beginning[:2], "big") % 31 == 0
    )


class _Wrapped(StandIn):
    """A stand-in for joblib's `NumpyArrayWrapper` until its bytes are read."""

    kind = "joblib.numpy_pickle.NumpyArrayWrapper"


class _Unpickler(SafeUnpickler):
    """A `SafeUnpickler` that also reads joblib's arrays, whose bytes follow them in the stream."""

    def __init__(self, content: bytes | mmap.mmap) -> None:
        self._bytes = memoryview(content)
        self._stream = io.BytesIO(content) if isinstance(content, bytes) else content
        super().__init__(self._stream, len(content))

    def find_class(self, module: str, name: str) -> Any:
        """Return `_Wrapped` or a class of `pickles`; raise `ArraysError` for any other name."""
        if (module, name) == ("joblib.numpy_pickle", "NumpyArrayWrapper"):
            return _Wrapped
        return super().find_class(module, name)

    def load_build(self) -> None:
        """Set the state of a stand-in, and convert joblib's arrays."""
        super().load_build()
        if isinstance(self.stack[-1], _Wrapped):
            self.stack[-1] = self._array(self.stack[-1].state)

    dispatch: ClassVar[Dispatch] = SafeUnpickler.dispatch | {pickle.BUILD[0]: load_build}

    def _array(self, state: dict) -> StandIn:
        """Read an array from the stream, and advance the stream past it."""
        if state.get("subclass") != "ndarray" or state.get("order") not in ("C", "F"):
            raise ArraysError("an array of a foreign class or in an unknown order")
        shape, dtype = state.get("shape"), state.get("dtype")
        size = byte_count(shape, dtype)
        start = self._stream.tell()
        if state.get("numpy_array_alignment_bytes") is not None:
            padding = self._stream.read(1)[0]
            if padding > _ALIGNMENT:
                raise ArraysError(f"an array with {padding} bytes of padding; at most {_ALIGNMENT} are valid")
            start += 1 + padding
        if start + size > len(self._bytes):
            raise ArraysError(f"an array of shape {shape!s:.40} extends beyond the end of the file")
        self._stream.seek(start + size)
        return array_of(self._bytes[start : start + size], dtype, shape, state["order"])
