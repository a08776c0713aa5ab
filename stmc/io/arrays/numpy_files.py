"""`.npz` and `.npy` files: plain arrays, or an error in one sentence.

Depends on NumPy's file formats and handles broken or hostile files; independent of the names of arrays.
"""

from __future__ import annotations

import io
import math
import pickle
import zipfile
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import IO, NamedTuple

import numpy as np

from stmc.io.untrusted import truncate

LARGEST = 2**31
"""Maximum size in bytes of the arrays that are read at once. A zip of a few kilobytes can expand beyond any memory."""
LARGEST_BY_COLUMNS = 2**28
"""Maximum size in bytes of an array in Fortran order that is read in chunks of rows: it is read whole."""
MOST_ARRAYS = 1000
"""Maximum number of arrays in an `.npz`."""
_SHOWN = 200
"""Maximum number of characters of names in a message."""


class ArraysError(ValueError):
    """A file of arrays that cannot be read or lacks an array; the message names the file and the reason."""


class Header(NamedTuple):
    """The shape and dtype of an array in a file."""

    shape: tuple[int, ...]
    dtype: np.dtype

    @property
    def size(self) -> int:
        """Size of the array in bytes."""
        return math.prod(self.shape) * self.dtype.itemsize


def npz_headers(path: Path) -> dict[str, Header]:
    """Read the names and headers of the arrays in an `.npz` without decompressing an array.

    Raises `ArraysError` if the file is not an `.npz`, or is damaged.
    """
    with _open_npz(path) as (_, archive):
        names = [info.filename for info in archive.infolist() if info.filename.endswith(".npy")]
        return {name.removesuffix(".npy"): _read_header(archive, name, path) for name in names}


def read_npz(
    path: Path, required: Sequence[str], optional: Sequence[str] = (), most: int | None = None
) -> dict[str, np.ndarray]:
    """Read the `required` arrays of an `.npz`, and the `optional` ones that exist.

    Nothing is ever extracted to disk.

    Args:
        path: The file.
        required: Names of arrays that must exist.
        optional: Names of arrays that may exist.
        most: Maximum size of all these arrays in bytes; None is `LARGEST`.

    Raises:
        ArraysError: If an array is missing, damaged or pickled, if the arrays are too large, or if a name would leave
            its folder on extraction.
    """
    with _open_npz(path) as (arrays, archive):
        if missing := [name for name in required if name not in arrays.files]:
            has = truncate(", ".join(arrays.files), _SHOWN) or "none"
            raise ArraysError(f"{path} has no array {', '.join(missing)}; it has {has}")
        names = [*required, *(name for name in optional if name in arrays.files)]
        total = sum(_read_header(archive, f"{name}.npy", path).size for name in names)
        if total > (most or LARGEST):
            raise ArraysError(f"{path}: {', '.join(names)} have {total} bytes; the limit is {most or LARGEST}")
        return {name: arrays[name] for name in names}


def read_npz_chunks(path: Path, names: Sequence[str], rows: int) -> Iterator[dict[str, np.ndarray]]:
    """Yield arrays of an `.npz` that have equally many rows, in chunks of at most `rows` rows.

    Only a chunk is in memory at a time; arrays in Fortran order are read whole. Raises `ArraysError` as `read_npz`, and
    for arrays in Fortran order above `LARGEST_BY_COLUMNS`.
    """
    with _open_npz(path) as (arrays, archive), ExitStack() as files:
        headers: dict[str, Header] = {}
        streams: dict[str, IO[bytes] | io.BufferedIOBase] = {}
        for name in names:
            headers[name] = _read_header(archive, f"{name}.npy", path)
            streams[name] = files.enter_context(archive.open(f"{name}.npy"))
            if _skip_header(streams[name]):
                if headers[name].size > LARGEST_BY_COLUMNS:
                    raise ArraysError(f"{path}: {name} is too large for Fortran order; save it with order='C'")
                streams[name] = io.BytesIO(np.ascontiguousarray(arrays[name]).tobytes())
        total = min(header.shape[0] for header in headers.values())
        for start in range(0, total, rows):
            count = min(rows, total - start)
            yield {name: _next_rows(streams[name], header, count) for name, header in headers.items()}
        for stream in streams.values():
            stream.read(1)  # at the end of an array, zipfile compares its checksum


def _skip_header(file: IO[bytes] | io.BufferedIOBase) -> bool:
    """Move behind the header of an array, and return whether the array is in Fortran order."""
    version = np.lib.format.read_magic(file)
    read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
    return bool(read(file)[1])


def _next_rows(file: IO[bytes] | io.BufferedIOBase, header: Header, count: int) -> np.ndarray:
    """Read the next `count` rows. Raises `ValueError` at the end of the file."""
    shape = (count, *header.shape[1:])
    return np.frombuffer(file.read(math.prod(shape) * header.dtype.itemsize), header.dtype).reshape(shape)


def read_npy(path: Path, most: int | None = None) -> np.ndarray:
    """Read the array of an `.npy` of at most `most` bytes; None is `LARGEST`.

    Raises `ArraysError` if the file is damaged, pickled, too large or in another format.
    """
    try:
        with path.open("rb") as file:
            mark = file.read(2)
            if mark == b"PK":
                raise ArraysError(f"{path} is a zip of arrays (.npz), not one array (.npy)")
            if mark[:1] == pickle.PROTO:
                raise ArraysError(f"{path} cannot be read as .npy: {_OBJECTS}")
            file.seek(0)
            _check_header(file, path.stat().st_size, str(path), most)
            file.seek(0)
            return np.lib.format.read_array(file, allow_pickle=False)
    except ArraysError:
        raise
    except Exception as error:  # a damaged file can raise any exception
        raise ArraysError(f"{path} cannot be read as .npy: {_reason(error)}") from error


@contextmanager
def _open_npz(path: Path) -> Iterator[tuple[np.lib.npyio.NpzFile, zipfile.ZipFile]]:
    """Open an `.npz` as NumPy's reader and as the zip below it."""
    try:
        with path.open("rb") as file:
            if file.read(6) == np.lib.format.MAGIC_PREFIX:
                raise ArraysError(f"{path} is one array (.npy), not a zip of arrays (.npz)")
        with np.load(path, allow_pickle=False) as arrays:
            archive = arrays.zip
            names = archive.namelist()
            if len(names) > MOST_ARRAYS:
                raise ArraysError(f"{path} has {len(names)} arrays; at most {MOST_ARRAYS} are read")
            if unsafe := [name for name in names if "/" in name or "\\" in name or ".." in name]:
                place = f"it names {truncate(unsafe[0], _SHOWN)!r}, a path outside of the archive"
                raise ArraysError(f"{path} is not safe to read: {place}")
            yield arrays, archive
    except ArraysError:
        raise
    except Exception as error:  # a damaged file can raise any exception
        raise ArraysError(f"{path} cannot be read as .npz: {_reason(error)}") from error


def _read_header(archive: zipfile.ZipFile, name: str, path: Path) -> Header:
    """Read and check the header of an array in a zip."""
    size, place = archive.getinfo(name).file_size, f"{path}: {truncate(name.removesuffix('.npy'), _SHOWN)}"
    if size > LARGEST:
        raise ArraysError(f"{place} has {size} bytes; the limit is {LARGEST}")
    with archive.open(name) as file:
        return _check_header(file, size, place)


def _check_header(file: IO[bytes] | io.BufferedIOBase, size: int, place: str, most: int | None = None) -> Header:
    """Read the header of an array, and check that the array fits in a file of `size` bytes, at most `most`."""
    version = np.lib.format.read_magic(file)
    reader = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}.get(version)
    if reader is None:
        raise ArraysError(f"{place} uses version {version[0]}.{version[1]} of the format; 1.0 and 2.0 are supported")
    shape, _, dtype = reader(file)
    if dtype.hasobject:
        raise ArraysError(f"{place} cannot be read: {_OBJECTS}")
    header, most = Header(shape, dtype), most or LARGEST
    if size > most or min((*shape, 0)) < 0 or header.size > size:
        raise ArraysError(f"{place} should hold {header.size} bytes; the file has {size}, and {most} are the limit")
    return header


_OBJECTS = "it holds pickled Python objects, which could run code"


def _reason(error: Exception) -> str:
    text = truncate(" ".join(str(error).split()), _SHOWN) or type(error).__name__
    return _OBJECTS if "pickle" in text else text
