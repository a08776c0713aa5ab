"""Two files beside the weights of a run directory: the vocabulary of its model, and the calibration of that model."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from stmc.io.files import sha256
from stmc.run.configs import RunError
from stmc.text.vocabulary import (
    Calibration,
    Vocabulary,
    VocabularyError,
    read_calibration,
    read_vocabulary,
    write_calibration,
    write_vocabulary,
)

WEIGHTS = "weights.safetensors"
VOCABULARY, CALIBRATION = "vocabulary.safetensors", "calibration.json"
"""What a model was trained to hear, and how often its samples show that; runs may have none."""


def write_model_vocabulary(vocabulary: Vocabulary | None, folder: Path) -> None:
    """Write the vocabulary and the calibration of a model; remove files of an earlier model that it does not have."""
    if vocabulary is None:
        (folder / VOCABULARY).unlink(missing_ok=True)
    else:
        write_vocabulary(vocabulary, folder / VOCABULARY)
    if vocabulary is None or vocabulary.calibration.is_empty:
        (folder / CALIBRATION).unlink(missing_ok=True)
    else:
        write_model_calibration(vocabulary.calibration, folder)


def write_model_calibration(calibration: Calibration, folder: Path) -> Path:
    """Write the calibration of a model beside its weights, with the digest of these weights; return its path.

    Raises `RunError` if the folder has no weights.
    """
    if not (folder / WEIGHTS).is_file():
        raise RunError(f"{folder} is not a run directory: {WEIGHTS} missing")
    write_calibration(replace(calibration, weights=sha256(folder / WEIGHTS)), folder / CALIBRATION)
    return folder / CALIBRATION


def read_model_vocabulary(folder: Path, config: Mapping[str, Any]) -> Vocabulary | None:
    """Read the vocabulary of a model with its calibration; return None if the model has none.

    Ignore files of an earlier model in the folder: a vocabulary that the config's digest does not name, and a
    calibration of other weights. Raises `RunError` for a damaged file.
    """
    if not (folder / VOCABULARY).is_file() or "vocabulary" not in config.get("digest", ("vocabulary",)):
        return None
    try:
        vocabulary = read_vocabulary(folder / VOCABULARY)
        calibration = read_calibration(folder / CALIBRATION) if (folder / CALIBRATION).exists() else Calibration()
    except VocabularyError as error:
        raise RunError(str(error)) from error
    own = calibration.weights == sha256(folder / WEIGHTS)
    return replace(vocabulary, calibration=calibration) if own else vocabulary
