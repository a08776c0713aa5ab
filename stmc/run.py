"""Run directories: a model as files, and back. The only library module that sees Hydra.

A run directory holds `config.yaml` (how to build the parts), `weights.safetensors`, `statistics.safetensors` and a card,
`README.md`. Nothing in it is unpickled, and only this library's own classes are built from it.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from importlib.resources import files
from pathlib import Path
from typing import Any

import torch
from hydra.utils import get_class, instantiate
from omegaconf import OmegaConf
from safetensors import SafetensorError
from safetensors.torch import load_file, save_file

from stmc.body_model import Skeleton
from stmc.model import Model
from stmc.statistics import Statistics

BUNDLED = "mdm_smpl_bandai"
CONFIG, WEIGHTS, STATISTICS, CARD = "config.yaml", "weights.safetensors", "statistics.safetensors", "README.md"
PARTS = ("denoiser", "schedule", "text_encoder", "representation")


class RunError(ValueError):
    """A folder that is no run directory, or a damaged one; the message names the file and what is wrong with it."""


def bundled() -> Path:
    """Where the model lies that comes with the library."""
    return Path(str(files("stmc") / "assets" / BUNDLED))


def load(folder: str | Path | None = None, device: torch.device | str = "cpu") -> Model:
    """The model of a run directory, wherever it was moved to; without `folder`, the bundled one.

    Raises `RunError` for a missing or damaged file, for weights that do not fit, and for a config that asks for anything
    but this library's classes.
    """
    folder = bundled() if folder is None else Path(folder).expanduser()
    missing = [name for name in (CONFIG, WEIGHTS, STATISTICS) if not (folder / name).is_file()]
    if missing:
        raise RunError(f"{folder} is not a run directory: {', '.join(missing)} missing")
    config = OmegaConf.to_container(OmegaConf.load(folder / CONFIG), resolve=True)
    absent = [key for key in (*PARTS, "fps", "longest", "prediction") if key not in config]
    if absent:
        raise RunError(f"{folder / CONFIG}: {', '.join(absent)} missing")
    parts = build(config)
    _fill(parts["denoiser"], folder / WEIGHTS)
    numbers = _tensors(folder / STATISTICS)
    try:
        model = Model(
            **parts,
            motion_statistics=Statistics(numbers["motion_mean"], numbers["motion_std"]),
            text_statistics=Statistics(numbers["text_mean"], numbers["text_std"]),
            skeleton=Skeleton(numbers["skeleton"]),
            fps=config["fps"],
            longest=config["longest"],
            prediction=config["prediction"],
            config=config,
        )
    except KeyError as error:
        raise RunError(f"{folder / STATISTICS}: {error} missing") from error
    return model.to(device)


def build(config: Mapping[str, Any]) -> dict[str, Any]:
    """The parts of a model from their descriptions (`_target_` and arguments), the denoiser with fresh weights.

    Raises `RunError` for a target that is not a class of this library: a run directory may come from anybody.
    """
    for part in PARTS:
        _check_targets(config[part], part)
    return {part: instantiate(config[part]) for part in PARTS}


def save(model: Model, folder: str | Path, card: str, dtype: torch.dtype = torch.float32) -> Path:
    """Writes the model as a run directory, weights in `dtype` (half precision halves the file); returns the folder.

    Every file is complete or absent: each is written under a temporary name first, the config last.
    """
    folder = Path(folder).expanduser()
    folder.mkdir(parents=True, exist_ok=True)
    weights = {name: value.detach().cpu().to(dtype).contiguous() for name, value in model.denoiser.state_dict().items()}
    numbers = {
        "motion_mean": model.motion_statistics.mean,
        "motion_std": model.motion_statistics.std,
        "text_mean": model.text_statistics.mean,
        "text_std": model.text_statistics.std,
        "skeleton": model.skeleton.offsets,
    }
    config = {part: model.config[part] for part in PARTS}
    config |= {"fps": model.fps, "longest": model.longest, "prediction": model.prediction}
    _replace(folder / WEIGHTS, lambda path: save_file(weights, path))
    _replace(folder / STATISTICS, lambda path: save_file({k: v.cpu().contiguous() for k, v in numbers.items()}, path))
    _replace(folder / CARD, lambda path: path.write_text(card, encoding="utf-8"))
    _replace(folder / CONFIG, lambda path: OmegaConf.save(OmegaConf.create(config), path))
    return folder


def _replace(path: Path, write: Any) -> None:
    temporary = path.with_name(f".{path.name}.{os.getpid()}")
    write(temporary)
    temporary.replace(path)


def _check_targets(node: Any, place: str) -> None:
    if isinstance(node, Mapping):
        target = node.get("_target_")
        if target is not None and not _ours(target):
            raise RunError(f"{place}: {target!r} is not a class of this library")
        for key, value in node.items():
            _check_targets(value, f"{place}.{key}")
    elif isinstance(node, list):
        for position, value in enumerate(node):
            _check_targets(value, f"{place}[{position}]")


def _ours(target: Any) -> bool:
    name, _, method = str(target).rpartition(".")
    if not str(target).startswith("stmc."):
        return False
    try:  # a class, or a constructor of one, such as `stmc.diffusion.Schedule.cosine`
        found = get_class(target) if target.rpartition(".")[2][:1].isupper() else get_class(name)
    except Exception:
        return False
    return found.__module__.startswith("stmc.")


def _tensors(path: Path) -> dict[str, torch.Tensor]:
    try:
        return load_file(path)
    except (SafetensorError, OSError) as error:
        raise RunError(f"{path} cannot be read: {error}") from error


def _fill(denoiser: torch.nn.Module, path: Path) -> None:
    weights = {name: value.float() for name, value in _tensors(path).items()}
    try:
        denoiser.load_state_dict(weights)
    except RuntimeError as error:
        raise RunError(f"{path} does not fit the denoiser of {CONFIG}: {error}") from error
    denoiser.eval().requires_grad_(False)
