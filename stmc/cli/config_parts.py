"""Build parts of a command's configuration with the constructor of run directories and a table of its own.

A configuration may come from a stranger: a file in `--config-dir`, or an override. It can build only classes and
functions of the table below and of packages that the command line trusts.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from importlib import import_module
from inspect import Signature
from typing import Any

from omegaconf import OmegaConf

from stmc.run import Part, construct, signature_of
from stmc.run.configs import TARGET
from stmc.settings.records import SettingError, field_infos, quote

_PLUGINS, _LOGS = ("hydra._internal.", "hydra_plugins."), ("logging.", "colorlog.")
_SOURCES = "stmc.data.sources"
NAMES = (
    "stmc.training.Settings",
    "stmc.training.Denoising",
    "stmc.training.TmrObjective",
    "stmc.training.data.dataset.Dataset",
    "stmc.training.data.balanced_batches.BalancedBatches",
    "stmc.training.data.epoch_batches.EpochBatches",
    "stmc.training.data.packed_rows.PackedRows",
    "stmc.training.data.recorded_rows.RecordedRows",
    "stmc.training.data.prolonging.Prolonging",
    "stmc.training.data.limb_velocity.FootVelocity",
    "stmc.training.data.limb_velocity.LimbVelocity",
    "stmc.data.cache.read_caches",
    f"{_SOURCES}.amass.annotated_amass.AnnotatedAmass",
    f"{_SOURCES}.babel.babel_rows.read_babel_labels",
    f"{_SOURCES}.babel.babel_rows.RowConversion",
    f"{_SOURCES}.bandai.bandai_clips.BandaiClips",
    f"{_SOURCES}.caption_tags.Tags.read",
    f"{_SOURCES}.cmu.cmu_clips.CmuClips",
    f"{_SOURCES}.cmu.cmu_recordings.CmuRecordings",
    f"{_SOURCES}.babel.composition_lists.read_compositions",
    f"{_SOURCES}.babel.composition_references.babel_references",
    f"{_SOURCES}.babel.composition_references.humanml3d_references",
    f"{_SOURCES}.edited.edited_clips.EditedClips",
    f"{_SOURCES}.humanml3d.humanml3d_folder.ProcessedHumanML3D",
    f"{_SOURCES}.humanml3d.humanml3d_clips.read_captioned_clips",
    f"{_SOURCES}.babel.teach_recordings.TeachRecordings",
    "stmc.evaluation.benchmarks.Compositions",
    "stmc.evaluation.benchmarks.PublishedCompositions",
    "stmc.evaluation.benchmarks.SingleText",
    "stmc.evaluation.benchmarks.mtt_open",
    "stmc.evaluation.benchmarks.open_mtt",
    "stmc.evaluation.benchmarks.published_mtt",
    "stmc.run.published.read_guo_evaluator",
    "stmc.evaluation.results.comparison_table",
    "stmc.evaluation.results.repetition_table",
    "stmc.evaluation.results.single_text_table",
    "stmc.evaluation.results.sweep_table",
    "stmc.evaluation.results.with_published",
    "stmc.evaluation.results.charts.bars",
    "stmc.evaluation.results.charts.quality_against_cost",
    "stmc.evaluation.results.charts.sweep",
    "stmc.evaluation.results.composition_charts.jerk_curves",
    "stmc.evaluation.results.composition_charts.trade_off",
    "stmc.motion.representation.SmplRepresentation",
    "stmc.motion.representation.BabelRepresentation",
    "stmc.motion.representation.HumanML3DRepresentation",
)
"""Names in `_target_` of the classes and functions that configurations may build, besides text encoders."""


def build_part(config: Any, place: str, kind: type = object, **given: Any) -> Any:
    """Build one part of a configuration.

    Raises `RunError` for a name that is neither in the table nor in a trusted package, and for invalid arguments.

    Args:
        config: Composed configuration.
        place: Dotted key of the part, such as `data.sampling`.
        kind: Class that the part must be an instance of.
        **given: Arguments that override those of the configuration.
    """
    return construct(describe_part(config, place) | given, place, _part(kind), _trusted(config))


def signature_of_part(config: Any, place: str) -> Signature:
    """Return the signature of the part at `place`. Raises the errors of `build_part`."""
    return signature_of(describe_part(config, place), place, _part(object), _trusted(config))


def record_of_part(config: Any, place: str) -> type | None:
    """Return the class of the part at `place` if it is in the table and a record of settings, or else None."""
    target = OmegaConf.select(config, f"{place}.{TARGET}")
    if target not in NAMES:
        return None
    module, _, name = target.rpartition(".")
    record = getattr(import_module(module), name)
    is_record = isinstance(record, type) and dataclasses.is_dataclass(record) and field_infos(record)
    return record if is_record else None


def describe_part(config: Any, place: str) -> dict[str, Any]:
    """Return the description of the part at `place` as plain data. Raises `SettingError` if there is none."""
    node = OmegaConf.select(config, place)
    if not OmegaConf.is_dict(node):
        raise SettingError(f"{place}={quote(node)}: must be a table with `_target_`")
    return resolve_config(node)


def resolve_config(config: Any) -> dict[str, Any]:
    """Return a configuration as plain data, with the values that its interpolations name."""
    values: Any = OmegaConf.to_container(config, resolve=True)
    return values


def _part(kind: type) -> Part:
    return Part("stmc.text", kind, NAMES)


def _trusted(config: Any) -> Sequence[str]:
    return tuple(config.get("trusted") or ())


def check_plugins(node: Any, place: str = "hydra") -> None:
    """Raise `SettingError` if Hydra's own settings name anything but its launchers, sweepers and log handlers.

    Hydra builds these itself, before the first job.
    """
    pairs = node.items() if isinstance(node, dict) else enumerate(node) if isinstance(node, list) else ()
    for key, value in pairs:
        if (
            (key == TARGET and not _starts(value, _PLUGINS))
            or key == "()"
            or (key == "class" and not _starts(value, _LOGS))
        ):
            raise SettingError(f"{place}.{key}={quote(value)}: is not a part of Hydra")
        check_plugins(value, f"{place}.{key}")


def _starts(value: Any, beginnings: tuple[str, ...]) -> bool:
    return isinstance(value, str) and value.startswith(beginnings)


def check_trust(config: Mapping[str, Any], overrides: Sequence[str]) -> None:
    """Raise `SettingError` if a file names trusted packages but the command line does not.

    Otherwise a stranger's configuration could trust itself.
    """
    granted = any(each.lstrip("+").partition("=")[0] == "trusted" for each in overrides)
    if config.get("trusted") and not granted:
        raise SettingError(
            f"trusted={quote(list(config['trusted']))}: a file cannot grant trust; set trusted= on the command line"
        )
