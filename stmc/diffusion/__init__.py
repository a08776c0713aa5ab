"""Diffusion on tensors: schedules, samplers, guidance and noise. Independent of motion and timelines."""

from stmc.diffusion.guidance import guide
from stmc.diffusion.noise import FrameNoise, Noise, Seed
from stmc.diffusion.samplers import SAMPLERS, Draw, NoiseScale, Predict, Sampler, ddim, ddpm, dpm_solver
from stmc.diffusion.schedule import Prediction, Schedule, Spacing

__all__ = [
    "SAMPLERS",
    "Draw",
    "FrameNoise",
    "Noise",
    "NoiseScale",
    "Predict",
    "Prediction",
    "Sampler",
    "Schedule",
    "Seed",
    "Spacing",
    "ddim",
    "ddpm",
    "dpm_solver",
    "guide",
]
