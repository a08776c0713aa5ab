"""How far the distribution of generated motions is from that of real ones, in some space of latents.

Knows latents and lengths; knows no network. FID: Heusel et al. 2017; FID+: STMC, section 4.2, after DiffCollage.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

CROPS, CROP_SECONDS = 5, 5.0
"""FID+ looks at so many crops of each motion, of so many seconds."""


def frechet_distance(first: Float[Tensor, "_ width"], second: Float[Tensor, "_ width"]) -> float:
    """The squared Fréchet distance of two normal distributions with the means and covariances (n - 1) of two sets of
    latents: |m1 - m2|² + tr(C1 + C2 - 2 (C1 C2)^(1/2)), in squared units of the latents; at least 0.

    The trace of the root is the sum of the singular values of a product of roots of C1 and C2: no root of a matrix that
    is not symmetric, so nothing complex and no failure for less latents than dimensions. Biased upwards for few
    latents: compare sets of one size. Raises `ValueError` for a set of less than two, and for latents that are not
    finite.
    """
    roots, means = [], []
    for latents in (first, second):
        if len(latents) < 2 or not latents.isfinite().all():
            raise ValueError(f"a covariance needs at least 2 finite latents; of {len(latents)}, {_finite(latents)} are")
        values = latents.double()
        means.append(values.mean(dim=0))
        roots.append((values - means[-1]) / (len(values) - 1) ** 0.5)
    traces = sum(float(root.square().sum()) for root in roots)
    # With C = R'R, the eigenvalues of C1 C2 are the squared singular values of R1 R2', also for triangular R.
    triangular = [torch.linalg.qr(root, mode="r").R for root in roots]
    mixed = float(torch.linalg.svdvals(triangular[0] @ triangular[1].T).sum())
    return max(0.0, float((means[0] - means[1]).square().sum()) + traces - 2 * mixed)


def fid(generated: Float[Tensor, "_ width"], real: Float[Tensor, "_ width"]) -> float:
    """`frechet_distance` of latents scaled to length 1, as TMR compares them by angle and STMC's tables have it."""
    return frechet_distance(F.normalize(generated.double(), dim=-1), F.normalize(real.double(), dim=-1))


def crop_starts(lengths: Sequence[int], crop: int, seed: int, count: int = CROPS) -> list[tuple[int, ...]]:
    """Where the `count` crops of `crop` frames begin in each motion, uniform over all places that hold a whole crop; a
    motion that is shorter is its own crop."""
    rng = np.random.default_rng(seed)
    return [tuple(rng.integers(max(0, length - crop) + 1, size=count).tolist()) for length in lengths]


def published_crop_starts(features: int = 263, crop: int = 100, count: int = CROPS) -> tuple[int, ...]:
    """Where the crops begin in every motion by the published code: drawn as if motions had as many frames as features,
    so that later crops run over the end and are shorter. For comparison with published tables alone."""
    return tuple(np.random.RandomState(0).randint(0, features - crop, size=count).tolist())


def _finite(latents: Tensor) -> int:
    return int(latents.isfinite().all(dim=1).sum())
