"""The evaluator of Guo et al. as one record: networks, statistics and word vectors.

Handles raw features and tagged captions; independent of metrics (see `metrics.matching_metrics`) and of files (see
`published`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import torch
from jaxtyping import Float
from torch import Tensor

from stmc.diffusion.statistics import Statistics
from stmc.diffusion.tensors import pad
from stmc.evaluators.guo import GuoEvaluator
from stmc.motion.motion import Motion
from stmc.motion.representation import HumanML3DRepresentation, Representation
from stmc.text.glove import Glove

BATCH = 64


@dataclass(frozen=True, eq=False)
class MatchingEvaluator:
    """Embeds motions and tagged captions (`a/DET person/NOUN walk/VERB`) in one space, compared by Euclidean distance.

    Args:
        network: Networks of Guo et al.
        motion_statistics: The evaluator's own statistics, which differ from HumanML3D's.
        glove: Word vectors.
        fps: Frame rate of the features.
        representation: Representation of motions.
        longest: Number of frames to which all motions are padded with the mean: 196 as published, 200 in FlowMDM's
            evaluation.
    """

    network: GuoEvaluator
    motion_statistics: Statistics
    glove: Glove
    fps: float | int = 20
    representation: Representation = field(default_factory=HumanML3DRepresentation)
    longest: int = 196

    @property
    def device(self) -> torch.device:
        """The device of the networks."""
        return next(self.network.parameters()).device

    def features(self, motion: Motion) -> Float[Tensor, "_ features"]:
        """Compute the features of a motion of any frame rate and body, one row per frame.

        HumanML3D's features follow the published procedure: bone directions on its skeleton, the lowest joint on the
        floor, contacts from the steps of the feet. They describe steps between frames, so that the last frame repeats
        the row before it.
        """
        motion = motion.resampled(self.fps)
        rows = self.representation.encode(motion).float()
        return torch.cat([rows, rows[-1:].expand(len(motion) - len(rows), -1)])

    @torch.inference_mode()
    def motions(self, features: Sequence[Float[Tensor, "_ features"]]) -> Float[Tensor, "batch width"]:
        """Embed raw features of motions, on the CPU.

        Raises `ValueError` if there is no motion, or one with fewer than four frames.
        """
        if not features:
            raise ValueError("no motions to embed")
        self.network.eval()
        embeddings = []
        for start in range(0, len(features), BATCH):
            normal = [self.motion_statistics.normalise(row) for row in features[start : start + BATCH]]
            batch, lengths = pad([*normal, torch.zeros(self.longest, normal[0].shape[1])])
            embeddings.append(self.network.motions(batch[:-1].to(self.device), lengths[:-1]).float().cpu())
        return torch.cat(embeddings)

    @torch.inference_mode()
    def texts(self, texts: Sequence[str]) -> Float[Tensor, "batch width"]:
        """Embed tagged captions, on the CPU."""
        self.network.eval()
        embeddings = []
        for start in range(0, len(texts), BATCH):
            words, kinds, lengths = self.glove.encode(texts[start : start + BATCH])
            embeddings.append(self.network.texts(words.to(self.device), kinds.to(self.device), lengths).float().cpu())
        return torch.cat(embeddings)
