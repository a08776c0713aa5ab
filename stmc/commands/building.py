"""What a command builds of its configuration: the same constructor as for run directories, with a table of its own.

A configuration may be anybody's: a file in `--config-dir`, or an override. It builds classes and functions of the table
below and of packages that the command line trusts, and nothing else.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from inspect import Signature
from typing import Any

from omegaconf import OmegaConf

from stmc.run import Part, construct, signature_of
from stmc.run.configs import TARGET
from stmc.settings import SettingError, shown

_PLUGINS, _LOGS = ("hydra._internal.", "hydra_plugins."), ("logging.", "colorlog.")
_SOURCES = "stmc.data.sources"
NAMES = (
    "stmc.training.Settings",
    "stmc.training.Denoising",
    "stmc.evaluators.TmrObjective",
    "stmc.data.dataset.Dataset",
    "stmc.data.batches.Sampling",
    "stmc.data.prolonging.Prolonging",
    "stmc.data.feet.FootVelocity",
    "stmc.data.cache.read_caches",
    f"{_SOURCES}.annotated_amass.AnnotatedAmass",
    f"{_SOURCES}.babel_rows.read_babel_labels",
    f"{_SOURCES}.babel_rows.RowConversion",
    f"{_SOURCES}.bandai_clips.BandaiClips",
    f"{_SOURCES}.caption_tags.Tags.read",
    f"{_SOURCES}.cmu_clips.CmuClips",
    f"{_SOURCES}.cmu_recordings.CmuRecordings",
    f"{_SOURCES}.composition_lists.read_compositions",
    f"{_SOURCES}.composition_references.babel_references",
    f"{_SOURCES}.composition_references.humanml3d_references",
    f"{_SOURCES}.edited_clips.EditedClips",
    f"{_SOURCES}.humanml3d.ProcessedHumanML3D",
    f"{_SOURCES}.humanml3d_clips.read_captioned_clips",
    f"{_SOURCES}.teach_recordings.TeachRecordings",
    "stmc.benchmarks.Compositions",
    "stmc.benchmarks.PublishedCompositions",
    "stmc.benchmarks.SingleText",
    "stmc.benchmarks.mtt_open",
    "stmc.benchmarks.open_mtt",
    "stmc.benchmarks.published_mtt",
    "stmc.published.read_guo_evaluator",
    "stmc.results.comparison_table",
    "stmc.results.repetition_table",
    "stmc.results.single_text_table",
    "stmc.results.sweep_table",
    "stmc.results.with_published",
    "stmc.results.charts.bars",
    "stmc.results.charts.quality_against_cost",
    "stmc.results.charts.sweep",
    "stmc.results.composition_charts.jerk_curves",
    "stmc.results.composition_charts.trade_off",
    *(
        f"stmc.{home}Representation"
        for home in ("representation.Smpl", "representation.Babel", "representation.HumanML3D")
    ),
)
"""The classes and functions that configurations build beside the text encoders, by their names in `_target_`."""


def build_part(config: Any, place: str, kind: type = object, **given: Any) -> Any:
    """Build the part of a configuration that stands at `place`, such as `data.sampling`, with the arguments `given`.

    Raises `RunError` for a name that is neither in the table nor of a trusted package, and for arguments that do not
    fit.
    """
    return construct(described(config, place) | given, place, _part(kind), _trusted(config))


def signature_of_part(config: Any, place: str) -> Signature:
    """The arguments of what stands at `place`. Raises as `build_part`."""
    return signature_of(described(config, place), place, _part(object), _trusted(config))


def described(config: Any, place: str) -> dict[str, Any]:
    """The description at `place` as plain data. Raises `SettingError` where there is none."""
    node = OmegaConf.select(config, place)
    if not OmegaConf.is_dict(node):
        raise SettingError(f"{place}={shown(node)}: a table with `_target_` needed")
    return OmegaConf.to_container(node, resolve=True)


def _part(kind: type) -> Part:
    return Part("stmc.text", kind, NAMES)


def _trusted(config: Any) -> Sequence[str]:
    return tuple(config.get("trusted") or ())


def check_plugins(node: Any, place: str = "hydra") -> None:
    """Raise `SettingError` where Hydra's own settings name anything but its launchers, sweepers and log handlers: it
    builds these itself, before the first job."""
    pairs = node.items() if isinstance(node, dict) else enumerate(node) if isinstance(node, list) else ()
    for key, value in pairs:
        if (
            (key == TARGET and not _starts(value, _PLUGINS))
            or key == "()"
            or (key == "class" and not _starts(value, _LOGS))
        ):
            raise SettingError(f"{place}.{key}={shown(value)}: this is not a part of Hydra's")
        check_plugins(value, f"{place}.{key}")


def _starts(value: Any, beginnings: tuple[str, ...]) -> bool:
    return isinstance(value, str) and value.startswith(beginnings)


def check_trust(config: Mapping[str, Any], overrides: Sequence[str]) -> None:
    """Raise `SettingError` where a file names trusted packages and the command line does not: a stranger's
    configuration would trust itself."""
    said = any(each.lstrip("+").partition("=")[0] == "trusted" for each in overrides)
    if config.get("trusted") and not said:
        raise SettingError(
            f"trusted={shown(list(config['trusted']))}: a file may not say so; say it on the command line"
        )
