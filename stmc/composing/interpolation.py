"""Smoothing of seams after sampling: SINC's linear interpolation, and TEACH's spherical interpolation."""

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
    r"""Smooth SINC's result by linear interpolation wherever a body part changes from one crop to another.

    The line covers `overlap` frames around the change, half of them on each side, within the timeline, from the value
    of its first frame to that of its last. Lines start from the values before smoothing; if two lines of one part
    overlap, the later one wins.

    Args:
        features: Features of the timelines, [batch, frames, features].
        plans: Plans without overlap.
        columns: Columns of each body part.
        overlap: Number of frames of a line.

    Raises:
        ValueError: If a plan has an overlap.

    Examples:
        >>> plan = stmc.plan(stmc.Timeline.parse("walk # 0 # 1\njump # 1 # 2"), fps=20, overlap=0)
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
    """Return the `overlap` frames around each change of `part` from one crop to another, within the timeline.

    Half of the frames are on each side; an overlap of 0 has no seams.

    Args:
        plan: Plan without overlap.
        part: Body part.
        overlap: Number of frames of a seam.

    Raises:
        ValueError: If the plan has an overlap.
    """
    tiles = sorted((tile for tile in plan.tiles if tile.part == part), key=lambda tile: tile.start)
    if any(a.end > b.start for a, b in pairwise(tiles)):
        raise ValueError(f"the tiles of {part} overlap; seams need plans with overlap=0")
    changes = [b.start for a, b in pairwise(tiles) if a.crop != b.crop] if overlap > 0 else []
    left, right = overlap // 2, overlap - overlap // 2
    return [slice(max(0, change - left), min(plan.frames, change + right)) for change in changes]


def slerp(
    raw: Float[Tensor, "batch frames features"], plans: Sequence[Plan], layout: Layout, overlap: int
) -> Float[Tensor, "batch frames features"]:
    """Smooth seams in features that are not normalised, with rotations on the shortest arc of the sphere.

    TEACH smooths its transitions in this way (Athanasiou et al. 2022). Other features are smoothed by `smooth_seams`.

    Args:
        raw: Features that are not normalised, [batch, frames, features].
        plans: Plans without overlap.
        layout: Layout of the features; its field "rotations" holds two rows, or two columns, of a matrix per joint.
        overlap: Number of frames to replace around each change.
    """
    import roma  # imported late: it takes as long to import as torch

    smooth = smooth_seams(raw, plans, layout.columns, overlap)
    for i, plan in enumerate(plans):
        for part in BodyPart:
            rotations = _rotations(layout, part)
            for window in seams(plan, part, overlap) if rotations else ():
                old = rearrange(raw[i, window][[0, -1]][:, rotations], "ends (joints six) -> ends joints six", six=6)
                first, last = rows_to_matrix(old)
                steps = torch.linspace(0, 1, window.stop - window.start).to(raw)
                arc = matrix_to_rows(roma.rotmat_slerp(first, last, steps))
                smooth[i, window, rotations] = rearrange(arc, "frames joints six -> frames (joints six)")
    return smooth


def _rotations(layout: Layout, part: BodyPart) -> list[int]:
    """Return the columns of a part's rotations."""
    field = layout["rotations"]
    return [column for column in layout.columns[part] if field.start <= column < field.stop]
