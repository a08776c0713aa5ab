"""Arrays in pickles of others, such as SMPL's `.pkl` files, without running the pickles' code.

A pickle is a program: it names functions and calls them. Here every name becomes one of our own few, harmless
callables, or a stand-in that only remembers its state; anything else is refused. So neither chumpy (which SMPL's files
need, and which no longer installs) nor SciPy is imported on a file's behalf, and NumPy's own `__setstate__`, which
believes whatever a file says of memory, never sees one: an array is made of its vetted fields once it is asked for.
Knows NumPy's, SciPy's and chumpy's way of pickling arrays; knows no array by name.
"""

from __future__ import annotations

import io
import math
import mmap
import pickle
import struct
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from stmc.arrays.numpy_files import LARGEST, ArraysError

_SPARSE = ("csc", "csr", "coo")
_LARGEST_MATRIX = 2**27
"""Bytes of a sparse matrix once it is dense; SMPL-X's regressor has 2**22."""

_NUMPY = ("numpy.core", "numpy._core")
"""Where NumPy's own functions of this name lived before and after version 2."""
_KINDS = "biufSU"
"""Of arrays that are read: booleans, whole numbers, floats, bytes and texts."""


def read_pickle(path: Path, required: Sequence[str], optional: Sequence[str] = ()) -> dict[str, np.ndarray]:
    """The `required` arrays of a pickled dict, and those of the `optional` ones that it has, all of them dense.

    NumPy arrays, SciPy's sparse matrices, numbers, and chumpy's constants and selections are arrays; entries that are
    not asked for may be anything inert. Raises `ArraysError` for a pickle that asks for any other function or class, or
    is damaged, and where an array is missing.
    """
    content = _loaded(path)
    if not isinstance(content, dict):
        raise ArraysError(f"{path} holds a {type(content).__name__}, not a dict of arrays")
    if missing := [name for name in required if name not in content]:
        raise ArraysError(f"{path} has no array {', '.join(missing)}; it has {_names(content)}")
    wanted = [*required, *(name for name in optional if name in content)]
    try:
        return {name: as_array(content[name], name) for name in wanted}
    except ArraysError as error:
        raise ArraysError(f"{path}: {error}") from error


def read_places(path: Path) -> dict[str, int]:
    """A pickled dict of texts and whole numbers, as lists of words with their places are kept.

    Raises `ArraysError` for anything else, as `read_pickle` does.
    """
    content = _loaded(path)
    if not isinstance(content, dict):
        raise ArraysError(f"{path} holds a {type(content).__name__}, not a dict of words and their places")
    places = {key: as_array(value, "a place") for key, value in content.items() if isinstance(key, str)}
    if len(places) < len(content) or any(each.ndim or each.dtype.kind not in "iu" for each in places.values()):
        raise ArraysError(f"{path} must hold words and whole numbers only")
    return {key: int(value) for key, value in places.items()}


def _loaded(path: Path) -> Any:
    if path.stat().st_size > LARGEST:
        raise ArraysError(f"{path} is larger than the {LARGEST} bytes of any real file")
    try:
        return SafeUnpickler(io.BytesIO(path.read_bytes())).load()
    except ArraysError as error:
        raise ArraysError(f"{path}: {error}") from error
    except Exception as error:  # a damaged pickle can raise whatever it likes
        reason = f"{type(error).__name__}: {error}"[:200]
        raise ArraysError(f"{path} is not a pickle, or a damaged one: {reason}") from error


class StandIn:
    """What an object of a foreign class becomes: its class's name and its state. Nothing of the class is run."""

    kind = ""

    def __new__(cls, *_: object) -> StandIn:
        made = object.__new__(cls)
        made.state = {}
        return made

    def __init__(self, *_: object) -> None:
        pass

    def __setstate__(self, state: object) -> None:
        self.state = state if isinstance(state, dict) else {}


class _Type(StandIn):
    """What a dtype becomes: its name and the rest of its state, of which only the byte order means anything."""

    def __init__(self, name: object = "", *_: object) -> None:
        self.name = name

    def __setstate__(self, state: object) -> None:
        self.state = state

    @property
    def dtype(self) -> np.dtype:
        """Of a plain kind; `ArraysError` for fields, objects, sub-arrays, and sizes or offsets of the file's choice."""
        if not isinstance(self.name, str) or self.name.strip("<>=|")[:1] not in ("?", "b", *_KINDS):
            raise ArraysError(_OBJECTS if str(self.name)[:1] == "O" else f"numbers of the type {self.name!r:.40}")
        dtype = np.dtype(self.name)
        if dtype.kind not in _KINDS or not dtype.itemsize:
            raise ArraysError(f"numbers of the type {self.name!r:.40}")
        if self.state == {}:
            return dtype
        if not isinstance(self.state, tuple) or len(self.state) != 8:
            raise ArraysError("a type of numbers with a state that NumPy does not write")
        _, order, *structure, size, alignment = self.state[:7]
        inherent = (dtype.itemsize, np.dtype(dtype.char).alignment) if dtype.kind in "SU" else (-1, -1)
        if order not in ("<", ">", "|", "=") or structure != [None, None, None] or (size, alignment) != inherent:
            raise ArraysError("a type of numbers with fields, or with sizes of its own")
        return dtype.newbyteorder(order)


class _Array(StandIn):
    """What an array becomes: its state (version, shape, type, whether in Fortran's order, bytes)."""

    def __setstate__(self, state: object) -> None:
        self.state = state

    @property
    def array(self) -> np.ndarray:
        """The array of its fields, once they fit one another."""
        if not isinstance(self.state, tuple) or len(self.state) != 5:
            raise ArraysError("an array with a state that NumPy does not write")
        _, shape, type_, fortran, content = self.state
        if isinstance(content, list):
            raise ArraysError(_OBJECTS)
        raw, order = content.encode("latin1") if isinstance(content, str) else content, "F" if fortran else "C"
        size = byte_count(shape, type_)
        if not isinstance(raw, (bytes, bytearray, memoryview)) or size != len(raw):
            raise ArraysError(f"an array of {shape!s:.40} numbers in another number of bytes")
        if isinstance(raw, memoryview):  # of a file, where it stays until it is used
            return np.ndarray(shape, type_.dtype, raw, order=order)
        return np.ndarray(shape, type_.dtype, bytes(raw), order=order).copy(order="K")


_OBJECTS = "Python objects, not numbers"


def byte_count(shape: object, type_: object) -> int:
    """What an array of this shape and type takes. Raises `ArraysError` where a file's are none."""
    if not isinstance(type_, _Type) or not isinstance(shape, tuple) or not all(map(_is_size, shape)):
        raise ArraysError("an array without a shape or a type")
    return math.prod(shape) * type_.dtype.itemsize


def array_of(content: object, type_: object, shape: object, order: object) -> StandIn:
    """A stand-in for an array, of fields that are vetted once it is asked for; `order` as NumPy has it, "C" or "F"."""
    made = _Array()
    made.__setstate__((1, shape, type_, order == "F", content))
    return made


def _is_size(size: object) -> bool:
    return isinstance(size, int) and not isinstance(size, bool) and 0 <= size <= LARGEST


class SafeUnpickler(pickle._Unpickler):
    """`find_class` is the only door between a pickle and Python; a file can change nothing that comes out of it.

    The stream must give no more bytes than it has, whatever it is asked for. In Python, since the one in C asks for as
    much memory as a six-byte file says, and lets a file set attributes of whatever it can reach.
    """

    def __init__(self, stream: io.BytesIO | mmap.mmap) -> None:
        super().__init__(stream, encoding="latin1")  # Python 2's bytes, as SMPL's files have them

    def find_class(self, module: str, name: str) -> Any:
        """One of the harmless callables below, or a stand-in's class; `ArraysError` for any other name."""
        ours = {
            **{(f"{home}.multiarray", "_reconstruct"): self._empty for home in _NUMPY},
            **{(f"{home}.multiarray", "scalar"): self._scalar for home in _NUMPY},
            **{(f"{home}.numeric", "_frombuffer"): array_of for home in _NUMPY},
            ("numpy", "dtype"): self._dtype,
            ("numpy", "ndarray"): "ndarray",
            ("copy_reg", "_reconstructor"): self._made,
            ("copyreg", "_reconstructor"): self._made,
            ("copyreg", "__newobj__"): self._made,
            ("_codecs", "encode"): self._encoded,
            ("__builtin__", "object"): "object",
            ("builtins", "object"): "object",
            ("collections", "OrderedDict"): dict,
            ("__builtin__", "set"): frozenset,
            ("builtins", "set"): frozenset,
            ("__builtin__", "bytes"): self._no_bytes,
        }
        if (module, name) in ours:
            return ours[module, name]
        if module.split(".")[0] == "chumpy" or (module.startswith("scipy.sparse") and name[:3] in _SPARSE):
            return type("StandIn", (StandIn,), {"kind": f"{module}.{name}"[:100]})
        raise ArraysError(f"refused to run {f'{module}.{name}':.100}: this is not a file of arrays alone")

    def load_build(self) -> None:
        """A state, for a stand-in only."""
        state = self.stack.pop()
        if not isinstance(self.stack[-1], StandIn):
            raise ArraysError(f"a state for a {type(self.stack[-1]).__name__}: this is not a file of arrays alone")
        self.stack[-1].__setstate__(state)

    def load_bytearray8(self) -> None:
        """Bytes that are there; Python's own would first fill as much memory as the file says."""
        (size,) = struct.unpack("<Q", self.read(8))
        self.append(bytearray(self.read(size)))

    dispatch = pickle._Unpickler.dispatch | {pickle.BUILD[0]: load_build, pickle.BYTEARRAY8[0]: load_bytearray8}

    def _empty(self, kind: object, *_: object) -> _Array:
        if kind != "ndarray":
            raise ArraysError("an array of a foreign class")
        return _Array()

    def _dtype(self, name: object, *_: object) -> _Type:
        return _Type(name)

    def _scalar(self, dtype: object, raw: object = b"") -> StandIn:
        return array_of(raw, dtype, (), "C")

    def _made(self, kind: object, *_: object) -> StandIn:
        if not (isinstance(kind, type) and issubclass(kind, StandIn)):
            raise ArraysError(f"an object of a class that is not to be built: {kind!r:.60}")
        return kind()

    def _no_bytes(self) -> bytes:
        """What older protocols call for empty bytes; with a number it would be so many."""
        return b""

    def _encoded(self, text: str, encoding: str = "latin1") -> bytes:
        if encoding not in ("latin1", "latin-1"):
            raise ArraysError(f"bytes in the encoding {encoding!r:.40}")
        return text.encode("latin1")


def _names(content: dict) -> str:
    """Of what a file holds, the first few."""
    names = [name if isinstance(name, str) else type(name).__name__ for name in content]
    return f"{', '.join(names)[:200]}{'…' if len(', '.join(names)) > 200 else ''}"


def as_array(value: object, name: str) -> np.ndarray:
    """The dense array of what the unpickler made. Raises `ArraysError`, with the name, for what is none."""
    if isinstance(value, (int, float)):
        return np.asarray(value)
    if not isinstance(value, StandIn):
        raise ArraysError(f"{name} is a {type(value).__name__}, not an array")
    try:
        return value.array if isinstance(value, _Array) else _unfolded(value, name)
    except ArraysError as error:
        raise ArraysError(f"{name} holds {error}" if isinstance(value, _Array) else str(error)) from error
    except (KeyError, ValueError, TypeError, IndexError, AttributeError, MemoryError, RecursionError) as error:
        raise ArraysError(f"{name} is a damaged {value.kind or 'array'}: {error!r:.200}") from error


def _unfolded(value: StandIn, name: str) -> np.ndarray:
    """The array that SciPy or chumpy would make of an object's state."""
    state, kind = value.state, value.kind.rpartition(".")[2]
    if value.kind.startswith("scipy."):
        return _matrix(state, kind[:3])
    if kind == "Ch":  # a constant
        return as_array(state["x"], name)
    if kind == "Select":  # entries of another array, by their places in it
        chosen = as_array(state["a"], name).ravel()[as_array(state["idxs"], name).ravel()]
        return chosen.reshape(state["preferred_shape"]) if "preferred_shape" in state else chosen
    raise ArraysError(f"{name} is a {value.kind}, a formula that only chumpy can compute; save it as an array first")


def _matrix(state: dict, layout: str) -> np.ndarray:
    from scipy import sparse  # not above: it is slow to import

    rows, columns = state.get("_shape", state.get("shape"))
    if not (_is_size(rows) and _is_size(columns)) or rows * columns * 8 > _LARGEST_MATRIX:
        raise ValueError(f"{rows} x {columns} numbers")
    values = as_array(state["data"], "data")
    if layout == "coo":
        places = state["coords"] if "coords" in state else (state["row"], state["col"])
        indexes = tuple(as_array(place, "places") for place in places)
        return sparse.coo_matrix((values, indexes), (rows, columns)).toarray()
    build = {"csc": sparse.csc_matrix, "csr": sparse.csr_matrix}[layout]
    matrix = build(
        (values, as_array(state["indices"], "indices"), as_array(state["indptr"], "indptr")), (rows, columns)
    )
    matrix.check_format(full_check=True)  # the places of a damaged matrix would be read beyond its end
    return matrix.toarray()
