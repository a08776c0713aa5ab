"""Run directories: a model or an evaluator as files, and back.

A run directory holds `config.yaml` (how to build the parts, and a digest of the numbers), `weights.safetensors`,
`statistics.safetensors` and a card, `README.md`; a model's perhaps `vocabulary.safetensors` and `calibration.json`. All
of it is data: nothing is unpickled, interpolated or imported on a file's behalf, and before memory is asked for the
network is compared with the weights' header.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from importlib.resources import files
from pathlib import Path
from typing import Any, get_args

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import load_file, save_file

from stmc.composing.sampling import Sampling
from stmc.diffusion.statistics import Statistics
from stmc.diffusion.tensors import found_device
from stmc.evaluators import Evaluator
from stmc.io.files import sha256, write_text, write_whole
from stmc.model import Model, Precision
from stmc.motion.body import JOINTS
from stmc.motion.body_model import Skeleton
from stmc.run.configs import TARGET, RunError, brief, config_text, read_config
from stmc.run.construction import Part
from stmc.run.model_vocabulary import (
    VOCABULARY,
    WEIGHTS,
    read_model_vocabulary,
    write_model_calibration,
    write_model_vocabulary,
)
from stmc.run.parts import EVALUATOR_PARTS, PARTS, build, build_fitting, check_widths, sketch_fitting
from stmc.run.run_record import EvaluatorSettings, ModelSettings, settings_of
from stmc.run.weights import misfit, read_specs, specs_of
from stmc.settings.records import shown
from stmc.settings.renamed import with_new_names
from stmc.text.vocabulary import Calibration

BUNDLED, BUNDLED_EVALUATOR = "mdm_smpl_wide", "tmr_wide"
"""What is loaded where no folder is named."""
BUNDLED_MODELS = (BUNDLED, "mdm_smpl_wide_fast", "mdm_smpl_cmu", "flow_mdm_wide")
CONFIG, STATISTICS, CARD = "config.yaml", "statistics.safetensors", "README.md"
LARGEST, SMALLEST_STD = 1e6, 1e-13
"""Bounds of statistics: no feature is a kilometre wide, and what varies less than this does not vary."""


def bundled(name: str = BUNDLED) -> Path:
    """Where the model, or the evaluator, lies that comes with the library."""
    return Path(str(files("stmc") / "assets" / name))


def _run_directory(folder: str | Path | None, default: str = BUNDLED) -> Path:
    """The folder or, where there is none, what comes with the library under that name; for None, the `default`."""
    if folder is None:
        return bundled(default)
    ours = str(folder) in (*BUNDLED_MODELS, BUNDLED_EVALUATOR) and not Path(folder).exists()
    return bundled(str(folder)) if ours else Path(folder).expanduser()


def fingerprint(folder: str | Path | None = None) -> str:
    """Tells what run directories hold apart, wherever they lie: a digest of the files ("" where some are missing);
    without `folder`, of the bundled model."""
    folder = _run_directory(folder)
    files = [folder / name for name in (CONFIG, WEIGHTS, STATISTICS)]
    if not all(path.is_file() for path in files):
        return ""
    digest = hashlib.sha256()
    for path in files:
        digest.update(path.read_bytes())
    return digest.hexdigest()


def load(
    folder: str | Path | None = None,
    device: torch.device | str = "cpu",
    precision: Precision = "fp32",
    trusted: Sequence[str] = (),
) -> Model:
    """The model of a run directory, wherever it was moved to, or of a name that comes with the library:
    "mdm_smpl_wide", also without `folder`; "mdm_smpl_wide_fast", the same distilled, in half the time; "mdm_smpl_cmu",
    smaller, of data that is free for all uses; and "flow_mdm_wide", a FlowMDM, for `method="flow_mdm"`.

    `device`: "auto" is the GPU if there is one. `precision` is the denoiser's at sampling (see `Model`). `trusted`
    names packages of your own, such as "mylab", whose classes the config may name beside this library's: their modules
    are then imported, which runs them, and their classes called with the config's numbers and texts. So name none for
    a directory from somebody whose code you would not run.

    Raises `RunError` for a missing or damaged file, for weights that do not fit, for parts that do not fit each other,
    and for a config that asks for anything but this library's classes; `ValueError` for an unknown device or precision.

    Examples:
        >>> model = stmc.load()
        >>> model.generate("walk # 0 # 1", seed=1, steps=1)
        [Motion(20 frames at 20 fps, 1.00 s)]
    """
    if precision not in get_args(Precision):
        raise ValueError(f"unknown precision {shown(precision)}; choose from {', '.join(get_args(Precision))}")
    place = found_device(device)
    folder = _run_directory(folder)
    config = _config(folder, PARTS)
    settings = settings_of(ModelSettings, config, folder / CONFIG)
    sampling = settings_of(Sampling, config, folder / CONFIG)
    parts, statistics, offsets = _restored(folder, config, PARTS, trusted)
    model = Model(
        **parts,
        **statistics,
        **vars(settings),
        skeleton=Skeleton(offsets),
        config=config,
        precision=precision,
        sampling=sampling,
        vocabulary=read_model_vocabulary(folder, config),
    )
    return model.to(place)


def load_evaluator(
    folder: str | Path | None = None, device: torch.device | str = "cpu", trusted: Sequence[str] = ()
) -> Evaluator:
    """The evaluator of a run directory that `save_evaluator` wrote, wherever it was moved to; without `folder`, the
    bundled one, whose name is "tmr_wide". `trusted` and errors are those of `load`.

    Examples:
        >>> stmc.load_evaluator().texts(["walk", "jump"]).shape
        torch.Size([2, 128])
    """
    place = found_device(device)
    folder = _run_directory(folder, BUNDLED_EVALUATOR)
    config = _config(folder, EVALUATOR_PARTS)
    settings = settings_of(EvaluatorSettings, config, folder / CONFIG)
    parts, statistics, _ = _restored(folder, config, EVALUATOR_PARTS, trusted)
    return Evaluator(**parts, **statistics, config=config, **vars(settings)).to(place)


def save(
    model: Model,
    folder: str | Path,
    card: str,
    dtype: torch.dtype = torch.float32,
    trusted: Sequence[str] = (),
) -> Path:
    """Writes the model as a run directory, weights in `dtype`; returns the folder. torch.float16 halves the file,
    torch.float8_e4m3fn quarters it: of eight bits are the matrices alone, vectors stay in half precision.

    Every file is complete or absent: each is written under a temporary name first, the config last. Raises `RunError`,
    and writes nothing, for what `load` would refuse (see `check`), and for weights that `dtype` cannot hold. `trusted`
    names the packages of your own that `model.config` names classes of; whoever loads the model has to name them too.

    Examples:
        >>> folder = stmc.save(stmc.load(), "my_model", card="What it was trained on.")
        >>> sorted(path.name for path in folder.glob("*.safetensors"))
        ['statistics.safetensors', 'vocabulary.safetensors', 'weights.safetensors']
    """
    return _written(Path(folder).expanduser(), model, check(model, trusted), card, dtype)


def save_evaluator(
    evaluator: Evaluator,
    folder: str | Path,
    card: str,
    dtype: torch.dtype = torch.float32,
    trusted: Sequence[str] = (),
) -> Path:
    """Writes the evaluator as a run directory; returns the folder. Otherwise as `save`."""
    return _written(Path(folder).expanduser(), evaluator, check(evaluator, trusted), card, dtype)


def calibrate(folder: str | Path | None, calibration: Calibration) -> Path:
    """Store what was measured of a run directory's model in the directory; return the file, which replaces an older
    one. Its next `load` has it in `vocabulary.calibration`.

    Examples:
        >>> folder = stmc.save(stmc.load(), "my_run", card="")
        >>> trials = {"bow": stmc.text.vocabulary.Trial("bow", samples=8, geometry=0.25)}
        >>> stmc.run.calibrate(folder, stmc.text.vocabulary.Calibration(trials)).name
        'calibration.json'
        >>> [bow] = stmc.load(folder).recognise(["bow"])
        >>> bow.advice
        "'bow' rarely works: 25 % of samples show it"
    """
    return write_model_calibration(calibration, _run_directory(folder))


def check(record: Model | Evaluator, trusted: Sequence[str] = ()) -> dict[str, Any]:
    """The config that `save` writes for a model or an evaluator.

    Raises `RunError` where `load` would refuse it, or give something else: a part that `config` does not describe, a
    class that is neither ours nor `trusted`, another network than `config` says, settings or statistics out of range.
    """
    parts, kind = (PARTS, ModelSettings) if isinstance(record, Model) else (EVALUATOR_PARTS, EvaluatorSettings)
    name, network = next(iter(parts)), _network(record)
    absent = [part for part in parts if part not in record.config]
    if absent:
        raise RunError(f"model.config does not say how to build {', '.join(absent)}")
    config, own = {part: record.config[part] for part in parts}, type(network)
    named = config[name].get(TARGET) if isinstance(config[name], Mapping) else None
    if isinstance(named, str) and named.rpartition(".")[2] != own.__name__:
        raise RunError(
            f"the {name} is a {own.__name__}, but its config says {named.rpartition('.')[2]}: give the model "
            f"config=model.config | {{'{name}': {{'_target_': '{own.__module__}.{own.__name__}', …}}}}"
        )
    sketched = sketch_fitting(config, specs_of(network.state_dict()), "the network", name, parts[name], trusted)
    if type(sketched) is not own:
        raise RunError(f"the {name} is a {own.__name__} of {own.__module__}, but its config says {named}")
    built = build(config, {part: each for part, each in parts.items() if part != name}, trusted)
    check_widths(config[name], built)
    for statistic, shape in _shapes(built, parts).items():
        _check_numbers(_numbers(record)[statistic], shape, f"the model: {statistic}")
    named = {setting: getattr(record, setting) for setting in kind.__dataclass_fields__}
    sampling = record.sampling.given if isinstance(record, Model) else {}
    return config | vars(settings_of(kind, named, "the model")) | dict(sampling)


def _network(record: Model | Evaluator) -> torch.nn.Module:
    return record.denoiser if isinstance(record, Model) else record.network


def _numbers(record: Model | Evaluator) -> dict[str, torch.Tensor]:
    """What `statistics.safetensors` holds."""
    numbers = {
        f"{side}_{moment}": getattr(getattr(record, f"{side}_statistics"), moment)
        for side in ("motion", "text")
        for moment in ("mean", "std")
    }
    return numbers | ({"skeleton": record.skeleton.offsets} if isinstance(record, Model) else {})


def _shapes(built: Mapping[str, Any], parts: Mapping[str, Part]) -> dict[str, tuple[int, ...]]:
    """Of the statistics that fit the parts."""
    widths = {"motion": built["representation"].width, "text": built["text_encoder"].width}
    shapes: dict[str, tuple[int, ...]] = {
        f"{side}_{moment}": (width,) for side, width in widths.items() for moment in ("mean", "std")
    }
    return shapes | ({"skeleton": (len(JOINTS), 3)} if parts is PARTS else {})


def _written(folder: Path, record: Model | Evaluator, config: Mapping[str, Any], card: str, dtype: torch.dtype) -> Path:
    held = {name: value.detach().cpu() for name, value in _network(record).state_dict().items()}
    weights = {name: value.to(_dtype_in_file(value, dtype)).contiguous() for name, value in held.items()}
    if wrong := misfit(specs_of(held), specs_of(weights)):
        raise RunError(f"weights as {dtype} could not be read back: {wrong}")
    overflown = [name for name, value in held.items() if not _holds(weights[name].dtype, value)]
    if overflown:
        raise RunError(f"weights that {dtype} cannot hold, or that are not finite: {', '.join(overflown)}")
    numbers = {name: value.detach().cpu().contiguous() for name, value in _numbers(record).items()}
    without_digest = config_text(config)

    def write_weights(path: Path) -> None:
        save_file(weights, path)
        if (folder / CONFIG).exists():  # killed between old and new files, the folder must still load
            write_text(folder / CONFIG, without_digest)

    write_whole(folder / WEIGHTS, write_weights)
    write_whole(folder / STATISTICS, lambda path: save_file(numbers, path))
    write_model_vocabulary(record.vocabulary if isinstance(record, Model) else None, folder)
    write_whole(folder / CARD, lambda path: path.write_text(card, encoding="utf-8"))
    write_text(folder / CONFIG, config_text({**config, "digest": _digest(folder)}))
    return folder


def _dtype_in_file(value: torch.Tensor, dtype: torch.dtype) -> torch.dtype:
    """What a weight is in its file. A vector's numbers count for many: a norm's gain, rounded by 6 %, would tell."""
    if not value.is_floating_point():
        return value.dtype
    return torch.float16 if dtype.itemsize == 1 and value.ndim < 2 else dtype


def _holds(dtype: torch.dtype, value: torch.Tensor) -> bool:
    """Whether nothing is lost but digits. Asked before rounding: some versions of PyTorch cut what is too large."""
    return not dtype.is_floating_point or bool((value.abs() <= torch.finfo(dtype).max).all())


_DIGESTED = {"weights": WEIGHTS, "statistics": STATISTICS, "vocabulary": VOCABULARY}
_NEEDED = {"weights", "statistics"}


def _digest(folder: Path) -> dict[str, str]:
    """SHA-256 of the files with numbers that there are."""
    digests = {}
    for name, file_name in _DIGESTED.items():
        if (folder / file_name).exists():
            digests[name] = sha256(folder / file_name)
    return digests


def _check_digest(folder: Path, config: Mapping[str, Any]) -> None:
    """Files older than the digest have none."""
    told = config.get("digest")
    if told is None:
        return
    if not isinstance(told, Mapping) or not _NEEDED <= set(told) <= set(_DIGESTED):
        raise RunError(f"{folder / CONFIG}: digest={shown(told)}: must give weights, statistics and perhaps vocabulary")
    found = _digest(folder)
    for name, digest in told.items():
        if found.get(name) != digest:
            raise RunError(f"{folder / _DIGESTED[name]} is damaged: its SHA-256 is not the digest in {CONFIG}")


def _config(folder: Path, parts: Mapping[str, Part]) -> dict[str, Any]:
    missing = [name for name in (CONFIG, WEIGHTS, STATISTICS) if not (folder / name).is_file()]
    if missing:
        raise RunError(f"{folder} is not a run directory: {', '.join(missing)} missing")
    config = with_new_names(read_config(folder / CONFIG))
    absent = [name for name in parts if name not in config]
    if absent:
        raise RunError(f"{folder / CONFIG}: {', '.join(absent)} missing")
    return config


def _restored(
    folder: Path, config: Mapping[str, Any], parts: Mapping[str, Part], trusted: Sequence[str]
) -> tuple[dict[str, Any], dict[str, Statistics], torch.Tensor | None]:
    """The parts with their weights, the statistics, and the offsets of a model's skeleton."""
    try:
        built = build_fitting(config, read_specs(folder / WEIGHTS), str(folder / WEIGHTS), parts, trusted)
    except RunError as error:
        raise RunError(str(error) if str(folder) in str(error) else f"{folder / CONFIG}: {error}") from error
    numbers = _read_numbers(folder / STATISTICS, _shapes(built, parts))
    _check_digest(folder, config)
    _fill(built[next(iter(parts))], folder / WEIGHTS)
    statistics = {
        f"{side}_statistics": Statistics(numbers[f"{side}_mean"], numbers[f"{side}_std"]) for side in ("motion", "text")
    }
    return built, statistics, numbers.get("skeleton")


def _read_numbers(path: Path, shapes: Mapping[str, tuple[int, ...]]) -> dict[str, torch.Tensor]:
    """Statistics and whatever else is needed, with the shapes that the other parts need."""
    specs = read_specs(path)
    for name, shape in shapes.items():
        if name not in specs:
            raise RunError(f"{path}: {name} missing")
        if specs[name].shape != shape or specs[name].dtype not in (torch.float32, torch.float64):
            found = f"{specs[name].dtype} {specs[name].shape}"
            raise RunError(f"{path}: {name} must be {shape} finite numbers, not {found}")
    try:
        with safe_open(path, "pt") as file:
            numbers = {name: file.get_tensor(name).clone() for name in shapes}  # not mapped: the file may be replaced
    except (SafetensorError, OSError) as error:
        raise RunError(f"{path} cannot be read: {brief(error)}") from error
    for name, shape in shapes.items():
        _check_numbers(numbers[name], shape, f"{path}: {name}")
    return numbers


def _check_numbers(values: torch.Tensor, shape: tuple[int, ...], place: str) -> None:
    if tuple(values.shape) != shape or not (values.abs() <= LARGEST).all():
        raise RunError(f"{place} must be {shape} finite numbers of at most {LARGEST:g}, not {tuple(values.shape)}")
    if place.endswith("std") and not (values >= SMALLEST_STD).all():
        raise RunError(f"{place} must be above 0 everywhere")


def _fill(network: torch.nn.Module, path: Path) -> None:
    try:
        weights = {
            name: value.float() if value.is_floating_point() else value for name, value in load_file(path).items()
        }
    except (SafetensorError, OSError) as error:
        raise RunError(f"{path} cannot be read: {brief(error)}") from error
    broken = [name for name, value in weights.items() if not value.isfinite().all()]
    if broken:
        raise RunError(f"{path} holds weights that are not finite: {', '.join(broken[:3])}")
    network.load_state_dict(weights)
    network.eval().requires_grad_(False)
