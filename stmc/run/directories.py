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
from stmc.diffusion.tensors import resolve_device
from stmc.evaluators import Evaluator
from stmc.io.files import sha256, write_text, write_whole
from stmc.model import Model, Precision
from stmc.motion.body import JOINTS
from stmc.motion.body_model import Skeleton
from stmc.run.compression import compress, restore, restored_specs
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
from stmc.run.precision import advise_precision
from stmc.run.run_record import EvaluatorSettings, ModelSettings, settings_of
from stmc.run.weights import misfit, read_specs, specs_of
from stmc.settings.records import quote
from stmc.settings.renamed import with_new_names
from stmc.text.vocabulary import Calibration

BUNDLED, BUNDLED_EVALUATOR = "mdm_smpl_wide", "tmr_wide"
"""Defaults if no folder is named."""
BUNDLED_MODELS = (BUNDLED, "mdm_smpl_wide_fast", "mdm_smpl_cmu", "flow_mdm_wide")
CONFIG, STATISTICS, CARD = "config.yaml", "statistics.safetensors", "README.md"
LARGEST, SMALLEST_STD = 1e6, 1e-13
"""Bounds of statistics: no feature is a kilometre wide, and a feature below this std is constant."""


def bundled(name: str = BUNDLED) -> Path:
    """Return the folder of a model or evaluator that comes with the library."""
    return Path(str(files("stmc") / "assets" / name))


def _run_directory(folder: str | Path | None, default: str = BUNDLED) -> Path:
    """Resolve a folder, the name of a bundled run directory, or None for the `default`."""
    if folder is None:
        return bundled(default)
    is_bundled = str(folder) in (*BUNDLED_MODELS, BUNDLED_EVALUATOR) and not Path(folder).exists()
    return bundled(str(folder)) if is_bundled else Path(folder).expanduser()


def fingerprint(folder: str | Path | None = None) -> str:
    """Compute a digest that identifies the content of a run directory, wherever it is.

    The result is "" if files are missing. Without `folder`, the digest is that of the bundled model.
    """
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
    """Load a model from a run directory, or a bundled model by its name.

    Bundled models are "mdm_smpl_wide", the default; "mdm_smpl_wide_fast", distilled to four steps;
    "mdm_smpl_cmu", a smaller model trained on data that is free for all uses; and "flow_mdm_wide", a FlowMDM for
    `method="flow_mdm"`.

    Args:
        folder: Run directory or name; None loads the default.
        device: Device of the model; "auto" is the GPU if there is one.
        precision: Precision of the denoiser in sampling; see `Model`.
        trusted: Packages of your own, such as "mylab", whose classes the config may name. Their modules are imported,
            which executes them, and their classes are called with the numbers and texts of the config. Name none for a
            directory from somebody whose code you would not run.

    Raises:
        RunError: If a file is missing or damaged, weights do not fit, parts do not fit each other, or the config names
            anything but classes of this library and of trusted packages.
        ValueError: If the device or precision is unknown.

    Examples:
        >>> model = stmc.load()
        >>> model.generate("walk # 0 # 1", seed=1, steps=1)
        [Motion(20 frames at 20 fps, 1.00 s)]
    """
    if precision not in get_args(Precision):
        raise ValueError(f"unknown precision {quote(precision)}; choose from {', '.join(get_args(Precision))}")
    resolved_device = resolve_device(device)
    advise_precision(precision, resolved_device)
    folder = _run_directory(folder)
    config = _config(folder, PARTS)
    settings = settings_of(ModelSettings, config, folder / CONFIG)
    sampling = settings_of(Sampling, config, folder / CONFIG)
    parts, offsets = _restore(folder, config, PARTS, trusted)
    assert offsets is not None
    model = Model(
        **parts,
        **vars(settings),
        skeleton=Skeleton(offsets),
        config=config,
        precision=precision,
        sampling=sampling,
        vocabulary=read_model_vocabulary(folder, config),
    )
    return model.to(resolved_device)


def load_evaluator(
    folder: str | Path | None = None, device: torch.device | str = "cpu", trusted: Sequence[str] = ()
) -> Evaluator:
    """Load an evaluator from a run directory that `save_evaluator` wrote, or the bundled one, "tmr_wide".

    Args:
        folder: Run directory or name; None loads the bundled evaluator.
        device: Device of the evaluator; "auto" is the GPU if there is one.
        trusted: Trusted packages; see `load`, which raises the same errors.

    Examples:
        >>> stmc.load_evaluator().texts(["walk", "jump"]).shape
        torch.Size([2, 128])
    """
    resolved_device = resolve_device(device)
    folder = _run_directory(folder, BUNDLED_EVALUATOR)
    config = _config(folder, EVALUATOR_PARTS)
    settings = settings_of(EvaluatorSettings, config, folder / CONFIG)
    parts, _ = _restore(folder, config, EVALUATOR_PARTS, trusted)
    return Evaluator(**parts, config=config, **vars(settings)).to(resolved_device)


def save(
    model: Model, folder: str | Path, card: str, dtype: torch.dtype = torch.float32, trusted: Sequence[str] = ()
) -> Path:
    """Write a model as a run directory, and return the folder.

    Every file is complete or absent: each is written under a temporary name first, the config last.

    Args:
        model: The model.
        folder: The run directory.
        card: Text of `README.md`.
        dtype: Data type of the weights. torch.float16 halves the file and torch.int8 quarters it. With eight bits,
            each row of a matrix has its own scale, and vectors have half precision.
        trusted: Packages of your own whose classes `model.config` names; `load` needs them too.

    Raises:
        RunError: Before anything is written, if `load` would reject the result (see `check`), or if `dtype` cannot
            represent the weights.

    Examples:
        >>> folder = stmc.save(stmc.load(), "my_model", card="What it was trained on.")
        >>> sorted(path.name for path in folder.glob("*.safetensors"))
        ['statistics.safetensors', 'vocabulary.safetensors', 'weights.safetensors']
    """
    return _write(Path(folder).expanduser(), model, check(model, trusted), card, dtype)


def save_evaluator(
    evaluator: Evaluator, folder: str | Path, card: str, dtype: torch.dtype = torch.float32, trusted: Sequence[str] = ()
) -> Path:
    """Write an evaluator as a run directory, and return the folder. The arguments are those of `save`."""
    return _write(Path(folder).expanduser(), evaluator, check(evaluator, trusted), card, dtype)


def calibrate(folder: str | Path | None, calibration: Calibration) -> Path:
    """Store success rates of a model in its run directory, and return the file. `load` reads it into `vocabulary`.

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
    """Return the config that `save` writes for a model or an evaluator.

    Raises `RunError` if `load` would reject it or build something else: `config` lacks a part, names a class that is
    neither of this library nor `trusted`, or describes another network, or settings or statistics are out of range.
    """
    parts, kind = (PARTS, ModelSettings) if isinstance(record, Model) else (EVALUATOR_PARTS, EvaluatorSettings)
    name, network = next(iter(parts)), _network(record)
    absent = [part for part in parts if part not in record.config]
    if absent:
        raise RunError(f"model.config does not describe {', '.join(absent)}")
    config, network_type = {part: record.config[part] for part in parts}, type(network)
    named = config[name].get(TARGET) if isinstance(config[name], Mapping) else None
    if isinstance(named, str) and named.rpartition(".")[2] != network_type.__name__:
        full_name = f"{network_type.__module__}.{network_type.__name__}"
        raise RunError(
            f"the {name} is a {network_type.__name__}, but its config says {named.rpartition('.')[2]}; set "
            f"config=model.config | {{'{name}': {{'_target_': '{full_name}', …}}}}"
        )
    sketched = sketch_fitting(config, specs_of(network.state_dict()), "the network", name, parts[name], trusted)
    if type(sketched) is not network_type:
        raise RunError(
            f"the {name} is a {network_type.__name__} of {network_type.__module__}, but its config says {named}"
        )
    built = build(config, {other: part for other, part in parts.items() if other != name}, trusted)
    check_widths(config[name], built)
    for statistic, shape in _shapes(built, parts).items():
        _check_numbers(_numbers(record)[statistic], shape, f"the model: {statistic}")
    settings = {setting: getattr(record, setting) for setting in kind.__dataclass_fields__}
    sampling = record.sampling.given if isinstance(record, Model) else {}
    return config | vars(settings_of(kind, settings, "the model")) | dict(sampling)


def _network(record: Model | Evaluator) -> Any:
    """Return the part with the weights: a module, or the function that takes its place in a model."""
    return record.denoiser if isinstance(record, Model) else record.network


def _numbers(record: Model | Evaluator) -> dict[str, torch.Tensor]:
    """Return the content of `statistics.safetensors`."""
    numbers = {
        f"{side}_{moment}": getattr(getattr(record, f"{side}_statistics"), moment)
        for side in ("motion", "text")
        for moment in ("mean", "std")
    }
    return numbers | ({"skeleton": record.skeleton.offsets} if isinstance(record, Model) else {})


def _shapes(built: Mapping[str, Any], parts: Mapping[str, Part]) -> dict[str, tuple[int, ...]]:
    """Return the shapes of the statistics that fit the parts."""
    widths = {"motion": built["representation"].width, "text": built["text_encoder"].width}
    shapes: dict[str, tuple[int, ...]] = {
        f"{side}_{moment}": (width,) for side, width in widths.items() for moment in ("mean", "std")
    }
    return shapes | ({"skeleton": (len(JOINTS), 3)} if parts is PARTS else {})


def _write(folder: Path, record: Model | Evaluator, config: Mapping[str, Any], card: str, dtype: torch.dtype) -> Path:
    originals = {name: value.detach().cpu() for name, value in _network(record).state_dict().items()}
    weights = compress(originals, dtype)
    if wrong := misfit(specs_of(originals), restored_specs(specs_of(weights))):
        raise RunError(f"weights stored as {dtype} could not be loaded: {wrong}")
    overflowing = [name for name, value in originals.items() if not _fits_range(weights[name].dtype, value)]
    if overflowing:
        raise RunError(f"weights that are not finite or exceed the range of {dtype}: {', '.join(overflowing)}")
    numbers = {name: value.detach().cpu().contiguous() for name, value in _numbers(record).items()}
    without_digest = config_text(config)

    def write_weights(path: Path) -> None:
        save_file({name: value.contiguous() for name, value in weights.items()}, path)
        if (folder / CONFIG).exists():  # the folder must load even if the process is killed between old and new files
            write_text(folder / CONFIG, without_digest)

    write_whole(folder / WEIGHTS, write_weights)
    write_whole(folder / STATISTICS, lambda path: save_file(numbers, path))
    write_model_vocabulary(record.vocabulary if isinstance(record, Model) else None, folder)
    write_whole(folder / CARD, lambda path: path.write_text(card, encoding="utf-8"))
    write_text(folder / CONFIG, config_text({**config, "digest": _digest(folder)}))
    return folder


def _fits_range(dtype: torch.dtype, value: torch.Tensor) -> bool:
    """Return whether `dtype` has the range of `value`, before rounding: some versions of PyTorch saturate."""
    largest = torch.finfo(dtype if dtype.is_floating_point else torch.float32).max
    return not value.is_floating_point() or bool((value.abs() <= largest).all())


_DIGESTED = {"weights": WEIGHTS, "statistics": STATISTICS, "vocabulary": VOCABULARY}
_NEEDED = {"weights", "statistics"}


def _digest(folder: Path) -> dict[str, str]:
    """Compute the SHA-256 of each existing file of numbers."""
    digests = {}
    for name, file_name in _DIGESTED.items():
        if (folder / file_name).exists():
            digests[name] = sha256(folder / file_name)
    return digests


def _check_digest(folder: Path, config: Mapping[str, Any]) -> None:
    """Check the digests in a config; files from before the digest have none."""
    expected = config.get("digest")
    if expected is None:
        return
    if not isinstance(expected, Mapping) or not _NEEDED <= set(expected) <= set(_DIGESTED):
        raise RunError(
            f"{folder / CONFIG}: digest={quote(expected)} must give weights and statistics, and may give vocabulary"
        )
    actual = _digest(folder)
    for name, digest in expected.items():
        if actual.get(name) != digest:
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


def _restore(
    folder: Path, config: Mapping[str, Any], parts: Mapping[str, Part], trusted: Sequence[str]
) -> tuple[dict[str, Any], torch.Tensor | None]:
    """Return the parts with their weights, with the statistics, and the offsets of a model's skeleton."""
    try:
        specs = restored_specs(read_specs(folder / WEIGHTS))
        built = build_fitting(config, specs, str(folder / WEIGHTS), parts, trusted)
    except RunError as error:
        raise RunError(str(error) if str(folder) in str(error) else f"{folder / CONFIG}: {error}") from error
    numbers = _read_numbers(folder / STATISTICS, _shapes(built, parts))
    _check_digest(folder, config)
    _fill(built[next(iter(parts))], folder / WEIGHTS)
    statistics = {
        f"{side}_statistics": Statistics(numbers[f"{side}_mean"], numbers[f"{side}_std"]) for side in ("motion", "text")
    }
    return built | statistics, numbers.get("skeleton")


def _read_numbers(path: Path, shapes: Mapping[str, tuple[int, ...]]) -> dict[str, torch.Tensor]:
    """Read statistics with the shapes that the other parts need."""
    specs = read_specs(path)
    for name, shape in shapes.items():
        if name not in specs:
            raise RunError(f"{path}: {name} missing")
        if specs[name].shape != shape or specs[name].dtype not in (torch.float32, torch.float64):
            actual = f"{specs[name].dtype} {specs[name].shape}"
            raise RunError(f"{path}: {name} must be {shape} finite numbers, not {actual}")
    try:
        with safe_open(path, "pt") as file:
            numbers = {
                name: file.get_tensor(name).clone() for name in shapes
            }  # copied, because the file may be replaced
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
            name: value.float() if value.is_floating_point() else value
            for name, value in restore(load_file(path)).items()
        }
    except (SafetensorError, OSError) as error:
        raise RunError(f"{path} cannot be read: {brief(error)}") from error
    invalid = [name for name, value in weights.items() if not value.isfinite().all()]
    if invalid:
        raise RunError(f"{path} holds weights that are not finite: {', '.join(invalid[:3])}")
    network.load_state_dict(weights)
    network.eval().requires_grad_(False)
