"""DoubleTake's second take: the surroundings of transitions made anew (Shafir et al. 2024).

Knows plans; knows no networks, texts or samplers.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from stmc.composing.stitching import Columns
from stmc.timeline.planning import Plan, transition_spans


def kept_shares(
    plans: Sequence[Plan], columns: Columns, ramp: int, share: float = 0.85
) -> Float[Tensor, "batch frames features"]:
    """How much of the first take DoubleTake's second one keeps, at each frame and body part (Shafir et al. 2024).

    Everything, but for the `ramp` frames before each of the part's transitions, where it falls along a line from
    `share` towards 0, and the `ramp` frames behind, where it rises from 0 towards `share`. The transition itself is
    kept, as in the published code: what is made anew is the way to it and from it.
    """
    features = sum(len(own) for own in columns.values())
    kept = torch.ones(len(plans), max(plan.frames for plan in plans), features)
    rising = share * torch.arange(ramp) / max(1, ramp)
    for i, plan in enumerate(plans):
        for part, own in columns.items():
            line = torch.ones(plan.frames + 2 * ramp)
            for start, end in transition_spans(plan, part):  # line[f + ramp] is frame f
                before, after = slice(start, start + ramp), slice(end + ramp, end + 2 * ramp)
                line[before] = line[before].minimum(share - rising)
                line[after] = line[after].minimum(rising)
            kept[i, : plan.frames, list(own)] = line[ramp : ramp + plan.frames, None]
    return kept
