"""`.npz` and `.npy` files: plain arrays or an error in a sentence.

Knows NumPy's file formats and what a broken or hostile file does to them; knows no array by name.
"""

from __future__ import annotations

import io
import math
import pickle
import zipfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

import numpy as np

from stmc.io.untrusted import cut

LARGEST = 2**31
"""Bytes of one array, unpacked. A zip of a few kilobytes can promise to become more than any memory."""

MOST_ARRAYS = 1000
"""Of an `.npz`."""

_SHOWN = 200
"""Characters of names in a message."""


class ArraysError(ValueError):
    """A file of arrays that cannot be read or lacks one; the message names the file and what is wrong with it."""


class Header(NamedTuple):
    """The shape and the type of an array in a file."""

    shape: tuple[int, ...]
    dtype: np.dtype


def npz_headers(path: Path) -> dict[str, Header]:
    """The names of the arrays in an `.npz` and their headers, before an array is unpacked.

    Raises `ArraysError` for a file that is none, or damaged.
    """
    with _opened(path) as archive:
        names = [info.filename for info in archive.zip.infolist() if info.filename.endswith(".npy")]
        return {name.removesuffix(".npy"): _header_within(archive.zip, name, path) for name in names}


def read_npz(path: Path, required: Sequence[str], optional: Sequence[str] = ()) -> dict[str, np.ndarray]:
    """The `required` arrays of an `.npz`, and those of the `optional` ones that it has.

    Raises `ArraysError` where one is missing, damaged, pickled or larger than `LARGEST`, and for names that would leave
    a folder on unpacking, as no honest writer makes them. Nothing is ever unpacked to the disk.
    """
    with _opened(path) as archive:
        if missing := [name for name in required if name not in archive.files]:
            has = cut(", ".join(archive.files), _SHOWN) or "none"
            raise ArraysError(f"{path} has no array {', '.join(missing)}; it has {has}")
        wanted = [*required, *(name for name in optional if name in archive.files)]
        for name in wanted:
            _header_within(archive.zip, f"{name}.npy", path)
        return {name: archive[name] for name in wanted}


def read_npy(path: Path) -> np.ndarray:
    """The array of an `.npy`. Raises `ArraysError` where the file is none, damaged, pickled or too large."""
    try:
        with path.open("rb") as file:
            mark = file.read(2)
            if mark == b"PK":
                raise ArraysError(f"{path} is a zip of arrays (.npz), not one array (.npy)")
            if mark[:1] == pickle.PROTO:
                raise ArraysError(f"{path} cannot be read as .npy: {_OBJECTS}")
            file.seek(0)
            _check_header(file, path.stat().st_size, str(path))
            file.seek(0)
            return np.lib.format.read_array(file, allow_pickle=False)
    except ArraysError:
        raise
    except Exception as error:  # a damaged file can raise whatever it likes
        raise ArraysError(f"{path} cannot be read as .npy: {_reason(error)}") from error


@contextmanager
def _opened(path: Path) -> Iterator[np.lib.npyio.NpzFile]:
    try:
        with path.open("rb") as file:
            if file.read(6) == np.lib.format.MAGIC_PREFIX:
                raise ArraysError(f"{path} is one array (.npy), not a zip of arrays (.npz)")
        with np.load(path, allow_pickle=False) as archive:
            names = archive.zip.namelist()
            if len(names) > MOST_ARRAYS:
                raise ArraysError(f"{path} has {len(names)} arrays; at most {MOST_ARRAYS} are read")
            if strange := [name for name in names if "/" in name or "\\" in name or ".." in name]:
                place = f"it names {cut(strange[0], _SHOWN)!r}, a place outside of itself"
                raise ArraysError(f"{path} is not to be trusted: {place}")
            yield archive
    except ArraysError:
        raise
    except Exception as error:  # a damaged file can raise whatever it likes
        raise ArraysError(f"{path} cannot be read as .npz: {_reason(error)}") from error


def _header_within(archive: zipfile.ZipFile, name: str, path: Path) -> Header:
    """Of an array of a zip."""
    size, place = archive.getinfo(name).file_size, f"{path}: {cut(name.removesuffix('.npy'), _SHOWN)}"
    if size > LARGEST:
        raise ArraysError(f"{place} would take {size} bytes, more than the {LARGEST} of any real file")
    with archive.open(name) as file:
        return _check_header(file, size, place)


def _check_header(file: io.BufferedIOBase, size: int, place: str) -> Header:
    """The header of an array in a file of `size` bytes, which the array must fill."""
    version = np.lib.format.read_magic(file)
    read = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}.get(version)
    if read is None:
        raise ArraysError(f"{place} is in version {version[0]}.{version[1]} of the format; 1.0 and 2.0 are read")
    shape, _, dtype = read(file)
    if dtype.hasobject:
        raise ArraysError(f"{place} cannot be read: {_OBJECTS}")
    expected = math.prod(shape) * dtype.itemsize
    if size > LARGEST or min((*shape, 0)) < 0 or expected > size:
        raise ArraysError(f"{place} should hold {expected} bytes; the file has {size}, and {LARGEST} are the limit")
    return Header(shape, dtype)


_OBJECTS = "it holds pickled Python objects, which could run code"


def _reason(error: Exception) -> str:
    text = cut(" ".join(str(error).split()), _SHOWN) or type(error).__name__
    return _OBJECTS if "pickle" in text else text
