"""Arrays in pickles of others, such as SMPL's `.pkl` files, without running the pickles' code.

A pickle is a program: it names functions and calls them. Here every name becomes one of our own few, harmless
callables, or a stand-in that only remembers its state; anything else is refused. So neither chumpy (which SMPL's files
need, and which no longer installs) nor SciPy is imported on a file's behalf. Knows NumPy's, SciPy's and chumpy's way of
pickling arrays; knows no array by name.
"""

from __future__ import annotations

import pickle
from collections.abc import Sequence
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from scipy import sparse

from stmc.arrays.numpy_files import LARGEST, ArraysError

_SPARSE = ("csc", "csr", "coo")

_NUMPY = ("numpy.core", "numpy._core")
"""Where NumPy's own functions of this name lived before and after version 2."""


def read_pickle(path: Path, required: Sequence[str], optional: Sequence[str] = ()) -> dict[str, np.ndarray]:
    """The `required` arrays of a pickled dict, and those of the `optional` ones that it has, all of them dense.

    NumPy arrays, SciPy's sparse matrices, numbers, and chumpy's constants and selections are arrays; entries that are
    not asked for may be anything inert. Raises `ArraysError` for a pickle that asks for any other function or class, or
    is damaged, and where an array is missing.
    """
    with path.open("rb") as file:
        try:
            content = _Unpickler(file).load()
        except ArraysError as error:
            raise ArraysError(f"{path}: {error}") from error
        except Exception as error:  # a damaged pickle can raise whatever it likes
            raise ArraysError(f"{path} is no pickle, or a damaged one: {type(error).__name__}: {error}") from error
    if not isinstance(content, dict):
        raise ArraysError(f"{path} holds a {type(content).__name__}, not a dict of arrays")
    if missing := [name for name in required if name not in content]:
        raise ArraysError(f"{path} has no array {', '.join(missing)}; it has {', '.join(map(str, content))}")
    wanted = [*required, *(name for name in optional if name in content)]
    try:
        return {name: _dense(content[name], name) for name in wanted}
    except ArraysError as error:
        raise ArraysError(f"{path}: {error}") from error


class _StandIn:
    """What an object of a foreign class becomes: its class's name and its state. Nothing of the class is run."""

    kind = ""

    def __new__(cls, *_: object) -> _StandIn:
        made = object.__new__(cls)
        made.state = {}
        return made

    def __init__(self, *_: object) -> None:
        pass

    def __setstate__(self, state: object) -> None:
        self.state = state if isinstance(state, dict) else {}


class _Unpickler(pickle.Unpickler):
    """`find_class` is the only door between a pickle and Python; what it hands out dies with this unpickler."""

    def __init__(self, file: BinaryIO) -> None:
        super().__init__(file, encoding="latin1")  # Python 2's bytes, as SMPL's files have them

    def find_class(self, module: str, name: str) -> Any:
        """One of the harmless callables below, or a stand-in's class; `ArraysError` for any other name."""
        ours = {
            **{(f"{home}.multiarray", "_reconstruct"): self._empty for home in _NUMPY},
            **{(f"{home}.multiarray", "scalar"): self._scalar for home in _NUMPY},
            **{(f"{home}.numeric", "_frombuffer"): self._from_buffer for home in _NUMPY},
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
        }
        if (module, name) in ours:
            return ours[module, name]
        if module.split(".")[0] == "chumpy" or (module.startswith("scipy.sparse") and name[:3] in _SPARSE):
            return type("StandIn", (_StandIn,), {"kind": f"{module}.{name}"})
        raise ArraysError(f"refused to run {module}.{name}: this is not a file of arrays alone")

    def _empty(self, kind: object, *_: object) -> np.ndarray:
        if kind != "ndarray":
            raise ArraysError("an array of a foreign class")
        return np.empty(0)

    def _dtype(self, name: object, *_: object) -> np.dtype:
        return np.dtype(str(name), False, True)  # a copy: the file may set its byte order

    def _scalar(self, dtype: np.dtype, raw: object = b"") -> np.generic:
        content = raw.encode("latin1") if isinstance(raw, str) else raw
        return np.frombuffer(content, dtype, count=1)[0]

    def _from_buffer(self, buffer: object, dtype: np.dtype, shape: tuple, order: str) -> np.ndarray:
        return np.frombuffer(buffer, dtype).reshape(shape, order=order)

    def _made(self, kind: object, *_: object) -> _StandIn:
        if not (isinstance(kind, type) and issubclass(kind, _StandIn)):
            raise ArraysError(f"an object of a class that is not to be built: {kind}")
        return kind()

    def _encoded(self, text: str, encoding: str = "latin1") -> bytes:
        if encoding not in ("latin1", "latin-1"):
            raise ArraysError(f"bytes in the encoding {encoding!r}")
        return text.encode("latin1")


def _dense(value: object, name: str) -> np.ndarray:
    if isinstance(value, (np.ndarray, np.generic, int, float)):
        array = np.asarray(value)
        if array.dtype.hasobject:
            raise ArraysError(f"{name} holds Python objects, not numbers")
        return array
    if not isinstance(value, _StandIn):
        raise ArraysError(f"{name} is a {type(value).__name__}, not an array")
    try:
        return _unfolded(value, name)
    except ArraysError:
        raise
    except (KeyError, ValueError, TypeError, IndexError, AttributeError, MemoryError) as error:
        raise ArraysError(f"{name} is a damaged {value.kind}: {error!r}") from error


def _unfolded(value: _StandIn, name: str) -> np.ndarray:
    """The array that SciPy or chumpy would make of an object's state."""
    state, kind = value.state, value.kind.rpartition(".")[2]
    if value.kind.startswith("scipy."):
        return _matrix(state, kind[:3])
    if kind == "Ch":  # a constant
        return _dense(state["x"], name)
    if kind == "Select":  # entries of another array, by their places in it
        chosen = _dense(state["a"], name).ravel()[_dense(state["idxs"], name).ravel()]
        return chosen.reshape(state["preferred_shape"]) if "preferred_shape" in state else chosen
    raise ArraysError(f"{name} is a {value.kind}, a formula that only chumpy can compute; save it as an array first")


def _matrix(state: dict, layout: str) -> np.ndarray:
    rows, columns = (int(size) for size in state.get("_shape", state.get("shape")))
    if rows * columns * 8 > LARGEST:
        raise ValueError(f"{rows} x {columns} numbers")
    if layout == "coo":
        places = state["coords"] if "coords" in state else (state["row"], state["col"])
        return sparse.coo_matrix((state["data"], tuple(places)), (rows, columns)).toarray()
    build = {"csc": sparse.csc_matrix, "csr": sparse.csr_matrix}[layout]
    matrix = build((state["data"], state["indices"], state["indptr"]), (rows, columns))
    matrix.check_format(full_check=True)  # the places of a damaged matrix would be read beyond its end
    return matrix.toarray()
