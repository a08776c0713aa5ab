"""Common functions of the published formats: tensors in PyTorch files, settings, and checks that weights fit.

Independent of particular networks and formats. No code of a file is executed.
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
from stmc.io.untrusted import truncate
from stmc.model import Model
from stmc.run import PARTS, RunError, build_fitting
from stmc.run.construction import Part
from stmc.run.weights import list_problems, misfit, specs_of
from stmc.settings.records import quote


class CheckpointError(ValueError):
    """A checkpoint that is invalid or does not fit; the message names the file, the problem and the legal values."""


@dataclass(frozen=True, eq=False)
class Imported:
    """A published model (or evaluator), with the title of its card and sentences on its source and its settings."""

    model: Model | Evaluator
    title: str
    facts: tuple[str, ...]


def read_checkpoint(path: Path) -> dict[str, Any]:
    """Read a dict that `torch.save` wrote, to the CPU.

    Raises `CheckpointError` if the file is damaged, is not a dict, or holds more than tensors and plain values, which
    could execute code.
    """
    content = _content(path)
    if not isinstance(content, dict):
        raise CheckpointError(f"{path} holds a {type(content).__name__}, not a dict of weights")
    return content


def read_tensor(path: Path) -> Tensor:
    """Read a tensor that `torch.save` wrote. Raises `CheckpointError` as `read_checkpoint` does."""
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
            f"{path} is damaged, or holds more than tensors, which could execute code, and is not loaded: {reason}"
        ) from error
    except Exception as error:  # a damaged file can raise any exception
        reason = truncate(" ".join(str(error).split()), 200) or type(error).__name__
        raise CheckpointError(f"{path} cannot be read as a checkpoint of PyTorch: {reason}") from error
    return content


def state_dict(content: Any, place: str) -> dict[str, Tensor]:
    """Return the tensors of a dict by name, without gradients. Raises `CheckpointError` for any other content."""
    if not isinstance(content, Mapping) or not content:
        raise CheckpointError(f"{place} must be a dict of tensors, not {type(content).__name__} {quote(content)}")
    invalid = [
        str(name)[:60] for name, value in content.items() if not isinstance(name, str) or not torch.is_tensor(value)
    ]
    if invalid:
        raise CheckpointError(f"{place} must hold tensors only, but {', '.join(invalid[:5])} are not")
    return {name: value.detach() for name, value in content.items()}


def fill(network: nn.Module, weights: Mapping[str, Tensor], place: str) -> None:
    """Load `weights` into a network, as float32.

    Args:
        network: The network.
        weights: Its weights.
        place: Their file, for messages.

    Raises:
        CheckpointError: With the first weights that are missing, unknown, of another shape or type, or not finite.
    """
    wrong = misfit(specs_of(network.state_dict()), specs_of(weights))
    infinite = [name for name, value in weights.items() if not value.isfinite().all()]
    if wrong or infinite:
        reasons = "; ".join(filter(None, [wrong, list_problems({"not finite": infinite})]))
        raise CheckpointError(f"{place} does not fit {type(network).__name__}. {reasons}")
    network.load_state_dict({name: value.float() for name, value in weights.items()})
    network.eval().requires_grad_(False)


def build_parts(
    config: Mapping[str, Any],
    weights: Mapping[str, Tensor],
    settings: Path,
    place: str,
    parts: Mapping[str, Part] = PARTS,
) -> dict[str, Any]:
    """Build the parts of a model with `run.build_fitting`, from a description of published settings.

    Args:
        config: Description of each part.
        weights: Weights of the network.
        settings: File of the settings, for messages.
        place: File of the weights, for messages.
        parts: Legal values of each part.

    Raises:
        CheckpointError: If the parts cannot be built, or the weights do not fit.
    """
    try:
        return build_fitting(config, specs_of(weights), place, parts)
    except RunError as error:
        raise CheckpointError(str(error) if place in str(error) else f"{settings}: {error}") from error


def check_size(value: Any, name: str, path: Path, most: int = 10_000) -> int:
    """Check that a setting is a positive integer.

    Args:
        value: The value.
        name: Name of the setting.
        path: File of the settings.
        most: Maximum.

    Raises:
        CheckpointError: If it is not.
    """
    if isinstance(value, bool) or not isinstance(value, int) or not 1 <= value <= most:
        raise CheckpointError(f"{path}: {name} must be a positive integer up to {most}, not {quote(value)}")
    return value


def size_of(weights: Mapping[str, Tensor], name: str, dimension: int, place: str) -> int:
    """Return one dimension of a weight.

    Args:
        weights: The weights.
        name: Name of the weight.
        dimension: Index of the dimension.
        place: File of the weights, for messages.

    Raises:
        CheckpointError: If there is no such weight.
    """
    if name not in weights or weights[name].ndim <= dimension:
        raise CheckpointError(f"{place} has no weight {name}; it belongs to another model")
    return weights[name].shape[dimension]


def read_json(path: Path) -> dict[str, Any]:
    """Read the settings of a `.json` file. Raises `CheckpointError` if it holds none."""
    try:
        settings = json.loads(path.read_text(encoding="utf-8-sig"))
    except (OSError, UnicodeDecodeError, ValueError, RecursionError) as error:
        raise CheckpointError(f"{path} cannot be read: {error}") from error
    if not isinstance(settings, dict):
        raise CheckpointError(f"{path} must hold settings by name, not {quote(settings)}")
    return settings


def read_statistics(mean: Path, std: Path, width: int) -> Statistics:
    """Read the mean and standard deviation of `width` features from two `.npy` files.

    Args:
        mean: File of the mean.
        std: File of the standard deviation.
        width: Number of features.

    Raises:
        CheckpointError: If a file is missing or invalid.
    """
    values = []
    for path in (mean, std):
        if not path.is_file():
            raise CheckpointError(f"{path} does not exist; the weights need their mean and std")
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
    """Read the mean and standard deviation from two files that `torch.save` wrote; see `statistics_plus_epsilon`.

    Args:
        mean: File of the mean.
        std: File of the standard deviation.
        width: Number of features.

    Raises:
        CheckpointError: If a file is missing or invalid.
    """
    means, stds = (read_tensor(path) for path in (mean, std))
    for path, value in ((mean, means), (std, stds)):
        if value.shape != (width,):
            raise CheckpointError(f"{path} must hold {width} numbers, not {list(value.shape)}")
    return statistics_plus_epsilon(means, stds, f"{mean} and {std}: statistics")


def statistics_plus_epsilon(mean: Tensor, std: Tensor, place: str) -> Statistics:
    """Build statistics as the code of TMR and STMC, and FlowMDM's on BABEL, uses them: the std plus 1e-12.

    Args:
        mean: The mean.
        std: The standard deviation.
        place: Their source, for messages.

    Raises:
        CheckpointError: If a mean or a standard deviation is invalid.
    """
    try:
        return Statistics(mean.float(), std.float() + 1e-12)
    except ValueError as error:
        raise CheckpointError(f"{place} must be finite, with a std of 0 or more") from error


def identity_statistics(width: int) -> Statistics:
    """Return statistics that change nothing, for texts that a network reads unnormalised."""
    return Statistics(torch.zeros(width), torch.ones(width))


def describe_weights(path: Path, epoch: Any) -> str:
    """Return a sentence of the card: the file of the weights, and its epoch if it is known."""
    return f"Weights: {path.name}{f', after epoch {epoch}' if isinstance(epoch, int) else ''}."


def drop_prefix(weights: Mapping[str, Tensor], prefix: str) -> dict[str, Tensor]:
    """Return the weights whose names do not start with `prefix`."""
    return {name: value for name, value in weights.items() if not name.startswith(prefix)}


def only_file(folder: Path, pattern: str) -> Path:
    """Return the only file of a folder that matches the pattern.

    Raises `CheckpointError` if there is none, or several.
    """
    matches = sorted(folder.glob(pattern))
    if len(matches) != 1:
        names = ", ".join(path.name for path in matches) or "none"
        raise CheckpointError(f"{folder} should hold one {pattern}, but holds {names}; name the file itself")
    return matches[0]


def drop_tables(weights: Mapping[str, Tensor], names: Sequence[str], table: Tensor, path: Path) -> dict[str, Tensor]:
    """Drop the positional tables called `names`, which follow from a formula; their lengths may differ.

    Args:
        weights: The weights.
        names: Names of the tables.
        table: The expected table.
        path: File of the weights, for messages.

    Raises:
        CheckpointError: If a table has other numbers, that is, if the checkpoint belongs to another network.
    """
    for name in names:
        if name in weights:
            published = weights[name].float().reshape(len(weights[name]), -1)
            rows = min(len(published), len(table))
            if published.shape[1] != table.shape[1] or not torch.allclose(published[:rows], table[:rows], atol=1e-2):
                raise CheckpointError(
                    f"{path}: {name} {list(weights[name].shape)} differs from the expected positional table"
                )
    return {name: value for name, value in weights.items() if name not in names}
