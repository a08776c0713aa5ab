"""Training: what a network learns from (STMC, section 3.4 and Eq. 5), the loop, and files that survive a kill."""

from stmc.training.checkpoint import CheckpointError, Checkpoints
from stmc.training.device import find_accelerator
from stmc.training.ema import Ema
from stmc.training.loop import Batches, Callback, Settings, Trainer
from stmc.training.loss import Batch, Denoising, Objective, draw_noise, squared_errors
from stmc.training.pairs import Pairs
from stmc.training.resuming import SettingsChanged

__all__ = [
    "Batch",
    "Batches",
    "Callback",
    "CheckpointError",
    "Checkpoints",
    "Denoising",
    "Ema",
    "Objective",
    "Pairs",
    "Settings",
    "SettingsChanged",
    "Trainer",
    "draw_noise",
    "find_accelerator",
    "squared_errors",
]
