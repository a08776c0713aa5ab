"""Training a denoiser (STMC, section 3.4 and Eq. 5): the loss, the loop, and files that survive a kill."""

from stmc.training.checkpoint import Checkpoints
from stmc.training.ema import Ema
from stmc.training.loop import Batches, Hook, Settings, Trainer
from stmc.training.loss import Batch, draw_noise, squared_errors

__all__ = [
    "Batch",
    "Batches",
    "Checkpoints",
    "Ema",
    "Hook",
    "Settings",
    "Trainer",
    "draw_noise",
    "squared_errors",
]
