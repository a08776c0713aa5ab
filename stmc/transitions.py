"""What happens to transitions beyond mixing crops: DoubleTake's second take, and TEACH's interpolation.

Knows plans and predictors; knows no networks, texts or samplers.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from einops import rearrange
from jaxtyping import Float
from roma import rotmat_slerp
from torch import Tensor

from stmc.body import BodyPart
from stmc.compose import Columns, lerp, seams
from stmc.diffusion import Predict
from stmc.geometry import matrix_to_rows, rows_to_matrix
from stmc.planning import Plan
from stmc.representation import Layout
from stmc.rules import transition_spans


def inpaint(
    predict: Predict, content: Float[Tensor, "batch frames features"], kept: Float[Tensor, "batch frames features"]
) -> Predict:
    """The predictor whose every answer is drawn towards `content`: by nothing where `kept` is 0, entirely where 1.

    To begin with less than full noise, sample with `schedule.respaced(tuple(range(steps)))` from `content` as noisy as
    at its last step: the samplers need not know.
    """
    return lambda x, t: torch.lerp(predict(x, t), content, kept)


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


def slerp(
    raw: Float[Tensor, "batch frames features"], plans: Sequence[Plan], layout: Layout, overlap: int
) -> Float[Tensor, "batch frames features"]:
    """`lerp` for features that are not normalised, with rotations on the shortest arc of the sphere: what TEACH does to
    its transitions (Athanasiou et al. 2022).

    The layout's field "rotations" holds two rows, or two columns, of a matrix for each joint. The `plans` are those
    without overlap; `overlap` frames around each change are replaced.
    """
    smooth = lerp(raw, plans, layout.columns, overlap)
    for i, plan in enumerate(plans):
        for part in BodyPart:
            turned = _rotations(layout, part)
            for window in seams(plan, part, overlap) if turned else ():
                old = rearrange(raw[i, window][[0, -1]][:, turned], "ends (joints six) -> ends joints six", six=6)
                first, last = rows_to_matrix(old)
                steps = torch.linspace(0, 1, window.stop - window.start).to(raw)
                arc = matrix_to_rows(rotmat_slerp(first, last, steps))
                smooth[i, window, turned] = rearrange(arc, "frames joints six -> frames (joints six)")
    return smooth


def _rotations(layout: Layout, part: BodyPart) -> list[int]:
    """The columns of a part's rotations."""
    where = layout["rotations"]
    return [column for column in layout.columns[part] if where.start <= column < where.stop]
