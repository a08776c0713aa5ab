"""What a loss over features alone does not see: whether the feet stand still while the body moves on.

Knows the 205 features of `SmplRepresentation` and the statistics of a corpus; knows no network.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from stmc.data.dataset import Corpus
from stmc.representation.smpl import SmplRepresentation


class FootSteps:
    """Normalised features → how far the toes move to the next frame, in units of its deviation in the corpus.

    Raises `ValueError` for a corpus of other features than `SmplRepresentation`'s.
    """

    name = "feet"

    def __init__(self, corpus: Corpus) -> None:
        self.representation, self.motion = SmplRepresentation(), corpus.motion
        if corpus.layout != self.representation.layout:
            raise ValueError(
                f"foot steps are known of SmplRepresentation's {self.representation.width} features alone, not of "
                f"{corpus.layout.width} in another layout: train without data.derive"
            )
        self.skeleton = corpus.skeleton or self.representation.skeleton
        training = [clip for clip in corpus.clips if clip.split == "train"]
        steps = torch.cat([self._steps(corpus.features[clip.start : clip.end]) for clip in training])
        self.deviation = steps.square().mean(dim=0).sqrt()

    def __call__(self, motion: Float[Tensor, "batch frames features"]) -> Float[Tensor, "batch _ 6"]:
        """One frame fewer than `motion`; differentiable."""
        return self._steps(self.motion.restore(motion)) / self.deviation

    def _steps(self, features: Tensor) -> Tensor:
        return self.representation.foot_steps(features, self.skeleton)
