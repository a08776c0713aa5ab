"""Whether weights fit a network, told from names, shapes and types alone, before memory is asked for.

Knows safetensors' headers and how modules are constructed; knows no network by name.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import torch
from safetensors import SafetensorError, safe_open
from torch import Tensor, nn
from torch.overrides import TorchFunctionMode

from stmc.run.configs import RunError, brief
from stmc.settings.records import shown

Network = TypeVar("Network", bound=nn.Module)

_FLOATING = {"F64": torch.float64, "F32": torch.float32, "F16": torch.float16, "BF16": torch.bfloat16,
             "F8_E4M3": torch.float8_e4m3fn}  # fmt: skip
_OTHERS = {"I64": torch.int64, "I32": torch.int32, "I16": torch.int16, "I8": torch.int8, "U8": torch.uint8,
           "BOOL": torch.bool}  # fmt: skip
_NAMED = 3
"""Tensors of each kind that a message names."""


class Spec(NamedTuple):
    """A tensor without its numbers; no type for one that no network has."""

    shape: tuple[int, ...]
    dtype: torch.dtype | None


def specs_of(tensors: Mapping[str, Tensor]) -> dict[str, Spec]:
    """Of tensors in memory, or on the meta device."""
    return {name: Spec(tuple(value.shape), value.dtype) for name, value in tensors.items()}


def read_specs(path: Path) -> dict[str, Spec]:
    """Of the tensors in a safetensors file; its numbers are not read. Raises `RunError` for a damaged one."""
    try:
        with safe_open(path, "pt") as file:
            slices = {name: file.get_slice(name) for name in file.keys()}  # noqa: SIM118
            types = _FLOATING | _OTHERS
            return {name: Spec(tuple(each.get_shape()), types.get(each.get_dtype())) for name, each in slices.items()}
    except (SafetensorError, OSError, ValueError) as error:
        raise RunError(f"{path} cannot be read: {brief(error)}") from error


def misfit(expected: Mapping[str, Spec], found: Mapping[str, Spec]) -> str:
    """In what tensors are not those expected, naming the first few; "" where they fit.

    Floating-point tensors of any precision fit one another; others have to be of the same type.
    """
    both = [name for name in expected if name in found]
    wrong = {
        "missing": [name for name in expected if name not in found],
        "not known": [name for name in found if name not in expected],
        "of another shape": [
            f"{name} {list(found[name].shape)} instead of {list(expected[name].shape)}"
            for name in both
            if found[name].shape != expected[name].shape
        ],
        "of another type": [name for name in both if not _alike(found[name].dtype, expected[name].dtype)],
    }
    return listed(wrong)


def listed(wrong: Mapping[str, list[str]]) -> str:
    """What is wrong with which tensors, the first few of each kind."""
    return "; ".join(f"{kind}: {_few(names)}" for kind, names in wrong.items() if names)


def sketch(build: Callable[[], Network], tensors: int, meta: bool = True) -> Network:
    """The network that `build` makes, without memory; with `meta` off in memory.

    Raises `RunError` as soon as it has asked PyTorch for far more than a network of so many `tensors` needs: a
    billion layers would take an hour even without memory. The global generator stays as it is.
    """
    with torch.random.fork_rng(devices=[]), torch.device("meta" if meta else "cpu"), _Sparing(tensors):
        return build()


class _Sparing(TorchFunctionMode):
    """Stops a construction that calls PyTorch more often than a network of so many tensors does."""

    def __init__(self, tensors: int) -> None:
        super().__init__()
        self._tensors, self._left = tensors, 1000 + 50 * tensors

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        self._left -= 1
        if self._left < 0:
            raise RunError(f"it has more layers than the {self._tensors} tensors of its weights are enough for")
        return func(*args, **(kwargs or {}))


def _alike(found: torch.dtype | None, expected: torch.dtype | None) -> bool:
    if found is None or expected is None:
        return False
    return found == expected or (found in _FLOATING.values() and expected in _FLOATING.values())


def _few(names: list[str]) -> str:
    more = f" and {len(names) - _NAMED} more" if len(names) > _NAMED else ""
    return ", ".join(shown(name)[1:-1] if not name.isprintable() else name[:120] for name in names[:_NAMED]) + more
