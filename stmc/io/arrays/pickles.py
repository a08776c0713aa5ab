"""Arrays in untrusted pickles, such as SMPL's `.pkl` files, read without executing their code.

A pickle is a program: it names functions and calls them. Here every name becomes one of a few harmless callables, or a
stand-in that only stores its state; all other names are rejected. Neither chumpy (which SMPL's files need, and which no
longer installs) nor SciPy is imported on behalf of a file. NumPy's own `__setstate__`, which trusts a file's statements
about memory, never runs: an array is built from validated fields when it is requested. Depends on the pickle formats of
NumPy, SciPy and chumpy; independent of the names of arrays.
"""

from __future__ import annotations

import io
import math
import mmap
import pickle
import struct
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, ClassVar, Literal

import numpy as np

from stmc.io.arrays.numpy_files import LARGEST, ArraysError
from stmc.io.untrusted import quote

_SPARSE = ("csc", "csr", "coo")
_LARGEST_MATRIX = 2**27
"""Maximum size in bytes of a dense copy of a sparse matrix; SMPL-X's regressor has 2**22."""
_NUMPY = ("numpy.core", "numpy._core")
"""Modules of NumPy's functions before and after version 2."""
_KINDS = "biufSU"
"""Kinds of supported arrays: booleans, integers, floats, bytes and texts."""
_MOST_AXES = 32
"""Maximum number of axes of an array, as in NumPy 1."""
_MOST_LEVELS = 8
"""Maximum depth of nested chumpy objects; SMPL's files have two levels."""
_LARGEST_KEY = 60
"""Maximum bits of a number that is a key: such numbers are their own hashes."""


def read_pickle(path: Path, required: Sequence[str], optional: Sequence[str] = ()) -> dict[str, np.ndarray]:
    """Read the `required` arrays of a pickled dict, and the `optional` ones that exist, as dense arrays.

    NumPy arrays, SciPy's sparse matrices, numbers, and chumpy's constants and selections count as arrays; other entries
    may be anything inert. Raises `ArraysError` if the pickle refers to another function or class, is damaged, or lacks
    an array.
    """
    content = _load(path)
    if not isinstance(content, dict):
        raise ArraysError(f"{path} holds a {type(content).__name__}, not a dict of arrays")
    if missing := [name for name in required if name not in content]:
        raise ArraysError(f"{path} has no array {', '.join(missing)}; it has {_names(content)}")
    names = [*required, *(name for name in optional if name in content)]
    try:
        return {name: as_array(content[name], name) for name in names}
    except ArraysError as error:
        raise ArraysError(f"{path}: {error}") from error


def read_places(path: Path) -> dict[str, int]:
    """Read a pickled dict from words to indices; raise `ArraysError` for any other content."""
    content = _load(path)
    if not isinstance(content, dict):
        raise ArraysError(f"{path} holds a {type(content).__name__}, not a dict of words and their indices")
    places = {key: as_array(value, "an index") for key, value in content.items() if isinstance(key, str)}
    if len(places) < len(content) or any(array.ndim or array.dtype.kind not in "iu" for array in places.values()):
        raise ArraysError(f"{path} must hold words and integers only")
    return {key: int(value) for key, value in places.items()}


def _load(path: Path) -> Any:
    if path.stat().st_size > LARGEST:
        raise ArraysError(f"{path} is larger than {LARGEST} bytes, the limit")
    try:
        content = path.read_bytes()
        return SafeUnpickler(io.BytesIO(content), len(content)).load()
    except ArraysError as error:
        raise ArraysError(f"{path}: {error}") from error
    except Exception as error:  # a damaged pickle can raise any exception
        reason = f"{type(error).__name__}: {error}"[:200]
        raise ArraysError(f"{path} is not a pickle, or is damaged: {reason}") from error


class StandIn:
    """A stand-in for an object of a foreign class: the name of the class and the state. No code of the class runs."""

    kind = ""
    state: Any
    dense: np.ndarray | None

    def __new__(cls, *_: object) -> StandIn:
        stand_in = object.__new__(cls)
        stand_in.state, stand_in.dense = {}, None
        return stand_in

    def __init__(self, *_: object) -> None:
        pass

    def __setstate__(self, state: object) -> None:
        self.state = state if isinstance(state, dict) else {}


class _Type(StandIn):
    """A stand-in for a dtype: its name and the rest of its state, of which only the byte order is used."""

    def __init__(self, name: object = "", *_: object) -> None:
        self.name = name

    def __setstate__(self, state: object) -> None:
        self.state = state

    @property
    def dtype(self) -> np.dtype:
        """The dtype, if it is plain; `ArraysError` for fields, objects, sub-arrays, and custom sizes or offsets."""
        if not isinstance(self.name, str):
            raise ArraysError(f"a dtype that is a {type(self.name).__name__}")
        if self.name.strip("<>=|")[:1] not in ("?", "b", *_KINDS):
            raise ArraysError(_OBJECTS if self.name[:1] == "O" else f"an unsupported dtype {quote(self.name)}")
        dtype = np.dtype(self.name)
        if dtype.kind not in _KINDS or not dtype.itemsize:
            raise ArraysError(f"an unsupported dtype {quote(self.name)}")
        if self.state == {}:
            return dtype
        if not isinstance(self.state, tuple) or len(self.state) != 8:
            raise ArraysError("a dtype with a state that NumPy does not write")
        _, order, *structure, size, alignment = self.state[:7]
        inherent = (dtype.itemsize, np.dtype(dtype.char).alignment) if dtype.kind in "SU" else (-1, -1)
        if order not in ("<", ">", "|", "=") or structure != [None, None, None] or (size, alignment) != inherent:
            raise ArraysError("a dtype with fields or custom sizes")
        return dtype.newbyteorder(order)


class _Array(StandIn):
    """A stand-in for an array: its state (version, shape, type, Fortran order, bytes)."""

    def __setstate__(self, state: object) -> None:
        self.state = state

    @property
    def array(self) -> np.ndarray:
        """The array, after validation of its fields."""
        if not isinstance(self.state, tuple) or len(self.state) != 5:
            raise ArraysError("an array with a state that NumPy does not write")
        _, shape, type_, fortran, content = self.state
        if isinstance(content, list):
            raise ArraysError(_OBJECTS)
        raw = content.encode("latin1") if isinstance(content, str) else content
        order: Literal["F", "C"] = "F" if fortran else "C"
        size = byte_count(shape, type_)
        if not isinstance(raw, (bytes, bytearray, memoryview)) or size != len(raw):
            raise ArraysError(f"an array of shape {shape!s:.40} with the wrong number of bytes")
        if isinstance(raw, memoryview):  # memory-mapped: it stays on disk until it is used
            return np.ndarray(shape, type_.dtype, raw, order=order)
        return np.ndarray(shape, type_.dtype, bytes(raw), order=order).copy(order="K")


_OBJECTS = "Python objects, not numbers"


def byte_count(shape: object, type_: object) -> int:
    """Compute the size in bytes of an array. Raises `ArraysError` if the shape or type is invalid."""
    if isinstance(type_, _Type) and isinstance(shape, tuple) and len(shape) <= _MOST_AXES and all(map(_is_size, shape)):
        return math.prod(shape) * type_.dtype.itemsize
    raise ArraysError("an array without a shape or a type")


def array_of(content: object, type_: object, shape: object, order: object) -> StandIn:
    """Create a stand-in for an array, whose fields are validated on request; `order` is "C" or "F", as in NumPy."""
    array = _Array()
    array.__setstate__((1, shape, type_, order == "F", content))
    return array


def _is_size(size: object) -> bool:
    return isinstance(size, int) and not isinstance(size, bool) and 0 <= size <= LARGEST


Dispatch = dict[int, Callable[[Any], None]]
"""The method of an unpickler for each opcode."""


class SafeUnpickler(pickle._Unpickler):
    """An unpickler whose `find_class` is the only access to Python; a file can change none of the returned objects.

    The stream must not return more bytes than it has, whatever the request. The implementation is in Python because the
    C implementation allocates as much memory as a six-byte file declares, and lets a file set attributes of any
    reachable object. Values of a file are never printed and, except for texts and small numbers, never hashed: a tuple
    that holds itself twice, 34 levels deep, takes 76 bytes of a file and 2**34 steps of `hash` and `repr`. Copies are
    counted, so that a file uses no more memory than its own size.
    """

    stack: list[Any]  # attributes of the base class that typeshed does not declare
    read: Callable[[int], bytes]
    append: Callable[[object], None]
    pop_mark: Callable[[], list[Any]]

    def __init__(self, stream: io.BytesIO | mmap.mmap, size: int) -> None:
        super().__init__(stream, encoding="latin1")  # bytes of Python 2, as in SMPL's files
        self._allowance = size
        self._stand_ins: dict[str, type[StandIn]] = {}

    def find_class(self, module: str, name: str) -> Any:
        """Return a harmless callable or the class of a stand-in; raise `ArraysError` for any other name."""
        harmless = {
            **{(f"{home}.multiarray", "_reconstruct"): self._empty for home in _NUMPY},
            **{(f"{home}.multiarray", "scalar"): self._scalar for home in _NUMPY},
            **{(f"{home}.numeric", "_frombuffer"): array_of for home in _NUMPY},
            ("numpy", "dtype"): self._dtype,
            ("numpy", "ndarray"): "ndarray",
            ("copy_reg", "_reconstructor"): self._build,
            ("copyreg", "_reconstructor"): self._build,
            ("copyreg", "__newobj__"): self._build,
            ("_codecs", "encode"): self._encode,
            ("__builtin__", "object"): "object",
            ("builtins", "object"): "object",
            ("collections", "OrderedDict"): self._dict,
            **{(home, name): self._set for home in ("__builtin__", "builtins") for name in ("set", "frozenset")},
            ("__builtin__", "bytes"): self._empty_bytes,
        }
        if (module, name) in harmless:
            return harmless[module, name]
        if module.split(".")[0] == "chumpy" or (module.startswith("scipy.sparse") and name[:3] in _SPARSE):
            kind = f"{module}.{name}"[:100]
            if kind not in self._stand_ins:
                self._stand_ins[kind] = type("StandIn", (StandIn,), {"kind": kind})
            return self._stand_ins[kind]
        raise ArraysError(f"refused to run {f'{module}.{name}':.100}: the file must hold arrays alone")

    def load_build(self) -> None:
        """Set the state of a stand-in, and of nothing else."""
        state = self.stack.pop()
        if not isinstance(self.stack[-1], StandIn):
            raise ArraysError(f"a state for a {type(self.stack[-1]).__name__}: the file must hold arrays alone")
        self.stack[-1].__setstate__(state)

    def load_bytearray8(self) -> None:
        """Read bytes that exist; Python's own method would first allocate the declared size."""
        (size,) = struct.unpack("<Q", self.read(8))
        self.append(bytearray(self.read(size)))

    def load_setitem(self) -> None:
        """Add one entry to a dict."""
        value, key = self.stack.pop(), self.stack.pop()
        self._fill([key, value])

    def load_setitems(self) -> None:
        """Add entries to a dict."""
        self._fill(self.pop_mark())

    def load_dict(self) -> None:
        """Build a dict from the stack."""
        items = self.pop_mark()
        self.append({})
        self._fill(items)

    def load_additems(self) -> None:
        """Add members to a set."""
        items = self.pop_mark()
        if not isinstance(self.stack[-1], set):
            raise ArraysError(f"members of a {type(self.stack[-1]).__name__}")
        self.stack[-1].update(map(_key, items))

    def load_frozenset(self) -> None:
        """Build a frozen set from the stack."""
        items = self.pop_mark()
        self.append(frozenset(map(_key, items)))

    dispatch: ClassVar[Dispatch] = pickle._Unpickler.dispatch | {
        pickle.BUILD[0]: load_build,
        pickle.BYTEARRAY8[0]: load_bytearray8,
        pickle.SETITEM[0]: load_setitem,
        pickle.SETITEMS[0]: load_setitems,
        pickle.DICT[0]: load_dict,
        pickle.ADDITEMS[0]: load_additems,
        pickle.FROZENSET[0]: load_frozenset,
    }

    def _fill(self, items: list) -> None:
        if not isinstance(self.stack[-1], dict):
            raise ArraysError(f"entries of a {type(self.stack[-1]).__name__}")
        for position in range(0, len(items), 2):
            self.stack[-1][_key(items[position])] = items[position + 1]

    def _count_copy(self, items: object) -> Any:
        """Count the copy of a text, a list or a tuple against the allowance."""
        if not isinstance(items, (str, list, tuple)):
            raise ArraysError(f"a copy of a {type(items).__name__}")
        self._allowance -= len(items)
        if self._allowance < 0:
            raise ArraysError("copies that exceed the size of the file")
        return items

    def _dict(self, items: object = ()) -> dict:
        pairs = [self._count_copy(pair) for pair in self._count_copy(items)]
        return {_key(key): value for key, value in pairs}

    def _set(self, items: object = ()) -> frozenset:
        return frozenset(map(_key, self._count_copy(items)))

    def _empty(self, kind: object, *_: object) -> _Array:
        if kind != "ndarray":
            raise ArraysError("an array of a foreign class")
        return _Array()

    def _dtype(self, name: object, *_: object) -> _Type:
        return _Type(name)

    def _scalar(self, dtype: object, raw: object = b"") -> StandIn:
        return array_of(raw, dtype, (), "C")

    def _build(self, kind: object, *_: object) -> StandIn:
        if not (isinstance(kind, type) and issubclass(kind, StandIn)):
            name = quote(kind) if isinstance(kind, str) else f"a {type(kind).__name__}"
            raise ArraysError(f"an object of a forbidden class: {name}")
        return kind()

    def _empty_bytes(self) -> bytes:
        """Return empty bytes, as older protocols request; a number would declare a size."""
        return b""

    def _encode(self, text: object, encoding: object = "latin1") -> bytes:
        if not isinstance(text, str) or encoding not in ("latin1", "latin-1"):
            name = quote(encoding) if isinstance(encoding, str) else f"of a {type(encoding).__name__}"
            raise ArraysError(f"bytes of a {type(text).__name__} in the encoding {name}")
        return self._count_copy(text).encode("latin1")


def _key(value: object) -> object:
    """Check a key of a dict or a member of a set: a text or a number."""
    if isinstance(value, int) and value.bit_length() > _LARGEST_KEY:
        raise ArraysError(f"a key that is an integer of {value.bit_length()} bits")
    if not isinstance(value, (str, bytes, int, float)):
        raise ArraysError(f"a key that is a {type(value).__name__}; only texts and numbers are supported")
    return value


def _names(content: dict) -> str:
    """List the first few names in a file."""
    names = [name if isinstance(name, str) else type(name).__name__ for name in content]
    return f"{', '.join(names)[:200]}{'…' if len(', '.join(names)) > 200 else ''}"


def as_array(value: object, name: str, level: int = 0) -> np.ndarray:
    """Convert an unpickled object, at depth `level`, to a dense array. Raises `ArraysError` if it is no array."""
    if isinstance(value, (int, float)):
        return np.asarray(value)
    if not isinstance(value, StandIn):
        raise ArraysError(f"{name} is a {type(value).__name__}, not an array")
    try:
        if isinstance(value, _Array):
            return value.array
        if value.dense is None:
            value.dense = _unfold(value, name, level)
        return value.dense
    except ArraysError as error:
        raise ArraysError(f"{name} holds {error}" if isinstance(value, _Array) else str(error)) from error
    except (KeyError, ValueError, TypeError, IndexError, AttributeError, MemoryError, RecursionError) as error:
        raise ArraysError(f"{name} is a damaged {value.kind or 'array'}: {error!r:.200}") from error


def _unfold(value: StandIn, name: str, level: int) -> np.ndarray:
    """Build the array that SciPy or chumpy would build from the state of an object."""
    if level == _MOST_LEVELS:
        raise ArraysError(f"{name} has more than {_MOST_LEVELS} nested objects")
    state, kind = value.state, value.kind.rpartition(".")[2]
    if value.kind.startswith("scipy."):
        return _matrix(state, kind[:3], name, level + 1)
    if kind == "Ch":  # a constant
        return as_array(state["x"], name, level + 1)
    if kind == "Select":  # entries of another array, by index
        values, indices = (as_array(state[key], name, level + 1) for key in ("a", "idxs"))
        selection = values.ravel()[indices.ravel()]
        return selection.reshape(state["preferred_shape"]) if "preferred_shape" in state else selection
    raise ArraysError(f"{name} is a {value.kind}, a formula that only chumpy can compute; save it as an array first")


def _matrix(state: dict, layout: str, name: str, level: int) -> np.ndarray:
    from scipy import sparse  # imported late: it is slow to import

    rows, columns = state["_shape" if "_shape" in state else "shape"]
    if not (_is_size(rows) and _is_size(columns)) or rows * columns * 8 > _LARGEST_MATRIX:
        sizes = " x ".join(quote(size) if isinstance(size, int) else type(size).__name__ for size in (rows, columns))
        raise ArraysError(f"{name} is a damaged matrix of {sizes} numbers")
    values = as_array(state["data"], "data", level)
    if layout == "coo":
        axes = state["coords"] if "coords" in state else (state["row"], state["col"])
        indexes = tuple(as_array(axis, "indices", level) for axis in axes)
        return sparse.coo_matrix((values, indexes), (rows, columns)).toarray()
    build = {"csc": sparse.csc_matrix, "csr": sparse.csr_matrix}[layout]
    indices, starts = (as_array(state[key], key, level) for key in ("indices", "indptr"))
    matrix = build((values, indices, starts), (rows, columns))
    matrix.check_format(full_check=True)  # the indices of a damaged matrix could point beyond its end
    return matrix.toarray()
