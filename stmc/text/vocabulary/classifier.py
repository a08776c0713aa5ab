"""A linear classifier of sentences: the action of a vocabulary that a text asks for in plain words, if any.

Depends on embeddings alone; independent of sentences, encoders and files.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int
from torch import Tensor

DECAY = 1e-6
"""Factor of the squared weights in the loss, chosen by the cross-entropy of a tenth of the sentences, left out."""

ITERATIONS = 100
"""Greatest number of iterations of L-BFGS; the loss is convex."""

OTHERS = 4.0
"""Factor of the weight of sentences about no action: a thousand everyday actions stand for all that there are."""

LARGEST = 10.0
"""Limit of log-odds; of actions that all contradict a text they would be infinite."""


@dataclass(frozen=True, eq=False)
class Classifier:
    """Logits from centred sentence embeddings of length 1: of each action, of other words for them, and of none.

    Other words are those in which no action is said plainly: with a style ("walk sadly"), about two actions ("walk
    while waving"), or without the side ("wave"). `weights` has one row per class; its last column is the bias.
    """

    weights: Float[Tensor, "classes width_and_bias"]

    def logits(self, embeddings: Float[Tensor, "texts width"]) -> Float[Tensor, "texts classes"]:
        """Compute the logits of texts."""
        weights = self.weights.float()
        return embeddings @ weights[:, :-1].T + weights[:, -1]


def log_odds(logits: Float[Tensor, " classes"], actions: Bool[Tensor, " actions"]) -> float:
    """Return the logarithm of the odds that a text asks for one of the selected `actions`, in any words.

    It is at least -`LARGEST` and at most `LARGEST`.
    """
    inside = torch.cat([actions, actions.any()[None], actions.new_zeros(1)])
    odds = logits.masked_fill(~inside, -torch.inf).logsumexp(dim=0) - logits[~inside].logsumexp(dim=0)
    return float(odds.clamp(-LARGEST, LARGEST))


def fit_classifier(
    embeddings: Float[Tensor, "sentences width"], classes: Int[Tensor, " sentences"], count: int
) -> Classifier:
    """Fit the classifier by maximum likelihood. A class has the weight of the root of its number of sentences.

    Args:
        embeddings: Centred embeddings of length 1.
        classes: Index of the action of each sentence; `count` for other words, `count` + 1 for no action.
        count: Number of actions.
    """
    inputs = torch.cat([embeddings, torch.ones(len(embeddings), 1)], dim=1)
    sizes = torch.bincount(classes, minlength=count + 2).clamp(min=1)
    share = sizes.rsqrt()
    share[-1] *= OTHERS
    share = share * len(classes) / (share * sizes).sum()
    weights = torch.zeros(count + 2, inputs.shape[1], requires_grad=True)
    optimizer = torch.optim.LBFGS([weights], max_iter=ITERATIONS, history_size=20, line_search_fn="strong_wolfe")

    def loss() -> Tensor:
        optimizer.zero_grad()
        value = F.cross_entropy(inputs @ weights.T, classes, weight=share) + DECAY * weights[:, :-1].square().sum()
        value.backward()
        return value

    with torch.enable_grad():
        optimizer.step(loss)
    return Classifier(weights.detach().half())
