"""The training objective of TMR (Petrovich et al. 2023, section 3).

TMR reconstructs motions, embeds a motion and its text at the same point, and separates pairs of different meaning. This
module knows pairs of motions and texts and TMR's networks; it knows no data set, no optimiser and no text's meaning.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import reduce

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor

from stmc.evaluators.tmr import Posterior, Tmr
from stmc.training.contrastive_batches import Pairs

TERMS = ("reconstruction", "kl", "latent", "contrastive")


@dataclass(frozen=True)
class TmrObjective:
    """Weighted sum of the four terms of TMR, with the published weights by default.

    Args:
        reconstruction: Weight of the reconstruction of the motion from its own latent and from that of its text.
        kl: Weight of the divergence of the two posteriors from each other, both ways, and from the standard normal.
        latent: Weight of the distance of the two latents.
        contrastive: Weight of `info_nce`.
        temperature: Temperature of `info_nce`.
        rebuild_every: Reconstruct only every n-th row; reconstruction is most of the work.
    """

    reconstruction: float | int = 1.0
    kl: float | int = 1e-5
    latent: float | int = 1e-5
    contrastive: float | int = 0.1
    temperature: float | int = 0.1
    rebuild_every: int = 1

    def __post_init__(self) -> None:
        if self.rebuild_every < 1:
            raise ValueError(f"rebuild_every must be at least 1, not {self.rebuild_every}")

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the logged losses: the weighted sum, then each term unweighted."""
        return ("loss", *(f"loss_{name}" for name in TERMS))

    def __call__(self, network: Tmr, pairs: Pairs, generator: torch.Generator) -> Float[Tensor, " terms"]:
        """Compute the mean of each term, times the number of frames."""
        output = network(pairs.text, pairs.text_mask, pairs.motion, pairs.mask, generator, self.rebuild_every)
        rebuilt = [F.smooth_l1_loss(motion, pairs.motion[:: self.rebuild_every]) for motion in output.rebuilt]
        terms = [
            reduce(torch.add, rebuilt),
            kl_terms(output.text, output.motion).sum(),
            F.smooth_l1_loss(*output.points),
            info_nce(output.text.mean, output.motion.mean, pairs.alike, self.temperature),
        ]
        return torch.stack(terms) * pairs.frames

    def weigh(self, terms: Float[Tensor, " terms"]) -> Float[Tensor, ""]:
        """Return the weighted sum of the terms, the number to minimise."""
        return terms @ terms.new_tensor([getattr(self, name) for name in TERMS])

    def losses(self, means: Float[Tensor, " terms"]) -> Mapping[str, float]:
        """Return the logged losses, from the means of the terms."""
        return dict(zip(self.names, [float(self.weigh(means)), *means.tolist()], strict=True))


def kl_terms(text: Posterior, motion: Posterior) -> Float[Tensor, " 4"]:
    """Compute four divergences: text from motion, motion from text, and each from the standard normal.

    Without variational encoders they are zero.
    """
    if text.log_variance is None or motion.log_variance is None:
        return text.mean.new_zeros(4)
    normal = Posterior(torch.zeros_like(text.mean), torch.zeros_like(text.mean))
    pairs = [(text, motion), (motion, text), (motion, normal), (text, normal)]
    return torch.stack([divergence(*pair) for pair in pairs])


def divergence(posterior: Posterior, prior: Posterior) -> Float[Tensor, ""]:
    """Compute the Kullback-Leibler divergence of diagonal normal distributions, in nats, averaged over all dimensions.

    Raises `ValueError` for a distribution without a variance.
    """
    if posterior.log_variance is None or prior.log_variance is None:
        raise ValueError("divergence needs posteriors with variances")
    excess = posterior.log_variance - prior.log_variance
    distance = (prior.mean - posterior.mean).square() / prior.log_variance.exp()
    return (0.5 * (excess.exp() + distance - 1 - excess)).mean()


def info_nce(
    texts: Float[Tensor, "batch width"],
    motions: Float[Tensor, "batch width"],
    alike: Bool[Tensor, "batch batch"] | None = None,
    temperature: float | int = 0.1,
) -> Float[Tensor, ""]:
    """Compute InfoNCE over cosines (TMR, Eq. 2 and 3).

    The loss is the mean of two cross entropies: finding each text's motion and each motion's text within the batch.

    Args:
        texts: Latents of texts.
        motions: Latents of their motions.
        alike: Pairs [text, motion] that are left out as neither positive nor negative; a row's own pair is always
            positive. None: no pairs.
        temperature: Temperature of the softmax.
    """
    cosines = F.normalize(texts, dim=-1) @ F.normalize(motions, dim=-1).T
    logits = cosines / temperature
    own = torch.arange(len(texts), device=texts.device)
    if alike is not None:
        others = ~torch.eye(len(texts), dtype=torch.bool, device=texts.device)
        logits = logits.masked_fill(alike & others, -torch.inf)
    return (F.cross_entropy(logits, own) + F.cross_entropy(logits.T, own)) / 2
