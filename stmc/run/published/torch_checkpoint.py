"""What the published formats share: tensors in PyTorch's files, settings beside them, and weights that have to fit.

Knows no network and no format in particular. Nothing is run that a file holds.
"""

from __future__ import annotations

import json
import pickle
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from stmc.diffusion.statistics import Statistics
from stmc.evaluators import Evaluator
from stmc.io.arrays import ArraysError, check_checkpoint, read_npy
from stmc.io.untrusted import cut
from stmc.model import Model
from stmc.run import PARTS, RunError, build_fitting
from stmc.run.construction import Part
from stmc.run.weights import listed, misfit, specs_of
from stmc.settings.records import shown


class CheckpointError(ValueError):
    """A checkpoint that is invalid or does not fit; the message names the file, what is wrong, what is right."""


@dataclass(frozen=True, eq=False)
class Imported:
    """A published model (or evaluator) and what its card should say: a title, and sentences on its source and on what
    was chosen."""

    model: Model | Evaluator
    title: str
    facts: tuple[str, ...]


def read_checkpoint(path: Path) -> dict[str, Any]:
    """The content of a file that `torch.save` wrote, on the CPU. Raises `CheckpointError` where it is damaged, no dict,
    or holds more than tensors and plain values, which could run code."""
    content = _content(path)
    if not isinstance(content, dict):
        raise CheckpointError(f"{path} holds a {type(content).__name__}, not a dict of weights")
    return content


def read_tensor(path: Path) -> Tensor:
    """The one tensor in a file that `torch.save` wrote. Raises `CheckpointError` as `read_checkpoint` does."""
    content = _content(path)
    if not torch.is_tensor(content):
        raise CheckpointError(f"{path} holds a {type(content).__name__}, not a tensor")
    return content


def _content(path: Path) -> Any:
    if not path.is_file():
        raise CheckpointError(f"{path} does not exist")
    try:
        check_checkpoint(path)
        content = torch.load(path, map_location="cpu", weights_only=True)
    except pickle.UnpicklingError as error:
        reason = str(error).split("\n")[0]
        raise CheckpointError(
            f"{path} is damaged, or holds more than tensors, which could run code on this machine, and is not loaded: "
            f"{reason}"
        ) from error
    except Exception as error:  # a damaged file can raise whatever it likes
        reason = cut(" ".join(str(error).split()), 200) or type(error).__name__
        raise CheckpointError(f"{path} cannot be read as a checkpoint of PyTorch: {reason}") from error
    return content


def state_dict(content: Any, place: str) -> dict[str, Tensor]:
    """The tensors of a dict by name, without gradients. Raises `CheckpointError` for anything else."""
    if not isinstance(content, Mapping) or not content:
        raise CheckpointError(f"{place} must be a dict of tensors, not {type(content).__name__} {shown(content)}")
    strange = [
        str(name)[:60] for name, value in content.items() if not isinstance(name, str) or not torch.is_tensor(value)
    ]
    if strange:
        raise CheckpointError(f"{place} must hold tensors only, but {', '.join(strange[:5])} are none")
    return {name: value.detach() for name, value in content.items()}


def fill(network: nn.Module, weights: Mapping[str, Tensor], place: str) -> None:
    """Loads `weights` into the network, as float32. Raises `CheckpointError` that lists the first weights that are
    missing, not known, of another shape or type, or not finite."""
    wrong = misfit(specs_of(network.state_dict()), specs_of(weights))
    infinite = [name for name, value in weights.items() if not value.isfinite().all()]
    if wrong or infinite:
        reasons = "; ".join(filter(None, [wrong, listed({"not finite": infinite})]))
        raise CheckpointError(f"{place} does not fit {type(network).__name__}. {reasons}")
    network.load_state_dict({name: value.float() for name, value in weights.items()})
    network.eval().requires_grad_(False)


def built(
    config: Mapping[str, Any],
    weights: Mapping[str, Tensor],
    settings: Path,
    place: str,
    parts: Mapping[str, Part] = PARTS,
) -> dict[str, Any]:
    """The parts of a model, as `run.build_fitting` makes them of what a stranger's `settings` say. Raises
    `CheckpointError` where they cannot be made, or the `weights` of the file at `place` do not fit."""
    try:
        return build_fitting(config, specs_of(weights), place, parts)
    except RunError as error:
        raise CheckpointError(str(error) if place in str(error) else f"{settings}: {error}") from error


def whole(value: Any, name: str, path: Path, most: int = 10_000) -> int:
    """A positive whole number of a file's settings. Raises `CheckpointError` for anything else."""
    if isinstance(value, bool) or not isinstance(value, int) or not 1 <= value <= most:
        raise CheckpointError(f"{path}: {name} must be a positive whole number up to {most}, not {shown(value)}")
    return value


def size_of(weights: Mapping[str, Tensor], name: str, dimension: int, place: str) -> int:
    """One dimension of a weight. Raises `CheckpointError` where there is no such weight."""
    if name not in weights or weights[name].ndim <= dimension:
        raise CheckpointError(f"{place} has no weight {name}: it is a checkpoint of another model")
    return weights[name].shape[dimension]


def read_json(path: Path) -> dict[str, Any]:
    """The settings of a `.json` file. Raises `CheckpointError` where they are none."""
    try:
        settings = json.loads(path.read_text(encoding="utf-8-sig"))
    except (OSError, UnicodeDecodeError, ValueError, RecursionError) as error:
        raise CheckpointError(f"{path} cannot be read: {error}") from error
    if not isinstance(settings, dict):
        raise CheckpointError(f"{path} must hold settings by name, not {shown(settings)}")
    return settings


def read_statistics(mean: Path, std: Path, width: int) -> Statistics:
    """Mean and standard deviation of `width` features in two `.npy` files. Raises `CheckpointError` for any others."""
    values = []
    for path in (mean, std):
        if not path.is_file():
            raise CheckpointError(f"{path} does not exist: the weights are of no use without their mean and std")
        try:
            array = read_npy(path)
        except ArraysError as error:
            raise CheckpointError(str(error)) from error
        if array.shape != (width,) or array.dtype.kind != "f":
            raise CheckpointError(f"{path} must hold {width} numbers, not {array.dtype} {list(array.shape)}")
        values.append(torch.from_numpy(array).float())
    try:
        return Statistics(*values)
    except ValueError as error:
        raise CheckpointError(f"{mean} and {std}: statistics must be finite, with std above 0") from error


def read_tensor_statistics(mean: Path, std: Path, width: int) -> Statistics:
    """As `read_statistics`, of two files that `torch.save` wrote; the deviation as in `nudged_statistics`."""
    values = [read_tensor(path) for path in (mean, std)]
    for path, value in zip((mean, std), values, strict=True):
        if value.shape != (width,):
            raise CheckpointError(f"{path} must hold {width} numbers, not {list(value.shape)}")
    return nudged_statistics(*values, f"{mean} and {std}: statistics")


def nudged_statistics(mean: Tensor, std: Tensor, place: str) -> Statistics:
    """What the code of TMR and STMC, and FlowMDM's on BABEL, normalises by: the deviation plus 1e-12.

    Raises `CheckpointError` where a mean or a deviation is invalid.
    """
    try:
        return Statistics(mean.float(), std.float() + 1e-12)
    except ValueError as error:
        raise CheckpointError(f"{place} must be finite, with a std that is not negative") from error


def identity(width: int) -> Statistics:
    """Statistics that change nothing: of texts that a network reads as they come."""
    return Statistics(torch.zeros(width), torch.ones(width))


def without(weights: Mapping[str, Tensor], prefix: str) -> dict[str, Tensor]:
    """The weights whose names do not start with `prefix`."""
    return {name: value for name, value in weights.items() if not name.startswith(prefix)}


def only_file(folder: Path, pattern: str) -> Path:
    """The one file of a folder that the pattern fits. Raises `CheckpointError` where there is none, or more."""
    found = sorted(folder.glob(pattern))
    if len(found) != 1:
        names = ", ".join(path.name for path in found) or "none"
        raise CheckpointError(f"{folder} should hold one {pattern}, but holds {names}: name the file itself")
    return found[0]


def without_tables(weights: Mapping[str, Tensor], names: Sequence[str], table: Tensor, path: Path) -> dict[str, Tensor]:
    """The weights without the tables of positions called `names`, which follow from a formula; shorter or longer ones
    are the same. Raises `CheckpointError` for other numbers: then the checkpoint is of another network."""
    for name in names:
        if name in weights:
            theirs = weights[name].float().reshape(len(weights[name]), -1)
            rows = min(len(theirs), len(table))
            if theirs.shape[1] != table.shape[1] or not torch.allclose(theirs[:rows], table[:rows], atol=1e-2):
                raise CheckpointError(f"{path}: {name} {list(weights[name].shape)} is another table of positions")
    return {name: value for name, value in weights.items() if name not in names}
