"""How smooth a motion is where it passes from one action to the next: steps of the pose, and jerk.

Knows positions of joints over frames; knows no network, no features and no text. Positions in metres; differences are
*per frame*, as in the papers' tables, so numbers of different frame rates do not compare.
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
"""The data sets' average of the largest jerk of any joint, in m/frame³ at 20 and at 30 frames a second (FlowMDM)."""

HUMANML3D_WINDOW, BABEL_WINDOW = 60, 30
"""Frames of a transition in the two data sets (FlowMDM, section 4.1)."""


JERKED = 22
"""Joints whose jerk counts: SMPL's without the hands, those that HumanML3D has."""


def pose_steps(local: Float[Tensor, "frames joints 3"]) -> Float[Tensor, " steps"]:
    """How far a joint moves relative to the pelvis (joint 0), from each frame to the next, on average over all joints.

    Metres; one value less than frames. `local` are positions that do not turn with the body: in the heading frame of
    each frame, or of a motion that does not turn.
    """
    relative = local - local[:, :1]
    return relative.diff(dim=0).norm(dim=-1).mean(dim=-1)


def transition_distance(poses: Sequence[Float[Tensor, "_ joints 3"]], points: Sequence[Sequence[int]]) -> float:
    """Mean of `pose_steps` into the frames `points` of each motion, over all points of all motions; metres (tables say
    it in centimetres). STMC, section 4.2, after TEACH: the Euclidean distance of the poses around a transition.

    Raises `ValueError` for no point at all, and for a point that is not a frame with one before it.
    """
    steps = []
    for local, chosen in zip(poses, points, strict=True):
        if chosen and not 0 < min(chosen) <= max(chosen) < len(local):
            raise ValueError(f"points {list(chosen)} of a motion of {len(local)} frames: need 0 < point < frames")
        steps.append(pose_steps(local)[[point - 1 for point in chosen]])
    return _mean(torch.cat(steps))


def published_transition_distance(
    poses: Sequence[Float[Tensor, "_ joints 3"]], points: Sequence[Sequence[int]]
) -> float:
    """What the published code prints for generated motions: of each joint not the pelvis but the joint's own first
    coordinate is subtracted, from all three. So the path of the body counts, and the value is no distance of poses;
    it is not comparable with the ground truth's in the same table. `poses`: z up, from `features_to_local_joints`."""
    steps = []
    for local, chosen in zip(poses, points, strict=True):
        skewed = local - local[..., :1]
        steps.append(skewed.diff(dim=0).norm(dim=-1).mean(dim=-1)[[point - 1 for point in chosen]])
    return _mean(torch.cat(steps))


def transition_points(spans: Sequence[tuple[int, int]], frames: int) -> tuple[int, ...]:
    """The frames at which a prompt of these `spans` [start, end) begins or ends while the motion goes on."""
    return tuple(sorted({edge for span in spans for edge in span if 0 < edge < frames}))


def published_transition_points(spans: Sequence[tuple[int, int]], frames: int) -> tuple[int, ...]:
    """Those that the published code counts of a motion of so many frames: the first edge and the last *within* the
    motion are dropped for its start and its end, so the last real transition is missing (935 of MTT's 1450 count)."""
    edges = sorted({edge for span in spans for edge in span if edge < frames})
    return tuple(edges[1:-1])


def quarter_points(frames: int) -> tuple[int, ...]:
    """Where real motions, which have no transition, are measured for comparison: at 1/4, 1/2 and 3/4."""
    return tuple(sorted({quarter * frames // 4 for quarter in (1, 2, 3)} - {0}))


def transition_window(boundary: int, length: int = HUMANML3D_WINDOW) -> tuple[int, int]:
    """Frames [start, end) of the transition around the first frame of the second action (FlowMDM, section 4.1)."""
    return boundary - length // 2, boundary + length - length // 2


def jerk(
    joints: Float[Tensor, "*batch frames joints 3"], lengths: Int[Tensor, "*batch"] | None = None
) -> Float[Tensor, "*batch _"]:
    """The largest jerk of any joint in each frame: third differences of its position, their absolute values summed over
    the axes; m/frame³. Three values less than frames; those that look past the `lengths` are 0.

    The sum over axes depends on how the motion is turned: windows should begin with heading zero (FlowMDM's do).
    """
    values = joints.diff(n=3, dim=-3).abs().sum(dim=-1).amax(dim=-1)
    if lengths is None:
        return values
    exists = mask(lengths.flatten() - 3, values.shape[-1]).reshape(values.shape)
    return torch.where(exists, values, 0.0)


def window_jerk(window: Motion, frames: int) -> Float[Tensor, " _"]:
    """The `jerk` of a window of a motion, in m/frame³, turned to begin with heading zero, in `frames - 3`
    values; where the motion ends within the window, its last one goes on."""
    joints = window.joints[:, :JERKED] @ rotation_z(-window.heading[0]).mT
    values = jerk(joints)
    return torch.cat([values, values[-1:].expand(frames - 3 - len(values))])


def jerk_curve(jerks: Float[Tensor, "transitions frames"]) -> Float[Tensor, " frames"]:
    """Mean `jerk` of all transitions in each frame of the window: what the two numbers below are read off.

    As in FlowMDM's code, the mean comes first; the paper's formula (Eq. 4) reads as a mean of each transition's own
    peak, which is several times as large.
    """
    return jerks.mean(dim=0)


def peak_jerk(curve: Float[Tensor, " frames"]) -> float:
    """The largest value of the `jerk_curve`; m/frame³ (PJ: FlowMDM, section 4.1)."""
    return float(curve.max())


def area_under_jerk(curve: Float[Tensor, " frames"], average: float | int = HUMANML3D_JERK) -> float:
    """The summed distance of the `jerk_curve` from the `average` of real motion (AUJ: FlowMDM, section 4.1)."""
    return float((curve - average).abs().sum())


def _mean(values: Tensor) -> float:
    if not len(values):
        raise ValueError("no transition at all to measure")
    return float(values.double().mean())
