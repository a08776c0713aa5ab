"""Longer walks and runs: whole strides of a recording, repeated."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from stmc.data.sources.edited.recipe import Unusable
from stmc.motion.body_model import Skeleton
from stmc.motion.geometry import axis_angle_to_matrix, matrix_to_axis_angle, rotation_z
from stmc.motion.motion import Motion

_SHORTEST = 0.5
"""Minimum duration of the repeated part in seconds; a stride of a run lasts 0.6 to 0.8 seconds, of a walk 1 to 1.3."""
_ALIKE = 0.035
"""Maximum mean distance in metres of the joints, relative to the pelvis, between two frames of the same phase."""
_BLEND = 0.25
"""Seconds over which the difference between the two frames fades."""


def repeat_strides(motion: Motion, seconds: float | int) -> Motion:
    """Repeat the strides between two frames of the same phase until a motion lasts `seconds`.

    The repeated part is as long as possible, begins where the previous one ended, and keeps its heading relative to it.
    A motion that is long enough stays as it is. Raises `Unusable` if no two frames are alike.
    """
    frames = round(seconds * motion.fps)
    if motion.frames >= frames:
        return motion
    first, last = _find_period(motion)
    longer = motion.trimmed(0, last + 1)
    while longer.frames < frames:
        longer = _append(longer, motion.trimmed(first, last + 1))
    return longer.trimmed(0, frames)


def _find_period(motion: Motion) -> tuple[int, int]:
    """Return two frames of the same pose and movement that are far apart: the most alike of the most distant ones."""
    body = _body_points(motion)
    movement = torch.cat([body, body.diff(dim=0, prepend=body[:1]) * motion.fps * 0.1], dim=1)[1:]
    distances = (movement[:, None] - movement).norm(dim=-1).mean(dim=-1)
    shortest = round(_SHORTEST * motion.fps)
    alike = (distances < _ALIKE).triu(shortest).nonzero()
    if not len(alike):
        raise Unusable(f"no two frames, {_SHORTEST} s apart or more, are of one phase")
    lengths = alike[:, 1] - alike[:, 0]
    longest = alike[lengths > lengths.max() - shortest]
    first, last = longest[distances[longest[:, 0], longest[:, 1]].argmin()]
    return int(first) + 1, int(last) + 1


def _body_points(motion: Motion) -> Float[Tensor, "frames joints 3"]:
    """Return the joints relative to the pelvis, in its heading, and at their height."""
    points = motion.joints - motion.translation[:, None] * motion.joints.new_tensor([1, 1, 0])
    return points @ rotation_z(motion.heading)


def _append(motion: Motion, strides: Motion) -> Motion:
    """Append strides whose first frame is of the phase of the motion's last one; the difference fades."""
    skeleton = Skeleton.measured(motion.rotations, motion.joints)
    turn = rotation_z(motion.heading[-1] - strides.heading[0])
    rotations = strides.rotations.clone()
    rotations[:, 0] = turn @ rotations[:, 0]
    translation = (strides.translation - strides.translation[0]) @ turn.T
    translation[:, :2] += motion.translation[-1, :2]
    translation[:, 2] = strides.translation[:, 2]
    fade = (1 - torch.arange(strides.frames, dtype=translation.dtype) / (_BLEND * motion.fps)).clamp(0)
    fade = fade**2 * (3 - 2 * fade)
    offset = matrix_to_axis_angle(rotations[0].mT @ motion.rotations[-1])
    rotations = rotations @ axis_angle_to_matrix(offset * fade[:, None, None])
    translation[:, 2] += fade * (motion.translation[-1, 2] - translation[0, 2])
    return Motion.posed(
        torch.cat([motion.rotations, rotations[1:]]),
        torch.cat([motion.translation, translation[1:]]),
        motion.fps,
        skeleton,
    )
