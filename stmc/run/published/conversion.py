"""Conversion of a published checkpoint to a run directory. Each format is recognised by its files."""

from __future__ import annotations

from pathlib import Path

from stmc import run
from stmc.evaluators import Evaluator
from stmc.io.files import write_whole_folder
from stmc.run.published import import_evaluators as evaluators
from stmc.run.published import import_flow_mdm as flow_mdm
from stmc.run.published import import_mdm as mdm
from stmc.run.published import import_mdm_smpl as mdm_smpl
from stmc.run.published import import_motion_diffuse as motion_diffuse
from stmc.run.published.torch_checkpoint import CheckpointError, Imported

EXPECTED = (
    "expected one of: STMC's run directory (config.json, logs/checkpoints/last.ckpt); MDM's or FlowMDM's folder or .pt "
    "file (args.json, model000200000.pt); MotionDiffuse's folder (opt.txt, model/latest.tar, meta/mean.npy, "
    "meta/std.npy); TMR's run (config.json, last_weights/motion_encoder.pt)"
)


def convert(
    source: str | Path, output: str | Path, statistics: str | Path | None = None, text_model: str | None = None
) -> Path:
    """Convert the checkpoint at `source` to the run directory `output`, and return `output`.

    The run directory appears complete or not at all.

    Args:
        source: Folder or file of the checkpoint; see `read`.
        output: The run directory, which must not exist or must be empty.
        statistics: Folder of statistics; see `read`.
        text_model: Weights of the text encoder; see `read`.

    Raises:
        CheckpointError: If `output` is not empty, or as `read`.
    """
    output = Path(output).expanduser()
    if output.exists() and (not output.is_dir() or any(output.iterdir())):
        raise CheckpointError(f"{output} already exists; choose another output or remove it first")
    imported = read(source, statistics, text_model)
    write_whole_folder(output, lambda unfinished: _save(imported, unfinished))
    return output


def read(source: str | Path, statistics: str | Path | None = None, text_model: str | None = None) -> Imported:
    """Read the model of a published checkpoint. TMR is an evaluator, not a model.

    Args:
        source: Folder of the checkpoint, or file of its weights.
        statistics: Folder of the mean and standard deviation, for weights that come without them: `Mean.npy` and
            `Std.npy` for MDM and FlowMDM on HumanML3D, `rfeats_mean.pt` and `rfeats_std.pt` for FlowMDM on BABEL,
            `mean.pt` and `std.pt` for TMR. None uses the usual place of the format.
        text_model: Folder or hub name of the text encoder's weights; None uses the published ones on the hub.

    Raises:
        CheckpointError: If the format is unknown, or a file is missing, damaged or does not fit.
    """
    source = Path(source).expanduser()
    statistics = None if statistics is None else Path(statistics).expanduser()
    if not source.exists():
        raise CheckpointError(f"{source} does not exist; {EXPECTED}")
    if (_settings_folder(source, 1) / "args.json").is_file():
        family = flow_mdm if flow_mdm.is_flow_mdm(_settings_folder(source, 1) / "args.json") else mdm
        return family.read(source, statistics, text_model)
    if source.is_dir() and evaluators.is_tmr(source):
        return evaluators.read_tmr(source, statistics, text_model)
    if statistics is not None:
        raise CheckpointError(
            f"{source} has no args.json next to it; only the weights of MDM, FlowMDM and TMR take separate statistics"
        )
    file = source if source.is_file() else None
    if (_settings_folder(source, 2) / "opt.txt").is_file():
        return motion_diffuse.read(_settings_folder(source, 2), file, text_model)
    if (_settings_folder(source, 3) / "config.json").is_file():
        return mdm_smpl.read(_settings_folder(source, 3), file, text_model)
    raise CheckpointError(f"{source} is not a checkpoint that can be imported; {EXPECTED}")


def _settings_folder(source: Path, levels: int) -> Path:
    """Return the folder of a format's settings: `source` itself, or some levels above the file of the weights."""
    return source if source.is_dir() else source.absolute().parents[min(levels, len(source.absolute().parents)) - 1]


def _save(imported: Imported, folder: Path) -> None:
    if isinstance(imported.model, Evaluator):
        run.save_evaluator(imported.model, folder, _card(imported))
    else:
        run.save(imported.model, folder, _card(imported))


def _card(imported: Imported) -> str:
    licence = (
        "The weights are their authors', under their licence and those of the data they were trained on (HumanML3D and "
        "AMASS: not for commercial use); this library's licence does not cover them."
    )
    return "\n".join([f"# {imported.title}", "", *(f"- {fact}" for fact in imported.facts), "", licence, ""])
