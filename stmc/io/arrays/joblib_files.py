"""Lists of dicts as joblib writes them, such as TEACH's `.pth.tar` files of AMASS, without running the files' code.

Such a file is a pickle in which each array is an object that names its type and shape, with the array's bytes behind it
in the stream. It is read as other pickles of strangers are (see `pickles`): every name becomes harmless, or is refused.
Knows joblib's format since version 0.10; knows no array by name.
"""

from __future__ import annotations

import io
import mmap
import pickle
import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from stmc.io.arrays.numpy_files import LARGEST, ArraysError
from stmc.io.arrays.pickles import SafeUnpickler, StandIn, array_of, as_array, byte_count

_UNPACKABLE = {b"BZ": "bz2", b"\xfd7zXZ": "xz", b"]\x00": "lzma", b'\x04"M\x18': "lz4", b"ZF": "that of joblib 0.9"}
"""Compressions that joblib knows and we do not, by a file's first bytes."""

_ALIGNMENT = 16
"""Bytes to which joblib 1.2 and later push an array; the number pushed stands in a byte before."""


def read_joblib(path: Path, arrays: Sequence[str], texts: Sequence[str] = ()) -> list[dict[str, np.ndarray | str]]:
    """The `arrays` and `texts` with these names of every dict in a list that joblib wrote, plain or compressed by zlib
    or gzip; what else the dicts have may be anything inert.

    Arrays of a plain file stay on the disk until they are used (memory-mapped, read only), so it may be larger than the
    memory; a compressed one is unpacked in memory, `LARGEST` bytes at most. Numbers are arrays without axes. Raises
    `ArraysError` for a file that asks for any function or class but arrays, that is damaged, or of another kind.
    """
    try:
        content = _content(path)
        records = _Unpickler(content).load()
        if not isinstance(records, list) or not all(isinstance(record, dict) for record in records):
            raise ArraysError("it is not a list of dicts")
        return [_chosen(record, number, arrays, texts) for number, record in enumerate(records)]
    except ArraysError as error:
        raise ArraysError(f"{path}: {error}") from error
    except Exception as error:  # a damaged pickle can raise whatever it likes
        reason = f"{type(error).__name__}: {error}"[:200]
        raise ArraysError(f"{path} is not a file of joblib's, or a damaged one: {reason}") from error


def _chosen(record: dict, number: int, arrays: Sequence[str], texts: Sequence[str]) -> dict[str, np.ndarray | str]:
    if missing := [name for name in (*arrays, *texts) if name not in record]:
        raise ArraysError(f"entry {number} has no {', '.join(missing)}")
    for name in texts:
        if not isinstance(record[name], str):
            raise ArraysError(f"{name} of entry {number} is a {type(record[name]).__name__}, not a text")
    found = {name: as_array(record[name], f"{name} of entry {number}") for name in arrays}
    return found | {name: record[name] for name in texts}


def _content(path: Path) -> bytes | mmap.mmap:
    """The bytes of the pickle, unpacked if need be."""
    with path.open("rb") as file:
        beginning = file.read(8)
        for mark, name in _UNPACKABLE.items():
            if beginning.startswith(mark):
                raise ArraysError(f"its compression, {name}, is not read here; those that are: none, zlib, gzip")
        if not beginning:
            raise ArraysError("it is empty")
        if not _is_packed(beginning):
            return mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
        file.seek(0)
        unpacking = zlib.decompressobj(32 + zlib.MAX_WBITS)  # zlib or gzip, as its first bytes say
        unpacked = io.BytesIO()
        while not unpacking.eof and (packed := unpacking.unconsumed_tail or file.read(2**20)):
            unpacked.write(unpacking.decompress(packed, 2**24))
            if unpacked.tell() > LARGEST:
                raise ArraysError(f"it would take more than {LARGEST} bytes; save it without compression")
        if not unpacking.eof:
            raise ArraysError("it is cut off")
        return unpacked.getvalue()


def _is_packed(beginning: bytes) -> bool:
    """Whether a file begins as gzip's do, or zlib's: its two bytes are a multiple of 31, and name deflate."""
    return beginning[:2] == b"\x1f\x8b" or (
        beginning[0] & 15 == 8 and len(beginning) > 1 and int.from_bytes(beginning[:2], "big") % 31 == 0
    )


class _Wrapped(StandIn):
    """What joblib's `NumpyArrayWrapper` becomes, until its bytes are found."""

    kind = "joblib.numpy_pickle.NumpyArrayWrapper"


class _Unpickler(SafeUnpickler):
    """That of `pickles`, but for joblib's arrays, whose bytes are behind them in the stream."""

    def __init__(self, content: bytes | mmap.mmap) -> None:
        self._bytes = memoryview(content)
        self._stream = io.BytesIO(content) if isinstance(content, bytes) else content
        super().__init__(self._stream, len(content))

    def find_class(self, module: str, name: str) -> Any:
        """`_Wrapped`, or what `pickles` has; `ArraysError` for any other name."""
        if (module, name) == ("joblib.numpy_pickle", "NumpyArrayWrapper"):
            return _Wrapped
        return super().find_class(module, name)

    def load_build(self) -> None:
        """A state, for a stand-in only; that of joblib's arrays makes them arrays."""
        super().load_build()
        if isinstance(self.stack[-1], _Wrapped):
            self.stack[-1] = self._array(self.stack[-1].state)

    dispatch = SafeUnpickler.dispatch | {pickle.BUILD[0]: load_build}

    def _array(self, state: dict) -> StandIn:
        """Of what follows in the stream, which goes on behind it."""
        if state.get("subclass") != "ndarray" or state.get("order") not in ("C", "F"):
            raise ArraysError("an array of a foreign class, or in an order that is none")
        shape, dtype = state.get("shape"), state.get("dtype")
        size = byte_count(shape, dtype)
        start = self._stream.tell()
        if state.get("numpy_array_alignment_bytes") is not None:
            padding = self._stream.read(1)[0]
            if padding > _ALIGNMENT:
                raise ArraysError(f"an array {padding} bytes behind where it should be")
            start += 1 + padding
        if start + size > len(self._bytes):
            raise ArraysError(f"an array of {shape!s:.40} numbers goes on behind the end of the file")
        self._stream.seek(start + size)
        return array_of(self._bytes[start : start + size], dtype, shape, state["order"])
