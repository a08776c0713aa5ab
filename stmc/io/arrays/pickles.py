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

from stmc.io.arrays.numpy_files import LARGEST, ArraysError
from stmc.io.untrusted import shown

_SPARSE = ("csc", "csr", "coo")
_LARGEST_MATRIX = 2**27
"""Bytes of a sparse matrix once it is dense; SMPL-X's regressor has 2**22."""

_NUMPY = ("numpy.core", "numpy._core")
"""Where NumPy's own functions of this name lived before and after version 2."""
_KINDS = "biufSU"
"""Of arrays that are read: booleans, whole numbers, floats, bytes and texts."""

_MOST_AXES = 32
"""Axes of an array, as NumPy 1 has it."""
_MOST_LEVELS = 8
"""Of chumpy's objects within one another; SMPL's files have two."""
_LARGEST_KEY = 60
"""Bits of a number that is a key: such numbers have hashes of their own."""


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
        content = path.read_bytes()
        return SafeUnpickler(io.BytesIO(content), len(content)).load()
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
        made.state, made.dense = {}, None
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
        if not isinstance(self.name, str):
            raise ArraysError(f"numbers of a type that is a {type(self.name).__name__}")
        if self.name.strip("<>=|")[:1] not in ("?", "b", *_KINDS):
            raise ArraysError(_OBJECTS if self.name[:1] == "O" else f"numbers of the type {shown(self.name)}")
        dtype = np.dtype(self.name)
        if dtype.kind not in _KINDS or not dtype.itemsize:
            raise ArraysError(f"numbers of the type {shown(self.name)}")
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
    is_shape = isinstance(shape, tuple) and len(shape) <= _MOST_AXES and all(map(_is_size, shape))
    if not isinstance(type_, _Type) or not is_shape:
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
    much memory as a six-byte file says, and lets a file set attributes of whatever it can reach. A value of the file is
    never shown and, but for texts and small numbers, never hashed: a tuple that holds itself twice, 34 levels deep, is
    76 bytes of a file and 2**34 steps of `hash` and `repr`. Copies are counted, so that a file grows no more in memory
    than its own size.
    """

    def __init__(self, stream: io.BytesIO | mmap.mmap, size: int) -> None:
        super().__init__(stream, encoding="latin1")  # Python 2's bytes, as SMPL's files have them
        self._allowance = size
        self._stand_ins: dict[str, type[StandIn]] = {}

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
            ("collections", "OrderedDict"): self._dict,
            **{(home, name): self._set for home in ("__builtin__", "builtins") for name in ("set", "frozenset")},
            ("__builtin__", "bytes"): self._no_bytes,
        }
        if (module, name) in ours:
            return ours[module, name]
        if module.split(".")[0] == "chumpy" or (module.startswith("scipy.sparse") and name[:3] in _SPARSE):
            kind = f"{module}.{name}"[:100]
            if kind not in self._stand_ins:
                self._stand_ins[kind] = type("StandIn", (StandIn,), {"kind": kind})
            return self._stand_ins[kind]
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

    def load_setitem(self) -> None:
        """One entry of a dict."""
        value, key = self.stack.pop(), self.stack.pop()
        self._fill([key, value])

    def load_setitems(self) -> None:
        """Entries of a dict."""
        self._fill(self.pop_mark())

    def load_dict(self) -> None:
        """A dict of what is on the stack."""
        items = self.pop_mark()
        self.append({})
        self._fill(items)

    def load_additems(self) -> None:
        """Members of a set."""
        items = self.pop_mark()
        if not isinstance(self.stack[-1], set):
            raise ArraysError(f"members of a {type(self.stack[-1]).__name__}")
        self.stack[-1].update(map(_key, items))

    def load_frozenset(self) -> None:
        """A frozen set of what is on the stack."""
        items = self.pop_mark()
        self.append(frozenset(map(_key, items)))

    dispatch = pickle._Unpickler.dispatch | {
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

    def _copied(self, items: object) -> Any:
        """A text, a list or a tuple that is about to be copied, once more."""
        if not isinstance(items, (str, list, tuple)):
            raise ArraysError(f"a copy of a {type(items).__name__}")
        self._allowance -= len(items)
        if self._allowance < 0:
            raise ArraysError("copies that are larger than the file")
        return items

    def _dict(self, items: object = ()) -> dict:
        pairs = [self._copied(pair) for pair in self._copied(items)]
        return {_key(key): value for key, value in pairs}

    def _set(self, items: object = ()) -> frozenset:
        return frozenset(map(_key, self._copied(items)))

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
            name = shown(kind) if isinstance(kind, str) else f"a {type(kind).__name__}"
            raise ArraysError(f"an object of a class that is not to be built: {name}")
        return kind()

    def _no_bytes(self) -> bytes:
        """What older protocols call for empty bytes; with a number it would be so many."""
        return b""

    def _encoded(self, text: object, encoding: object = "latin1") -> bytes:
        if not isinstance(text, str) or encoding not in ("latin1", "latin-1"):
            name = shown(encoding) if isinstance(encoding, str) else f"of a {type(encoding).__name__}"
            raise ArraysError(f"bytes of a {type(text).__name__} in the encoding {name}")
        return self._copied(text).encode("latin1")


def _key(value: object) -> object:
    """A key of a dict or a member of a set, once it is a text or a number."""
    if isinstance(value, int) and value.bit_length() > _LARGEST_KEY:
        raise ArraysError(f"a key that is an integer of {value.bit_length()} bits")
    if not isinstance(value, (str, bytes, int, float)):
        raise ArraysError(f"a key that is a {type(value).__name__}: texts and numbers are read")
    return value


def _names(content: dict) -> str:
    """Of what a file holds, the first few."""
    names = [name if isinstance(name, str) else type(name).__name__ for name in content]
    return f"{', '.join(names)[:200]}{'…' if len(', '.join(names)) > 200 else ''}"


def as_array(value: object, name: str, level: int = 0) -> np.ndarray:
    """The dense array of what the unpickler made, `level` objects within others; each is unfolded once. Raises
    `ArraysError`, with the name, for what is none."""
    if isinstance(value, (int, float)):
        return np.asarray(value)
    if not isinstance(value, StandIn):
        raise ArraysError(f"{name} is a {type(value).__name__}, not an array")
    try:
        if isinstance(value, _Array):
            return value.array
        if value.dense is None:
            value.dense = _unfolded(value, name, level)
        return value.dense
    except ArraysError as error:
        raise ArraysError(f"{name} holds {error}" if isinstance(value, _Array) else str(error)) from error
    except (KeyError, ValueError, TypeError, IndexError, AttributeError, MemoryError, RecursionError) as error:
        raise ArraysError(f"{name} is a damaged {value.kind or 'array'}: {error!r:.200}") from error


def _unfolded(value: StandIn, name: str, level: int) -> np.ndarray:
    """The array that SciPy or chumpy would make of an object's state."""
    if level == _MOST_LEVELS:
        raise ArraysError(f"{name} has more than {_MOST_LEVELS} objects within one another")
    state, kind = value.state, value.kind.rpartition(".")[2]
    if value.kind.startswith("scipy."):
        return _matrix(state, kind[:3], name, level + 1)
    if kind == "Ch":  # a constant
        return as_array(state["x"], name, level + 1)
    if kind == "Select":  # entries of another array, by their places in it
        values, places = (as_array(state[key], name, level + 1) for key in ("a", "idxs"))
        chosen = values.ravel()[places.ravel()]
        return chosen.reshape(state["preferred_shape"]) if "preferred_shape" in state else chosen
    raise ArraysError(f"{name} is a {value.kind}, a formula that only chumpy can compute; save it as an array first")


def _matrix(state: dict, layout: str, name: str, level: int) -> np.ndarray:
    from scipy import sparse  # not above: it is slow to import

    rows, columns = state.get("_shape", state.get("shape"))
    if not (_is_size(rows) and _is_size(columns)) or rows * columns * 8 > _LARGEST_MATRIX:
        sizes = " x ".join(shown(size) if isinstance(size, int) else type(size).__name__ for size in (rows, columns))
        raise ArraysError(f"{name} is a damaged matrix of {sizes} numbers")
    values = as_array(state["data"], "data", level)
    if layout == "coo":
        places = state["coords"] if "coords" in state else (state["row"], state["col"])
        indexes = tuple(as_array(place, "places", level) for place in places)
        return sparse.coo_matrix((values, indexes), (rows, columns)).toarray()
    build = {"csc": sparse.csc_matrix, "csr": sparse.csr_matrix}[layout]
    indices, starts = (as_array(state[key], key, level) for key in ("indices", "indptr"))
    matrix = build((values, indices, starts), (rows, columns))
    matrix.check_format(full_check=True)  # the places of a damaged matrix would be read beyond its end
    return matrix.toarray()
