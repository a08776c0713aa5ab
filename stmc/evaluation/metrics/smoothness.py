"""Smoothness at the transition between actions: steps of the pose, and jerk.

Depends on positions of joints over frames; independent of networks, features and texts. Positions are in metres;
differences are *per frame*, as in the papers' tables, so that numbers of different frame rates are not comparable.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from jaxtyping import Float, Int
from torch import Tensor

from stmc.diffusion.tensors import mask
from stmc.motion.geometry import rotation_z
from stmc.motion.motion import Motion

HUMANML3D_JERK, BABEL_JERK = 0.033031363, 0.016383045
"""Averages over the data sets of the largest jerk of any joint, in m/frame³ at 20 and at 30 fps (FlowMDM)."""
HUMANML3D_WINDOW, BABEL_WINDOW = 60, 30
"""Lengths in frames of a transition in the two data sets (FlowMDM, section 4.1)."""
JERKED = 22
"""Number of joints whose jerk counts: SMPL's without the hands, as in HumanML3D."""


def pose_steps(local: Float[Tensor, "frames joints 3"]) -> Float[Tensor, " steps"]:
    """Return the mean distance that joints move relative to the pelvis (joint 0) between consecutive frames.

    The unit is metres; there is one value fewer than frames. `local` are positions that do not turn with the body: in
    the heading frame of each frame, or of a motion that does not turn.
    """
    relative = local - local[:, :1]
    return relative.diff(dim=0).norm(dim=-1).mean(dim=-1)


def transition_distance(poses: Sequence[Float[Tensor, "_ joints 3"]], points: Sequence[Sequence[int]]) -> float:
    """Return the mean of `pose_steps` into the frames `points` of each motion, in metres (tables use centimetres).

    It is the Euclidean distance of the poses around a transition (STMC, section 4.2, after TEACH), averaged over all
    points of all motions. Raises `ValueError` if there is no point, or a point is not a frame with a predecessor.
    """
    steps = []
    for local, frames in zip(poses, points, strict=True):
        if frames and not 0 < min(frames) <= max(frames) < len(local):
            raise ValueError(
                f"points {list(frames)} of a motion of {len(local)} frames must satisfy 0 < point < {len(local)}"
            )
        steps.append(pose_steps(local)[[point - 1 for point in frames]])
    return _mean(torch.cat(steps))


def published_transition_distance(
    poses: Sequence[Float[Tensor, "_ joints 3"]], points: Sequence[Sequence[int]]
) -> float:
    """Compute the value that the published code prints for generated motions.

    It subtracts from the coordinates of each joint the joint's own first coordinate instead of the pelvis. The path of
    the body therefore counts; the value is not a distance of poses and is not comparable with the ground truth's in the
    same table. `poses` are z up, from `features_to_local_joints`.
    """
    steps = []
    for local, frames in zip(poses, points, strict=True):
        skewed = local - local[..., :1]
        steps.append(skewed.diff(dim=0).norm(dim=-1).mean(dim=-1)[[point - 1 for point in frames]])
    return _mean(torch.cat(steps))


def transition_points(spans: Sequence[tuple[int, int]], frames: int) -> tuple[int, ...]:
    """Return the frames at which a prompt of these `spans` [start, end) begins or ends while the motion continues."""
    return tuple(sorted({edge for span in spans for edge in span if 0 < edge < frames}))


def published_transition_points(spans: Sequence[tuple[int, int]], frames: int) -> tuple[int, ...]:
    """Return the transition points of the published code.

    It drops the first and last edge *within* the motion instead of the motion's start and end, so that the last real
    transition is missing (935 of MTT's 1450 count).
    """
    edges = sorted({edge for span in spans for edge in span if edge < frames})
    return tuple(edges[1:-1])


def quarter_points(frames: int) -> tuple[int, ...]:
    """Return the frames at 1/4, 1/2 and 3/4, at which real motions without transitions are measured for comparison."""
    return tuple(sorted({quarter * frames // 4 for quarter in (1, 2, 3)} - {0}))


def transition_window(boundary: int, length: int = HUMANML3D_WINDOW) -> tuple[int, int]:
    """Return the frames [start, end) of the transition around the first frame of the second action.

    See FlowMDM, section 4.1.
    """
    return boundary - length // 2, boundary + length - length // 2


def jerk(
    joints: Float[Tensor, "*batch frames joints 3"], lengths: Int[Tensor, "*batch"] | None = None
) -> Float[Tensor, "*batch _"]:
    """Return the largest jerk of any joint in each frame, in m/frame³.

    The jerk is the third difference of the position, its absolute values summed over the axes. There are three values
    fewer than frames; values that reach beyond `lengths` are 0. The sum over axes depends on the orientation of the
    motion: windows should begin with heading zero, as FlowMDM's do.
    """
    values = joints.diff(n=3, dim=-3).abs().sum(dim=-1).amax(dim=-1)
    if lengths is None:
        return values
    present = mask(lengths.flatten() - 3, values.shape[-1]).reshape(values.shape)
    return torch.where(present, values, 0.0)


def window_jerk(window: Motion, frames: int) -> Float[Tensor, " _"]:
    """Return the `jerk` of a window, rotated to begin with heading zero, in m/frame³ and `frames - 3` values.

    If the motion ends within the window, the last value is repeated.
    """
    joints = window.joints[:, :JERKED] @ rotation_z(-window.heading[0]).mT
    values = jerk(joints)
    return torch.cat([values, values[-1:].expand(frames - 3 - len(values))])


def jerk_curve(jerks: Float[Tensor, "transitions frames"]) -> Float[Tensor, " frames"]:
    """Average the `jerk` of all transitions in each frame of the window, for `peak_jerk` and `area_under_jerk`.

    As in FlowMDM's code, the mean is computed first; the paper's formula (Eq. 4) reads as a mean of the peaks of single
    transitions, which is several times as large.
    """
    return jerks.mean(dim=0)


def peak_jerk(curve: Float[Tensor, " frames"]) -> float:
    """Return the maximum of the `jerk_curve` in m/frame³ (PJ; FlowMDM, section 4.1)."""
    return float(curve.max())


def area_under_jerk(curve: Float[Tensor, " frames"], average: float | int = HUMANML3D_JERK) -> float:
    """Return the summed distance of the `jerk_curve` from the `average` of real motion (AUJ; FlowMDM, section 4.1)."""
    return float((curve - average).abs().sum())


def _mean(values: Tensor) -> float:
    if not len(values):
        raise ValueError("no transition to measure; pass at least one point")
    return float(values.double().mean())
