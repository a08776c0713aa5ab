"""The distance between the distributions of generated and real motions in a space of latents.

Depends on latents and lengths; independent of networks. FID: Heusel et al. 2017; FID+: STMC, section 4.2, after
DiffCollage.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

CROPS, CROP_SECONDS = 5, 5.0
"""Number of crops per motion, and their duration in seconds, for FID+."""


def frechet_distance(first: Float[Tensor, "_ width"], second: Float[Tensor, "_ width"]) -> float:
    """Compute the squared Fréchet distance of two normal distributions fitted to two sets of latents.

    With means m and covariances C (n - 1) it is |m1 - m2|² + tr(C1 + C2 - 2 (C1 C2)^(1/2)), in squared units of the
    latents; at least 0. The trace of the root is the sum of the singular values of a product of roots of C1 and C2,
    which needs no root of an asymmetric matrix: nothing becomes complex, and fewer latents than dimensions are allowed.
    The distance is biased upwards for few latents; compare sets of equal size.

    Raises:
        ValueError: If a set has fewer than two latents, or latents are not finite.
    """
    roots, means = [], []
    for latents in (first, second):
        finite = int(latents.isfinite().all(dim=1).sum())
        if finite < max(2, len(latents)):
            raise ValueError(f"a covariance needs at least 2 finite latents; {finite} of {len(latents)} are finite")
        values = latents.double()
        means.append(values.mean(dim=0))
        roots.append((values - means[-1]) / (len(values) - 1) ** 0.5)
    traces = sum(float(root.square().sum()) for root in roots)
    # With C = R'R, the eigenvalues of C1 C2 are the squared singular values of R1 R2', also for triangular R.
    triangular = [torch.linalg.qr(root, mode="r").R for root in roots]
    cross = float(torch.linalg.svdvals(triangular[0] @ triangular[1].T).sum())
    return max(0.0, float((means[0] - means[1]).square().sum()) + traces - 2 * cross)


def fid(generated: Float[Tensor, "_ width"], real: Float[Tensor, "_ width"]) -> float:
    """Compute `frechet_distance` of latents scaled to length 1, as in STMC's tables; TMR compares them by angle."""
    return frechet_distance(F.normalize(generated.double(), dim=-1), F.normalize(real.double(), dim=-1))


def crop_starts(lengths: Sequence[int], crop: int, seed: int, count: int = CROPS) -> list[tuple[int, ...]]:
    """Draw the first frames of `count` crops of each motion, uniformly over all complete crops.

    A motion that is shorter than a crop is its own crop.

    Args:
        lengths: Length of each motion in frames.
        crop: Length of a crop in frames.
        seed: Seed of the draw.
        count: Number of crops per motion.
    """
    rng = np.random.default_rng(seed)
    return [tuple(rng.integers(max(0, length - crop) + 1, size=count).tolist()) for length in lengths]


def published_crop_starts(features: int = 263, crop: int = 100, count: int = CROPS) -> tuple[int, ...]:
    """Return the first frames of the crops of the published code, for comparison with published tables only.

    They are drawn as if motions had as many frames as features, so that later crops extend beyond the end and are
    shorter.

    Args:
        features: Number of features.
        crop: Length of a crop in frames.
        count: Number of crops per motion.
    """
    return tuple(np.random.RandomState(0).randint(0, features - crop, size=count).tolist())
