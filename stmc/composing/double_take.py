"""DoubleTake's second take: the surroundings of transitions are generated again (Shafir et al. 2024)."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from stmc.composing.stitching import Columns
from stmc.timeline.planning import Plan, transition_spans


def first_take_weights(
    plans: Sequence[Plan], columns: Columns, ramp: int, share: float = 0.85
) -> Float[Tensor, "batch frames features"]:
    """Compute the weight of the first take in DoubleTake's second take, at each frame and body part.

    The weight is 1, except in the `ramp` frames before each transition of the part, where it falls linearly from
    `share` towards 0, and in the `ramp` frames after it, where it rises from 0 towards `share`. The transition itself
    keeps its weight, as in the published code: only its surroundings are generated again (Shafir et al. 2024).

    Args:
        plans: Plan of each timeline.
        columns: Columns of each body part.
        ramp: Number of frames of a ramp.
        share: Weight at the outer end of a ramp.
    """
    features = sum(len(indices) for indices in columns.values())
    weights = torch.ones(len(plans), max(plan.frames for plan in plans), features)
    rising = share * torch.arange(ramp) / max(1, ramp)
    for i, plan in enumerate(plans):
        for part, indices in columns.items():
            line = torch.ones(plan.frames + 2 * ramp)
            for start, end in transition_spans(plan, part):  # line[f + ramp] is frame f
                before, after = slice(start, start + ramp), slice(end + ramp, end + 2 * ramp)
                line[before] = line[before].minimum(share - rising)
                line[after] = line[after].minimum(rising)
            weights[i, : plan.frames, list(indices)] = line[ramp : ramp + plan.frames, None]
    return weights
