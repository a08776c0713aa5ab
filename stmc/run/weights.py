"""Comparison of weights with a network by names, shapes and types alone, before memory is allocated.

Depends on safetensors' headers and on the construction of modules; independent of particular networks.
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
from stmc.settings.records import quote

Network = TypeVar("Network", bound=nn.Module)

_FLOATING = {"F64": torch.float64, "F32": torch.float32, "F16": torch.float16, "BF16": torch.bfloat16,
             "F8_E4M3": torch.float8_e4m3fn}  # fmt: skip
_INTEGER = {"I64": torch.int64, "I32": torch.int32, "I16": torch.int16, "I8": torch.int8, "U8": torch.uint8,
           "BOOL": torch.bool}  # fmt: skip
_MAX_NAMES = 3
"""Number of tensors of each kind that a message names."""


class Spec(NamedTuple):
    """Shape and dtype of a tensor; the dtype is None for a type that no network has."""

    shape: tuple[int, ...]
    dtype: torch.dtype | None


def specs_of(tensors: Mapping[str, Tensor]) -> dict[str, Spec]:
    """Return the specs of tensors in memory, or on the meta device."""
    return {name: Spec(tuple(value.shape), value.dtype) for name, value in tensors.items()}


def read_specs(path: Path) -> dict[str, Spec]:
    """Read the specs of the tensors in a safetensors file without its numbers. Raises `RunError` if it is damaged."""
    try:
        with safe_open(path, "pt") as file:
            slices = {name: file.get_slice(name) for name in file.keys()}  # noqa: SIM118
            types = _FLOATING | _INTEGER
            return {name: Spec(tuple(view.get_shape()), types.get(view.get_dtype())) for name, view in slices.items()}
    except (SafetensorError, OSError, ValueError) as error:
        raise RunError(f"{path} cannot be read: {brief(error)}") from error


def misfit(expected: Mapping[str, Spec], found: Mapping[str, Spec]) -> str:
    """Describe the differences between tensors and the expected ones, naming the first few; "" if they fit.

    Floating-point tensors of any precision fit each other; other tensors must have the same type.
    """
    common = [name for name in expected if name in found]
    wrong = {
        "missing": [name for name in expected if name not in found],
        "unknown": [name for name in found if name not in expected],
        "of another shape": [
            f"{name} {list(found[name].shape)} instead of {list(expected[name].shape)}"
            for name in common
            if found[name].shape != expected[name].shape
        ],
        "of another type": [name for name in common if not _same_type(found[name].dtype, expected[name].dtype)],
    }
    return list_problems(wrong)


def list_problems(wrong: Mapping[str, list[str]]) -> str:
    """Format problems and the first few tensors that have each."""
    return "; ".join(f"{kind}: {_shorten(names)}" for kind, names in wrong.items() if names)


def sketch(build: Callable[[], Network], tensors: int, meta: bool = True) -> Network:
    """Build a network without memory, or in memory if `meta` is False.

    The global random state is preserved.

    Args:
        build: Function that builds the network.
        tensors: Number of its tensors.
        meta: Whether to build on the meta device.

    Raises:
        RunError: As soon as the construction calls PyTorch far more often than a network of that many tensors needs: a
            billion layers would take an hour even without memory.
    """
    with torch.random.fork_rng(devices=[]), torch.device("meta" if meta else "cpu"), _CallLimit(tensors):
        return build()


class _CallLimit(TorchFunctionMode):
    """Stop a construction that calls PyTorch more often than a network of that many tensors does."""

    def __init__(self, tensors: int) -> None:
        super().__init__()
        self._tensors, self._remaining = tensors, 1000 + 50 * tensors

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        self._remaining -= 1
        if self._remaining < 0:
            raise RunError(f"it has more layers than the {self._tensors} tensors of its weights can fill")
        return func(*args, **(kwargs or {}))


def _same_type(found: torch.dtype | None, expected: torch.dtype | None) -> bool:
    if found is None or expected is None:
        return False
    return found == expected or (found in _FLOATING.values() and expected in _FLOATING.values())


def _shorten(names: list[str]) -> str:
    more = f" and {len(names) - _MAX_NAMES} more" if len(names) > _MAX_NAMES else ""
    return ", ".join(quote(name)[1:-1] if not name.isprintable() else name[:120] for name in names[:_MAX_NAMES]) + more
