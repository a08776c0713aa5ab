"""Run directories: a model or an evaluator as files, and back. No code of a file is executed; see `directories`."""

from stmc.run.configs import RunError
from stmc.run.construction import Part, construct, signature_of
from stmc.run.directories import (
    BUNDLED,
    BUNDLED_EVALUATOR,
    BUNDLED_MODELS,
    CARD,
    CONFIG,
    STATISTICS,
    bundled,
    calibrate,
    check,
    fingerprint,
    load,
    load_evaluator,
    save,
    save_evaluator,
)
from stmc.run.model_vocabulary import CALIBRATION, VOCABULARY, WEIGHTS
from stmc.run.parts import EVALUATOR_PARTS, PARTS, build, build_fitting
from stmc.run.suggestions import suggest_parts, with_suggested_parts

__all__ = [
    "BUNDLED",
    "BUNDLED_EVALUATOR",
    "BUNDLED_MODELS",
    "CALIBRATION",
    "CARD",
    "CONFIG",
    "EVALUATOR_PARTS",
    "PARTS",
    "STATISTICS",
    "VOCABULARY",
    "WEIGHTS",
    "Part",
    "RunError",
    "build",
    "build_fitting",
    "bundled",
    "calibrate",
    "check",
    "construct",
    "fingerprint",
    "load",
    "load_evaluator",
    "save",
    "save_evaluator",
    "signature_of",
    "suggest_parts",
    "with_suggested_parts",
]
