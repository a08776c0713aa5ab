"""Loops: the part of a motion whose end leads into its beginning, bent to close the gap."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from stmc.motion.body_model import Skeleton
from stmc.motion.geometry import axis_angle_to_matrix, matrix_to_axis_angle, rotation_z
from stmc.motion.motion import Motion

_MIN_SECONDS = 0.8
"""Minimum duration of a loop in seconds: two steps of a runner take 0.7 s."""
_AHEAD = 0.2
"""Seconds of extrapolation: similar frames have similar poses now and at their velocities this much later."""
_STILL = 0.5
"""Metres, of all joints together, below which movement hardly counts."""
_MAX_FRAMES = 4096
"""Maximum number of frames that are compared with each other; the first frames of longer motions."""


def looped(motion: Motion, seconds: float | int | None = None) -> Motion:
    """Extract the part of a motion that repeats best, and close it: its last frame leads into its first.

    All pairs of frames are compared as poses in their own headings, with their velocities. The loop lies between the
    most similar pair, relative to the movement between them, and the difference of the pair is removed gradually over
    the whole loop. The path and the turns of the body are preserved: a walk walks on, so that the next repetition
    begins at the end of this one, in the direction of its end.

    `seconds` is the duration of the loop; by default the loop that closes best, at least 0.8 s. Raises `ValueError` if
    the motion is too short.

    Examples:
        >>> [motion] = stmc.load().generate("walk # 0 # 3", steps=1)
        >>> stmc.looped(motion, seconds=1)
        Motion(20 frames at 20 fps, 1.00 s)
    """
    least = max(2, round(motion.fps * (_MIN_SECONDS if seconds is None else seconds)))
    if motion.frames <= least:
        raise ValueError(f"{motion.frames} frames are too short for a loop of {least} frames, which needs one more")
    start, end = _most_similar_frames(
        motion.trimmed(0, min(motion.frames, max(_MAX_FRAMES, least + 1))), least, seconds is not None
    )
    return _close(motion, start, end)


def _most_similar_frames(motion: Motion, least: int, exactly: bool) -> tuple[int, int]:
    """Find the two most similar frames that are at least (or exactly) `least` frames apart."""
    local, frame = _local_joints(motion)
    steps = motion.joints.diff(dim=0)
    speed = torch.cat([steps, steps[-1:]]) @ frame * motion.fps
    poses = torch.cat([local, local + _AHEAD * speed], dim=1).flatten(start_dim=1).double()
    movement = torch.cat(
        [poses.new_zeros(1), local.diff(dim=0).flatten(start_dim=1).norm(dim=-1).double().cumsum(dim=0)]
    )
    cost = torch.cdist(poses, poses) / ((movement[None] - movement[:, None]).clamp(min=0) + _STILL).sqrt()
    index = torch.arange(len(cost), device=cost.device)
    gap = index[None] - index[:, None]
    cost = cost.masked_fill(gap != least if exactly else gap < least, torch.inf)
    start, end = divmod(int(cost.argmin()), len(cost))
    return start, end


def _local_joints(motion: Motion) -> tuple[Float[Tensor, "frames 24 3"], Float[Tensor, "frames 3 3"]]:
    """Return joints relative to the floor below the pelvis, rotated to heading zero, and the axes of those frames."""
    frame = rotation_z(motion.heading)
    under = motion.translation * motion.translation.new_tensor([1.0, 1.0, 0.0])
    return (motion.joints - under[:, None]) @ frame, frame


def _close(motion: Motion, start: int, end: int) -> Motion:
    """Bend frames [start, end) so that the pose of frame `end` becomes that of frame `start`."""
    part = motion.trimmed(start, end + 1)
    weight = torch.linspace(0, 1, part.frames).to(part.translation)
    weight = weight**2 * (3 - 2 * weight)
    frame = rotation_z(part.heading)
    local = torch.cat([(frame.mT @ part.rotations[:, 0])[:, None], part.rotations[:, 1:]], dim=1)
    gap = matrix_to_axis_angle(local[-1].mT @ local[0])
    local = local @ axis_angle_to_matrix(weight[:, None, None] * gap)
    rotations = torch.cat([(frame @ local[:, 0])[:, None], local[:, 1:]], dim=1)
    translation = part.translation.clone()
    translation[:, 2] += weight * (translation[0, 2] - translation[-1, 2])
    skeleton = Skeleton.measured(part.rotations, part.joints)
    joints = skeleton.pose(rotations, translation)
    return Motion(rotations, translation, joints, motion.fps, motion.overlap).trimmed(0, end - start)
