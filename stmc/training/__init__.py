"""Training: what a network learns from (STMC, section 3.4 and Eq. 5), the loop, and files that survive a kill."""

from stmc.training.checkpoint import Checkpoints
from stmc.training.ema import Ema
from stmc.training.loop import Batches, Hook, Settings, Trainer
from stmc.training.loss import Batch, Denoising, Objective, draw_noise, squared_errors
from stmc.training.pairs import Pairs

__all__ = [
    "Batch",
    "Batches",
    "Checkpoints",
    "Denoising",
    "Ema",
    "Hook",
    "Objective",
    "Pairs",
    "Settings",
    "Trainer",
    "draw_noise",
    "squared_errors",
]
