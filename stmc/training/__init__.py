"""Training: objectives (STMC, section 3.4 and Eq. 5), the loop, and checkpoints that survive a kill.

The loop is imported on first use, since it needs accelerate, an optional dependency.
"""

from importlib import import_module
from typing import Any

from stmc.training.checkpoint import CheckpointError, Checkpoints
from stmc.training.contrastive_batches import Pairs
from stmc.training.distilling import GuidedTeacher, MultistepTeacher, RememberingTeacher
from stmc.training.ema import Ema
from stmc.training.loss import Batch, Denoising, Objective, draw_noise, energy_weights, squared_errors
from stmc.training.resuming import SettingsChanged
from stmc.training.tmr_objective import TmrObjective

_LATER = {name: "loop" for name in ("Batches", "Callback", "Settings", "Trainer")}
_LATER |= {name: "device" for name in ("begin", "find_accelerator")}

__all__ = [
    "TmrObjective",
    "Batch",
    "CheckpointError",
    "Checkpoints",
    "Denoising",
    "Ema",
    "GuidedTeacher",
    "MultistepTeacher",
    "Objective",
    "Pairs",
    "RememberingTeacher",
    "SettingsChanged",
    "draw_noise",
    "energy_weights",
    "squared_errors",
    *_LATER,
]


def __getattr__(name: str) -> Any:
    if name not in _LATER:
        raise AttributeError(f"module 'stmc.training' has no attribute {name!r}")
    return getattr(import_module(f"stmc.training.{_LATER[name]}"), name)
