"""Settings of a model and of an evaluator in a config, and their legal values."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

from stmc.diffusion import Prediction
from stmc.run.configs import RunError
from stmc.settings.records import SettingError, check, defaults, record_of, setting

Record = TypeVar("Record")


@dataclass(frozen=True, kw_only=True)
class EvaluatorSettings:
    """Settings of an evaluator."""

    fps: float | int = setting(dataclasses.MISSING, "frame rate of the features", unit="Hz", above=0, at_most=1000)

    def __post_init__(self) -> None:
        check(self)


@dataclass(frozen=True, kw_only=True)
class ModelSettings(EvaluatorSettings):
    """Settings of a model. The defaults of its sampling are stored next to them: see `Sampling`."""

    longest: int = setting(dataclasses.MISSING, "longest crop", unit="frames", at_least=1, at_most=10_000)
    prediction: Prediction = setting(dataclasses.MISSING, "what the denoiser predicts")


def settings_of(kind: type[Record], config: Mapping[str, Any], place: str | Path) -> Record:
    """Read the settings in a config; missing ones take their defaults.

    Args:
        kind: Class of the settings.
        config: The config.
        place: File of the config, for messages.

    Raises:
        RunError: If a setting without a default is missing, or a value is invalid.
    """
    names = defaults(kind)
    absent = [name for name, default in names.items() if default is dataclasses.MISSING and name not in config]
    if absent:
        raise RunError(f"{place}: {', '.join(absent)} missing")
    try:
        return record_of(kind, {name: config[name] for name in names if name in config})
    except SettingError as error:
        raise RunError(f"{place}: {error}") from error
