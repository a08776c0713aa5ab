"""The evaluator of Guo et al. as one record: their networks, statistics and word vectors, and the way through them.

Knows raw features and tagged captions; knows no metric (see `metrics.matching`) and no files (see `published`).
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
    """Places motions and tagged captions (`a/DET person/NOUN walk/VERB`) in one space, compared by Euclidean distance.

    `motion_statistics` are the evaluator's own, which are not HumanML3D's; features are `representation`'s, at `fps`.
    All motions are padded, with the mean, to `longest` frames: 196 as published, in FlowMDM's evaluation 200.
    """

    network: GuoEvaluator
    motion_statistics: Statistics
    glove: Glove
    fps: float | int = 20
    representation: Representation = field(default_factory=HumanML3DRepresentation)
    longest: int = 196

    @property
    def device(self) -> torch.device:
        """Where the networks are."""
        return next(self.network.parameters()).device

    def features(self, motion: Motion) -> Float[Tensor, "_ features"]:
        """The features of a motion of any frame rate and body, a row for each frame. HumanML3D's by the published road:
        the directions of its bones on their skeleton, its lowest joint on the floor, contacts by the steps of the feet;
        they are of steps between frames, so the last frame's are those of the one before."""
        motion = motion.resampled(self.fps)
        rows = self.representation.encode(motion).float()
        return torch.cat([rows, rows[-1:].expand(len(motion) - len(rows), -1)])

    @torch.inference_mode()
    def motions(self, features: Sequence[Float[Tensor, "_ features"]]) -> Float[Tensor, "batch width"]:
        """The embeddings of raw features of these motions, on the CPU. Raises `ValueError` for one of less than four
        frames, and for none at all."""
        if not features:
            raise ValueError("no motions to embed")
        self.network.eval()
        found = []
        for start in range(0, len(features), BATCH):
            normal = [self.motion_statistics.normalise(row) for row in features[start : start + BATCH]]
            batch, lengths = pad([*normal, torch.zeros(self.longest, normal[0].shape[1])])
            found.append(self.network.motions(batch[:-1].to(self.device), lengths[:-1]).float().cpu())
        return torch.cat(found)

    @torch.inference_mode()
    def texts(self, texts: Sequence[str]) -> Float[Tensor, "batch width"]:
        """The embeddings of tagged captions, on the CPU."""
        self.network.eval()
        found = []
        for start in range(0, len(texts), BATCH):
            words, kinds, lengths = self.glove.encode(texts[start : start + BATCH])
            found.append(self.network.texts(words.to(self.device), kinds.to(self.device), lengths).float().cpu())
        return torch.cat(found)
