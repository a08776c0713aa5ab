"""`.npz` and `.npy` files: plain arrays or an error in a sentence.

Knows NumPy's file formats and what a broken or hostile file does to them; knows no array by name.
"""

from __future__ import annotations

import zipfile
import zlib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import numpy as np

LARGEST = 2**31
"""Bytes of one array, unpacked. A zip of a few kilobytes can promise to become more than any memory."""

_BROKEN = (ValueError, OSError, EOFError, KeyError, MemoryError, RuntimeError, zipfile.BadZipFile, zlib.error)
"""What NumPy and `zipfile` raise for files that are cut off, encrypted, of another kind, or hold pickled objects."""


class ArraysError(ValueError):
    """A file of arrays that cannot be read or lacks one; the message names the file and what is wrong with it."""


def npz_names(path: Path) -> tuple[str, ...]:
    """The names of the arrays in an `.npz`. Raises `ArraysError` for a file that is none, or damaged."""
    with _opened(path) as archive:
        return tuple(archive.files)


def read_npz(path: Path, required: Sequence[str], optional: Sequence[str] = ()) -> dict[str, np.ndarray]:
    """The `required` arrays of an `.npz`, and those of the `optional` ones that it has.

    Raises `ArraysError` where one is missing, damaged, pickled or larger than `LARGEST`, and for names that would leave
    a folder on unpacking, as no honest writer makes them. Nothing is ever unpacked to the disk.
    """
    with _opened(path) as archive:
        if missing := [name for name in required if name not in archive.files]:
            raise ArraysError(f"{path} has no array {', '.join(missing)}; it has {', '.join(archive.files) or 'none'}")
        wanted = [*required, *(name for name in optional if name in archive.files)]
        for name in wanted:
            size = archive.zip.getinfo(f"{name}.npy").file_size
            if size > LARGEST:
                raise ArraysError(f"{path}: {name} would take {size} bytes, more than the {LARGEST} of any real file")
        return {name: _plain(archive[name], f"{path}: {name}") for name in wanted}


def read_npy(path: Path) -> np.ndarray:
    """The array of an `.npy`. Raises `ArraysError` where the file is none, damaged, pickled or too large."""
    try:
        if path.stat().st_size > LARGEST:
            raise ArraysError(f"{path} is larger than the {LARGEST} bytes of any real file")
        array = np.load(path, allow_pickle=False)
    except ArraysError:
        raise
    except _BROKEN as error:
        raise ArraysError(f"{path} cannot be read as .npy: {_reason(error)}") from error
    if not isinstance(array, np.ndarray):
        array.close()
        raise ArraysError(f"{path} is a zip of arrays (.npz), not one array (.npy)")
    return _plain(array, str(path))


@contextmanager
def _opened(path: Path) -> Iterator[np.lib.npyio.NpzFile]:
    try:
        archive = np.load(path, allow_pickle=False)
        if isinstance(archive, np.ndarray):
            raise ArraysError(f"{path} is one array (.npy), not a zip of arrays (.npz)")
        with archive:
            if strange := [name for name in archive.zip.namelist() if "/" in name or "\\" in name or ".." in name]:
                raise ArraysError(f"{path} is not to be trusted: it names {strange[0]!r}, a place outside of itself")
            yield archive
    except ArraysError:
        raise
    except _BROKEN as error:
        raise ArraysError(f"{path} cannot be read as .npz: {_reason(error)}") from error


def _plain(array: np.ndarray, place: str) -> np.ndarray:
    if array.dtype.hasobject:
        raise ArraysError(f"{place} holds Python objects, not numbers")
    return array


def _reason(error: BaseException) -> str:
    text = " ".join(str(error).split()) or type(error).__name__
    if "allow_pickle" in text or "pickle" in text:
        return "it holds pickled Python objects, which could run code"
    return text
