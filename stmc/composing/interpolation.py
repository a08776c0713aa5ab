"""Seams smoothed after sampling: SINC's straight lines, and TEACH's interpolation on the sphere.

Knows plans without overlap and layouts of features; knows no networks, texts or samplers.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import torch
from einops import rearrange
from jaxtyping import Float
from torch import Tensor

from stmc.composing.stitching import Columns
from stmc.motion.body import BodyPart
from stmc.motion.geometry import matrix_to_rows, rows_to_matrix
from stmc.motion.representation import Layout
from stmc.timeline.planning import Plan


def smooth_seams(
    features: Float[Tensor, "batch frames features"], plans: Sequence[Plan], columns: Columns, overlap: int
) -> Float[Tensor, "batch frames features"]:
    """SINC's result with its seams smoothed: a straight line wherever a body part changes from one crop to another.

    The line runs over `overlap` frames around the change, half of them on each side, within the timeline, from the
    value of its first frame to that of its last. Lines start from the values before smoothing; where two of one part
    meet, the later wins. The `plans` are those without overlap (`ValueError` for others).

    Examples:
        >>> plan = stmc.plan(stmc.Timeline.parse("walk # 0 # 1\\njump # 1 # 2"), fps=20, overlap=0)
        >>> columns = {part: [column] for column, part in enumerate(stmc.BodyPart)}
        >>> features = torch.cat([torch.zeros(1, 20, 5), torch.ones(1, 20, 5)], dim=1)
        >>> stmc.smooth_seams(features, [plan], columns, overlap=5)[0, 18:23, 0].tolist()
        [0.0, 0.25, 0.5, 0.75, 1.0]
    """
    smooth = features.clone()
    for i, plan in enumerate(plans):
        for part, owned in columns.items():
            for window in seams(plan, part, overlap):
                old = features[i, window][:, owned]
                fade = torch.linspace(1, 0, len(old)).to(features)[:, None]
                smooth[i, window, owned] = fade * old[0] + (1 - fade) * old[-1]
    return smooth


def seams(plan: Plan, part: BodyPart, overlap: int) -> list[slice]:
    """The `overlap` frames around each change of `part` from one crop to another, half of them on each side, within the
    timeline; none for 0. Raises `ValueError` for a plan with overlap."""
    tiles = sorted((tile for tile in plan.tiles if tile.part == part), key=lambda tile: tile.start)
    if any(a.end > b.start for a, b in pairwise(tiles)):
        raise ValueError(f"the tiles of {part} overlap: seams are smoothed in plans made with overlap=0")
    changes = [b.start for a, b in pairwise(tiles) if a.crop != b.crop] if overlap > 0 else []
    left, right = overlap // 2, overlap - overlap // 2
    return [slice(max(0, change - left), min(plan.frames, change + right)) for change in changes]


def slerp(
    raw: Float[Tensor, "batch frames features"], plans: Sequence[Plan], layout: Layout, overlap: int
) -> Float[Tensor, "batch frames features"]:
    """`smooth_seams` for features that are not normalised, with rotations on the shortest arc of the sphere: what TEACH
    does to its transitions (Athanasiou et al. 2022).

    The layout's field "rotations" holds two rows, or two columns, of a matrix for each joint. The `plans` are those
    without overlap; `overlap` frames around each change are replaced.
    """
    import roma  # not above: it takes as long to import as torch

    smooth = smooth_seams(raw, plans, layout.columns, overlap)
    for i, plan in enumerate(plans):
        for part in BodyPart:
            turned = _rotations(layout, part)
            for window in seams(plan, part, overlap) if turned else ():
                old = rearrange(raw[i, window][[0, -1]][:, turned], "ends (joints six) -> ends joints six", six=6)
                first, last = rows_to_matrix(old)
                steps = torch.linspace(0, 1, window.stop - window.start).to(raw)
                arc = matrix_to_rows(roma.rotmat_slerp(first, last, steps))
                smooth[i, window, turned] = rearrange(arc, "frames joints six -> frames (joints six)")
    return smooth


def _rotations(layout: Layout, part: BodyPart) -> list[int]:
    """The columns of a part's rotations."""
    where = layout["rotations"]
    return [column for column in layout.columns[part] if where.start <= column < where.stop]
