"""Run directories: a model or an evaluator as files, and back. The only library module that sees Hydra.

A run directory holds `config.yaml` (how to build the parts), `weights.safetensors`, `statistics.safetensors` and a
card, `README.md`. Nothing in it is unpickled, and only this library's own classes are built from it.
"""

from __future__ import annotations

import hashlib
import inspect
from collections.abc import Mapping
from importlib.resources import files
from pathlib import Path
from typing import Any, get_args

import torch
from hydra.errors import InstantiationException
from hydra.utils import get_class, instantiate
from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException
from safetensors import SafetensorError
from safetensors.torch import load_file, save_file
from yaml import YAMLError

from stmc.body import JOINTS
from stmc.body_model import Skeleton
from stmc.diffusion import Prediction, Spread
from stmc.evaluators import Evaluator
from stmc.files import write_whole
from stmc.model import Model, Precision
from stmc.statistics import Statistics
from stmc.tensors import found_device

BUNDLED, BUNDLED_EVALUATOR = "mdm_smpl_bandai", "tmr_bandai"
CONFIG, WEIGHTS, STATISTICS, CARD = "config.yaml", "weights.safetensors", "statistics.safetensors", "README.md"
PARTS = {
    "denoiser": "stmc.denoisers",
    "schedule": "stmc.diffusion",
    "text_encoder": "stmc.text",
    "representation": "stmc.representation",
}
"""The parts of a model that a config describes, and the only place that the classes of each may come from."""
SAMPLED = ("guidance", "spread", "late")
"""How a model is sampled unless told otherwise; runs that do not say have `Model`'s defaults."""
EVALUATOR_PARTS = {
    "network": "stmc.evaluators",
    "text_encoder": "stmc.text",
    "representation": "stmc.representation",
}
"""The same of an evaluator."""


class RunError(ValueError):
    """A folder that is no run directory, or a damaged one; the message names the file and what is wrong with it."""


def bundled(name: str = BUNDLED) -> Path:
    """Where the model, or the evaluator, lies that comes with the library."""
    return Path(str(files("stmc") / "assets" / name))


def fingerprint(folder: str | Path | None = None) -> str:
    """Tells what run directories hold apart, wherever they lie: a digest of the files ("" where some are missing);
    without `folder`, of the bundled model."""
    folder = bundled() if folder is None else Path(folder).expanduser()
    files = [folder / name for name in (CONFIG, WEIGHTS, STATISTICS)]
    if not all(path.is_file() for path in files):
        return ""
    digest = hashlib.sha256()
    for path in files:
        digest.update(path.read_bytes())
    return digest.hexdigest()


def load(folder: str | Path | None = None, device: torch.device | str = "cpu", precision: Precision = "fp32") -> Model:
    """The model of a run directory, wherever it was moved to; without `folder`, the bundled one.

    `device`: "auto" is the GPU if there is one. `precision` is the denoiser's at sampling (see `Model`). Raises
    `ValueError` for a device that is not there, `RunError` for a missing or damaged file, for weights that do not fit,
    for parts that do not fit each other, and for a config that asks for anything but this library's classes.
    """
    device = found_device(device)
    folder = bundled() if folder is None else Path(folder).expanduser()
    config, parts = _opened(folder, PARTS, ("fps", "longest", "prediction"))
    config = {name: getattr(Model, name) for name in SAMPLED} | config
    _check_model(config, folder / CONFIG)
    features, width = config["denoiser"].get("features"), parts["representation"].width
    if features != width:
        raise RunError(f"{folder / CONFIG}: the denoiser has {features} features, the representation {width}")
    _fill(parts["denoiser"], folder / WEIGHTS, "denoiser")
    numbers = _numbers(folder / STATISTICS, _shapes(parts) | {"skeleton": (len(JOINTS), 3)})
    model = Model(
        **parts,
        **_statistics(numbers),
        skeleton=Skeleton(numbers["skeleton"]),
        fps=config["fps"],
        longest=config["longest"],
        prediction=config["prediction"],
        **{name: config[name] for name in SAMPLED},
        config=config,
        precision=precision,
    )
    return model.to(device)


def load_evaluator(folder: str | Path | None = None, device: torch.device | str = "cpu") -> Evaluator:
    """The evaluator of a run directory that `save_evaluator` wrote, wherever it was moved to; without `folder`, the
    bundled one. Raises as `load` does."""
    device = found_device(device)
    folder = bundled(BUNDLED_EVALUATOR) if folder is None else Path(folder).expanduser()
    config, parts = _opened(folder, EVALUATOR_PARTS, ("fps",))
    _fill(parts["network"], folder / WEIGHTS, "network")
    numbers = _numbers(folder / STATISTICS, _shapes(parts))
    return Evaluator(**parts, **_statistics(numbers), fps=config["fps"], config=config).to(device)


def build(config: Mapping[str, Any], homes: Mapping[str, str] = PARTS) -> dict[str, Any]:
    """The parts of a model from their descriptions (`_target_` and arguments), the denoiser with fresh weights.

    `homes` names the parts, and the package that each may come from. Raises `RunError` for a target that is not a class
    of this library: a run directory may come from anybody.
    """
    for part, home in homes.items():
        if not isinstance(config[part], Mapping) or "_target_" not in config[part]:
            raise RunError(f"{part} must say what to build as `_target_`, not {config[part]!r}")
        _check_targets(config[part], part, home)
    return {part: _made(config[part], part) for part in homes}


def save(model: Model, folder: str | Path, card: str, dtype: torch.dtype = torch.float32) -> Path:
    """Writes the model as a run directory, weights in `dtype` (half precision halves the file); returns the folder.

    Every file is complete or absent: each is written under a temporary name first, the config last. Raises `RunError`,
    and writes nothing, where `model.config` does not say how to build the parts, and for weights that are not finite or
    that `dtype` cannot hold.
    """
    settings = {name: getattr(model, name) for name in ("fps", "longest", "prediction", *SAMPLED)}
    numbers = _numbered(model) | {"skeleton": model.skeleton.offsets}
    return _written(Path(folder), _described(model.config, PARTS) | settings, model.denoiser, numbers, card, dtype)


def save_evaluator(evaluator: Evaluator, folder: str | Path, card: str, dtype: torch.dtype = torch.float32) -> Path:
    """Writes the evaluator as a run directory; returns the folder. Otherwise as `save`."""
    config = _described(evaluator.config, EVALUATOR_PARTS) | {"fps": evaluator.fps}
    return _written(Path(folder), config, evaluator.network, _numbered(evaluator), card, dtype)


def _described(config: Mapping[str, Any], homes: Mapping[str, str]) -> dict[str, Any]:
    unknown = [part for part in homes if part not in config]
    if unknown:
        raise RunError(f"model.config does not say how to build {', '.join(unknown)}")
    return {part: config[part] for part in homes}


def _numbered(record: Model | Evaluator) -> dict[str, torch.Tensor]:
    return {
        f"{side}_{moment}": getattr(getattr(record, f"{side}_statistics"), moment)
        for side in ("motion", "text")
        for moment in ("mean", "std")
    }


def _statistics(numbers: Mapping[str, torch.Tensor]) -> dict[str, Statistics]:
    return {
        f"{side}_statistics": Statistics(numbers[f"{side}_mean"], numbers[f"{side}_std"]) for side in ("motion", "text")
    }


def _shapes(parts: Mapping[str, Any]) -> dict[str, tuple[int, ...]]:
    """Of the statistics that fit the parts."""
    widths = {"motion": parts["representation"].width, "text": parts["text_encoder"].width}
    return {f"{side}_{moment}": (width,) for side, width in widths.items() for moment in ("mean", "std")}


def _written(
    folder: Path,
    config: dict[str, Any],
    network: torch.nn.Module,
    numbers: Mapping[str, torch.Tensor],
    card: str,
    dtype: torch.dtype,
) -> Path:
    folder = folder.expanduser()
    weights = {name: value.detach().cpu().to(dtype).contiguous() for name, value in network.state_dict().items()}
    overflown = [name for name, value in weights.items() if not value.isfinite().all()]
    if overflown:
        raise RunError(f"weights that {dtype} cannot hold, or that are not finite: {', '.join(overflown)}")
    write_whole(folder / WEIGHTS, lambda path: save_file(weights, path))
    contents = {name: value.detach().cpu().contiguous() for name, value in numbers.items()}
    write_whole(folder / STATISTICS, lambda path: save_file(contents, path))
    write_whole(folder / CARD, lambda path: path.write_text(card, encoding="utf-8"))
    write_whole(folder / CONFIG, lambda path: OmegaConf.save(OmegaConf.create(config), path))
    return folder


def _opened(folder: Path, homes: Mapping[str, str], settings: tuple[str, ...]) -> tuple[dict[str, Any], dict[str, Any]]:
    """The config of a run directory, with these `settings` in it, and its parts, not yet with their weights."""
    missing = [name for name in (CONFIG, WEIGHTS, STATISTICS) if not (folder / name).is_file()]
    if missing:
        raise RunError(f"{folder} is not a run directory: {', '.join(missing)} missing")
    config = _config(folder / CONFIG, (*homes, *settings))
    try:
        return config, build(config, homes)
    except RunError as error:
        raise RunError(f"{folder / CONFIG}: {error}") from error


def _config(path: Path, needed: tuple[str, ...]) -> dict[str, Any]:
    try:
        config = OmegaConf.to_container(OmegaConf.load(path), resolve=True)
    except (OmegaConfBaseException, YAMLError, OSError, UnicodeDecodeError) as error:
        raise RunError(f"{path} cannot be read: {error}") from error
    absent = [key for key in needed if key not in config]
    if absent:
        raise RunError(f"{path}: {', '.join(absent)} missing")
    fps = config["fps"]
    if not isinstance(fps, (int, float)) or not 0 < fps < float("inf"):
        raise RunError(f"{path}: fps must be a positive number, not {fps!r}")
    return config


def _check_model(config: Mapping[str, Any], path: Path) -> None:
    longest, prediction = config["longest"], config["prediction"]
    if not isinstance(longest, int) or longest < 1:
        raise RunError(f"{path}: longest must be a positive number of frames, not {longest!r}")
    if prediction not in get_args(Prediction):
        raise RunError(f"{path}: prediction must be one of {', '.join(get_args(Prediction))}, not {prediction!r}")
    guidance, spread, late = config["guidance"], config["spread"], config["late"]
    if not isinstance(guidance, (int, float)) or not abs(guidance) < float("inf"):
        raise RunError(f"{path}: guidance must be a number, not {guidance!r}")
    if spread not in get_args(Spread):
        raise RunError(f"{path}: spread must be one of {', '.join(get_args(Spread))}, not {spread!r}")
    if not isinstance(late, (int, float)) or not 0 <= late < 1:
        raise RunError(f"{path}: late must be a number from 0 to below 1, not {late!r}")


def _check_targets(node: Any, place: str, home: str) -> None:
    if isinstance(node, Mapping):
        target = node.get("_target_")
        if target is not None and not _comes_from(home, str(target)):
            raise RunError(f"{place}: {target!r} is not a class of {home}")
        for key, value in node.items():
            _check_targets(value, f"{place}.{key}", home)
    elif isinstance(node, list):
        for position, value in enumerate(node):
            _check_targets(value, f"{place}[{position}]", home)


def _comes_from(home: str, target: str) -> bool:
    """Whether `target` is a class of the package `home`, or a constructor such as `stmc.diffusion.Schedule.cosine`."""
    if not target.startswith(f"{home}."):
        return False
    name, _, method = target.rpartition(".")
    try:
        found = get_class(target) if method[:1].isupper() else get_class(name)
    except Exception:  # whatever it is, it is no class
        return False
    constructor = method[:1].isupper() or inspect.ismethod(getattr(found, method, None))
    return constructor and f"{found.__module__}.".startswith(f"{home}.")


def _made(description: Mapping[str, Any], part: str) -> Any:
    try:
        return instantiate(description)
    except InstantiationException as error:
        raise RunError(f"{part} cannot be built: {error}") from error


def _tensors(path: Path) -> dict[str, torch.Tensor]:
    try:
        return load_file(path)
    except (SafetensorError, OSError) as error:
        raise RunError(f"{path} cannot be read: {error}") from error


def _numbers(path: Path, shapes: Mapping[str, tuple[int, ...]]) -> dict[str, torch.Tensor]:
    """Statistics and whatever else is needed, with the shapes that the other parts need."""
    numbers = {name: value.clone() for name, value in _tensors(path).items()}  # not mapped: the file may be replaced
    for name, shape in shapes.items():
        if name not in numbers:
            raise RunError(f"{path}: {name} missing")
        if numbers[name].shape != shape or not numbers[name].isfinite().all():
            raise RunError(f"{path}: {name} must be {shape} finite numbers, not {tuple(numbers[name].shape)}")
        if name.endswith("std") and not (numbers[name] > 0).all():
            raise RunError(f"{path}: {name} must be above 0 everywhere")
    return numbers


def _fill(network: torch.nn.Module, path: Path, part: str) -> None:
    weights = {name: value.float() for name, value in _tensors(path).items()}
    broken = [name for name, value in weights.items() if not value.isfinite().all()]
    if broken:
        raise RunError(f"{path} holds weights that are not finite: {', '.join(broken)}")
    try:
        network.load_state_dict(weights)
    except RuntimeError as error:
        raise RunError(f"{path} does not fit the {part} of {CONFIG}: {error}") from error
    network.eval().requires_grad_(False)
