"""Smooth concatenation of motions, and rest before and after a motion: the body stands as in a recording."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from stmc.editing.leg_posing import exact, match_dtype, reach_with_legs, select_legs
from stmc.editing.paths import reverse
from stmc.motion.body import PARENTS
from stmc.motion.body_model import Skeleton
from stmc.motion.geometry import axis_angle_to_matrix, global_rotations, matrix_to_axis_angle, rotation_z
from stmc.motion.motion import Motion
from stmc.settings.records import SettingError

_RATE = 6.0
"""Rate of the critically damped spring from one pose to another, per second: 95 % in 0.8 s."""
_LIFTED = 0.06
"""Metres by which a foot moves, in height or on the ground, before it counts as lifted."""
_LANDING = 0.25
"""Seconds after that until a foot is on its own path."""


def follow(motion: Motion, following: Motion) -> Motion:
    """Append a motion to another; it begins at the position and the heading in which the first one ends.

    Feet stay in place at the end of the first motion until the second one lifts them. Everything else moves from the
    last pose, and its speed, to the second motion: a critically damped spring removes the difference. Therefore, the
    first motion should end, and the second one begin, with both feet on the floor. The second motion's first frame
    coincides with the first motion's last. Raises `SettingError` for a motion of fewer than two frames, or for two
    different frame rates.

    After Bollo, *Inertialization* (Game Developers Conference 2018).

    Examples:
        >>> [jump] = stmc.load().generate("jump forward # 0 # 2", steps=1)
        >>> stmc.follow(jump, jump)
        Motion(79 frames at 20 fps, 3.95 s)
    """
    if following.fps != motion.fps or min(motion.frames, following.frames) < 2:
        raise SettingError(
            f"follow: {motion.frames} frames at {motion.fps:g} fps and {following.frames} at {following.fps:g}; "
            "both need at least two frames and the same frame rate"
        )
    first, skeleton = exact(motion)
    second = _place_after(exact(following)[0], first, skeleton)
    offset = matrix_to_axis_angle(second.rotations[:2].mT @ _extrapolate(first.rotations))
    frames = second.frames - 1
    rotations = second.rotations[1:] @ axis_angle_to_matrix(_decay(offset, frames, first.fps))
    distance = _extrapolate(first.translation) - second.translation[:2]
    translation = second.translation[1:] + _decay(distance, frames, first.fps)
    feet, ankles = _plant_feet(first, second)
    posed = Motion.posed(rotations, translation, first.fps, skeleton)
    after = reach_with_legs(posed, ankles[1:], feet[1:], skeleton)
    rotations, translation, joints = (
        torch.cat([getattr(first, name), getattr(after, name)]) for name in ("rotations", "translation", "joints")
    )
    return match_dtype(Motion(rotations, translation, joints, first.fps), motion)


def add_rest(motion: Motion, rest: Motion, before: float | int = 0.0, after: float | int = 0.0) -> Motion:
    """Add seconds of standing before and after a motion, with `follow`.

    Args:
        motion: Motion to extend.
        rest: Recording of a person who stands.
        before: Seconds of standing before the motion.
        after: Seconds of standing after it.

    Raises:
        SettingError: If `rest` does not last longer than `before` and `after`, or has another frame rate.

    Examples:
        >>> [jump] = stmc.load().generate("jump forward # 0 # 2", steps=1)
        >>> [stand] = stmc.load().generate("stand # 0 # 3", steps=1)
        >>> stmc.add_rest(jump, stand, after=1.5)
        Motion(70 frames at 20 fps, 3.50 s)
    """
    for seconds in (after, before):
        frames = round(seconds * motion.fps)
        if not 0 <= frames < rest.frames:
            raise SettingError(f"rest of {seconds} s: the recording lasts {rest.duration:g} s and must last longer")
        motion = reverse(follow(motion, rest.trimmed(0, frames + 1)) if frames else motion)
    return motion


def _place_after(following: Motion, motion: Motion, skeleton: Skeleton) -> Motion:
    """Move the following motion to the end of the first one, at its own height."""
    turn = rotation_z(motion.heading[-1] - following.heading[0])
    rotations = following.rotations.clone()
    rotations[:, 0] = turn @ rotations[:, 0]
    translation = (following.translation - following.translation[0]) @ turn.T + motion.translation[-1]
    translation[:, 2] = following.translation[:, 2]
    return Motion.posed(rotations, translation, motion.fps, skeleton)


def _plant_feet(first: Motion, second: Motion) -> tuple[Float[Tensor, "frames 2 3 3"], Float[Tensor, "frames 2 3"]]:
    """Return world rotations and ankles of the second motion's feet; until lifted, each stays as the first left it."""
    feet, ankles = (
        select_legs(global_rotations(second.rotations, PARENTS), "ankle"),
        select_legs(second.joints, "ankle"),
    )
    last = (
        select_legs(global_rotations(first.rotations[-1:], PARENTS), "ankle"),
        select_legs(first.joints[-1:], "ankle"),
    )
    lifted = ((ankles - ankles[:1]).norm(dim=-1) > _LIFTED).int().cummax(dim=0).values
    since = (lifted.cumsum(dim=0) / (_LANDING * second.fps)).clamp(0, 1)
    weight = 1 - since**2 * (3 - 2 * since)
    turn = matrix_to_axis_angle(last[0] @ feet[:1].mT)
    turned = axis_angle_to_matrix(weight[..., None] * turn) @ feet
    return turned, ankles + weight[..., None] * (last[1] - ankles[:1])


def _extrapolate(values: Float[Tensor, " frames *width"]) -> Float[Tensor, " 2 *width"]:
    """Return positions or rotations in the last frame, and their extrapolation to the next."""
    if values.ndim == 2:
        return torch.stack([values[-1], 2 * values[-1] - values[-2]])
    return torch.stack([values[-1], values[-1] @ values[-2].mT @ values[-1]])


def _decay(offset: Float[Tensor, " 2 *width"], frames: int, fps: float | int) -> Float[Tensor, " frames *width"]:
    """Continue an offset after the first of its two frames; a critically damped spring draws it to zero."""
    times = torch.arange(1, frames + 1, dtype=offset.dtype).reshape(-1, *[1] * (offset.ndim - 1)) / fps
    speed = (offset[1] - offset[0]) * fps
    return (offset[0] + (speed + _RATE * offset[0]) * times) * torch.exp(-_RATE * times)
