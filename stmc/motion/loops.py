"""Motions that go round: the part of a motion whose end leads into its beginning, and the rest bent to close the gap.

Knows poses and their speeds; knows no text and no features.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from stmc.motion.body_model import Skeleton
from stmc.motion.geometry import axis_angle_to_matrix, matrix_to_axis_angle, rotation_z
from stmc.motion.motion import Motion

_SHORTEST = 0.8
"""Seconds of the shortest loop: two steps of a runner take 0.7 s."""
_AHEAD = 0.2
"""Seconds: two frames are alike where their poses are, and where these would be so much later at their speeds."""
_STILL = 0.5
"""Metres, of all joints together: less movement than that hardly counts as any."""
_MOST = 4096
"""Frames that are compared with each other; of longer motions, the first."""


def looped(motion: Motion, seconds: float | int | None = None) -> Motion:
    """The part of a motion that repeats best, closed: its last frame leads into its first.

    Every frame is compared with every other, as poses in their own headings, with their speeds. Between the two that
    are most alike, for all that happens between them, the motion is kept, and what they differ by is taken away little
    by little over the whole of it. Where the body goes and turns is kept: a walk walks on, so the next round begins
    where this one ends, in the direction of then.

    `seconds`: how long the loop is, by default whatever closes best, at least 0.8 s. Raises `ValueError` for a motion
    that is too short for it.

    Examples:
        >>> [motion] = stmc.load().generate("walk # 0 # 3", steps=1)
        >>> stmc.looped(motion, seconds=1)
        Motion(20 frames at 20 fps, 1.00 s)
    """
    least = max(2, round(motion.fps * (_SHORTEST if seconds is None else seconds)))
    if motion.frames <= least:
        raise ValueError(f"{motion.frames} frames are too short for a loop of {least} and the one after it")
    start, end = _alike(motion.trimmed(0, min(motion.frames, max(_MOST, least + 1))), least, seconds is not None)
    return _closed(motion, start, end)


def _alike(motion: Motion, least: int, exactly: bool) -> tuple[int, int]:
    """The two frames, `least` or more apart, that are most alike."""
    local, frame = _local(motion)
    steps = motion.joints.diff(dim=0)
    speed = torch.cat([steps, steps[-1:]]) @ frame * motion.fps
    alike = torch.cat([local, local + _AHEAD * speed], dim=1).flatten(start_dim=1).double()
    busy = torch.cat([alike.new_zeros(1), local.diff(dim=0).flatten(start_dim=1).norm(dim=-1).double().cumsum(dim=0)])
    far = torch.cdist(alike, alike) / ((busy[None] - busy[:, None]).clamp(min=0) + _STILL).sqrt()
    apart = torch.arange(len(far), device=far.device)
    apart = apart[None] - apart[:, None]
    far = far.masked_fill(apart != least if exactly else apart < least, torch.inf)
    start, end = divmod(int(far.argmin()), len(far))
    return start, end


def _local(motion: Motion) -> tuple[Float[Tensor, "frames 24 3"], Float[Tensor, "frames 3 3"]]:
    """Joints as seen from the floor under the pelvis, turned to heading zero, and those frames' axes."""
    frame = rotation_z(motion.heading)
    under = motion.translation * motion.translation.new_tensor([1.0, 1.0, 0.0])
    return (motion.joints - under[:, None]) @ frame, frame


def _closed(motion: Motion, start: int, end: int) -> Motion:
    """Frames [start, end), bent so that the pose of the frame `end` would be that of the frame `start`."""
    kept = motion.trimmed(start, end + 1)
    share = torch.linspace(0, 1, kept.frames).to(kept.translation)
    share = share**2 * (3 - 2 * share)
    frame = rotation_z(kept.heading)
    local = torch.cat([(frame.mT @ kept.rotations[:, 0])[:, None], kept.rotations[:, 1:]], dim=1)
    gap = matrix_to_axis_angle(local[-1].mT @ local[0])
    local = local @ axis_angle_to_matrix(share[:, None, None] * gap)
    rotations = torch.cat([(frame @ local[:, 0])[:, None], local[:, 1:]], dim=1)
    translation = kept.translation.clone()
    translation[:, 2] += share * (translation[0, 2] - translation[-1, 2])
    skeleton = Skeleton.measured(kept.rotations, kept.joints)
    joints = skeleton.pose(rotations, translation)
    return Motion(rotations, translation, joints, motion.fps, motion.overlap).trimmed(0, end - start)
