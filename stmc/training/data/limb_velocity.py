"""Auxiliary losses on the velocities of feet and hands, which a loss on features alone does not constrain.

This module knows the 205 features of `SmplRepresentation` and the statistics of a dataset; it knows no network.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from stmc.motion.representation.smpl import SmplRepresentation
from stmc.training.data.dataset import Dataset


class FootVelocity:
    """Function of normalised features: steps of the toes to the next frame, divided by their deviation in the dataset.

    Raises `ValueError` for a dataset with features other than those of `SmplRepresentation`.
    """

    name = "foot_velocity"

    def __init__(self, dataset: Dataset) -> None:
        self.representation, self.motion = SmplRepresentation(), dataset.motion
        if dataset.layout != self.representation.layout:
            raise ValueError(
                f"foot velocities need the {self.representation.width} features of SmplRepresentation, not "
                f"{dataset.layout.width} in another layout; train without data.auxiliary_loss"
            )
        self.skeleton = dataset.skeleton or self.representation.skeleton
        training = [clip for clip in dataset.clips if clip.split == "train"]
        steps = torch.cat([self._steps(dataset.features[clip.start : clip.end]) for clip in training])
        self.deviation = steps.square().mean(dim=0).sqrt()

    def __call__(self, motion: Float[Tensor, "batch frames features"]) -> Float[Tensor, "batch _ 6"]:
        """Return the scaled steps of one frame fewer than `motion`; differentiable."""
        return self._steps(self.motion.restore(motion)) / self.deviation

    def _steps(self, features: Tensor) -> Tensor:
        return self.representation.foot_velocities(features, self.skeleton)


class LimbVelocity:
    """Map normalised features to the steps of toes and wrists to the next frame, in units of their RMS in the dataset.

    Toes move in the world, as in `FootVelocity`; wrists relative to the pelvis. Positions alone hardly see hands that
    clap: a network may then predict the mean of the rhythm.

    Raises:
        ValueError: For features other than those of `SmplRepresentation`.
    """

    name = "limb_velocity"

    def __init__(self, dataset: Dataset) -> None:
        self.feet = FootVelocity(dataset)
        training = [clip for clip in dataset.clips if clip.split == "train"]
        steps = torch.cat([self._wrist_steps(dataset.features[clip.start : clip.end]) for clip in training])
        self.deviation = steps.square().mean(dim=0).sqrt()

    def __call__(self, motion: Float[Tensor, "batch frames features"]) -> Float[Tensor, "batch _ 12"]:
        """Compute the steps, one frame fewer than `motion`; differentiable."""
        wrists = self._wrist_steps(self.feet.motion.restore(motion)) / self.deviation
        return torch.cat([self.feet(motion), wrists], dim=-1)

    def _wrist_steps(self, features: Tensor) -> Tensor:
        return self.feet.representation.wrist_velocities(features, self.feet.skeleton)
