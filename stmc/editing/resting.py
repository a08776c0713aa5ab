"""One motion behind another without a break, and rest before and after a motion: a body that has done something stands
and goes on living as a recorded one does.

Knows motions and legs; knows no text and no features.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from stmc.editing.leg_posing import exact, like, of_legs, reach_with_legs
from stmc.editing.paths import reverse
from stmc.motion.body import PARENTS
from stmc.motion.body_model import Skeleton
from stmc.motion.geometry import axis_angle_to_matrix, global_rotations, matrix_to_axis_angle, rotation_z
from stmc.motion.motion import Motion
from stmc.settings.records import SettingError

_RATE = 6.0
"""Per second, of the critically damped spring with which one pose becomes another: 95 % in 0.8 s."""
_LIFTED = 0.06
"""Metres that a foot goes from its place, in height or on the ground, when it has left it."""
_LANDING = 0.25
"""Seconds after that in which a foot comes to its own path."""


def follow(motion: Motion, following: Motion) -> Motion:
    """The motion, and behind its end the `following` one, which begins where it ends and faces where it faces.

    Feet stay where they stand at the end of the first motion until the second one lifts them. All else passes from the
    pose there, and from its speed, to the second motion: a critically damped spring takes the difference away. So the
    first motion should end, and the second one begin, with both feet on the floor. The second motion's first frame
    falls together with the first motion's last. Raises `SettingError` for fewer than two frames or two frame rates.

    After Bollo, *Inertialization* (Game Developers Conference 2018).

    Examples:
        >>> [jump] = stmc.load().generate("jump forward # 0 # 2", steps=1)
        >>> stmc.follow(jump, jump)
        Motion(79 frames at 20 fps, 3.95 s)
    """
    if following.fps != motion.fps or min(motion.frames, following.frames) < 2:
        raise SettingError(
            f"follow: {motion.frames} frames at {motion.fps:g} fps and {following.frames} at {following.fps:g}; "
            "two frames or more, and one frame rate, are needed"
        )
    first, skeleton = exact(motion)
    second = _placed(exact(following)[0], first, skeleton)
    offset = matrix_to_axis_angle(second.rotations[:2].mT @ _last(first.rotations))
    frames = second.frames - 1
    rotations = second.rotations[1:] @ axis_angle_to_matrix(_sprung(offset, frames, first.fps))
    apart = _last(first.translation) - second.translation[:2]
    places = second.translation[1:] + _sprung(apart, frames, first.fps)
    feet, ankles = _feet(first, second)
    posed = Motion.posed(rotations, places, first.fps, skeleton)
    after = reach_with_legs(posed, ankles[1:], feet[1:], skeleton)
    pairs = [(getattr(first, name), getattr(after, name)) for name in ("rotations", "translation", "joints")]
    return like(Motion(*(torch.cat(pair) for pair in pairs), first.fps), motion)


def add_rest(motion: Motion, rest: Motion, before: float | int = 0.0, after: float | int = 0.0) -> Motion:
    """The motion with `before` and `after` seconds of standing as in `rest`, a recording of somebody who stands: the
    motion `follow`s it, and is followed by it.

    Raises `SettingError` if `rest` does not last longer than either, or has another frame rate.

    Examples:
        >>> [jump] = stmc.load().generate("jump forward # 0 # 2", steps=1)
        >>> [stand] = stmc.load().generate("stand # 0 # 3", steps=1)
        >>> stmc.add_rest(jump, stand, after=1.5)
        Motion(70 frames at 20 fps, 3.50 s)
    """
    for seconds in (after, before):
        frames = round(seconds * motion.fps)
        if not 0 <= frames < rest.frames:
            raise SettingError(f"rest of {seconds} s from a recording of {rest.duration:g} s: it must last longer")
        motion = reverse(follow(motion, rest.trimmed(0, frames + 1)) if frames else motion)
    return motion


def _placed(following: Motion, motion: Motion, skeleton: Skeleton) -> Motion:
    """The following motion where the first one ends, at its own height."""
    turn = rotation_z(motion.heading[-1] - following.heading[0])
    rotations = following.rotations.clone()
    rotations[:, 0] = turn @ rotations[:, 0]
    places = (following.translation - following.translation[0]) @ turn.T + motion.translation[-1]
    places[:, 2] = following.translation[:, 2]
    return Motion.posed(rotations, places, motion.fps, skeleton)


def _feet(first: Motion, second: Motion) -> tuple[Float[Tensor, "frames 2 3 3"], Float[Tensor, "frames 2 3"]]:
    """The second motion's feet, rotations to the world and ankles; each is where the first motion leaves it until it is
    lifted."""
    feet, ankles = of_legs(global_rotations(second.rotations, PARENTS), "ankle"), of_legs(second.joints, "ankle")
    last = of_legs(global_rotations(first.rotations[-1:], PARENTS), "ankle"), of_legs(first.joints[-1:], "ankle")
    lifted = ((ankles - ankles[:1]).norm(dim=-1) > _LIFTED).int().cummax(dim=0).values
    since = (lifted.cumsum(dim=0) / (_LANDING * second.fps)).clamp(0, 1)
    share = 1 - since**2 * (3 - 2 * since)
    turn = matrix_to_axis_angle(last[0] @ feet[:1].mT)
    turned = axis_angle_to_matrix(share[..., None] * turn) @ feet
    return turned, ankles + share[..., None] * (last[1] - ankles[:1])


def _last(values: Float[Tensor, " frames *width"]) -> Float[Tensor, " 2 *width"]:
    """Where places, or rotations, are in the last frame, and where they would be in the next."""
    if values.ndim == 2:
        return torch.stack([values[-1], 2 * values[-1] - values[-2]])
    return torch.stack([values[-1], values[-1] @ values[-2].mT @ values[-1]])


def _sprung(offset: Float[Tensor, " 2 *width"], frames: int, fps: float | int) -> Float[Tensor, " frames *width"]:
    """How an offset goes on after its first of two frames, drawn to zero by a critically damped spring."""
    times = torch.arange(1, frames + 1, dtype=offset.dtype).reshape(-1, *[1] * (offset.ndim - 1)) / fps
    speed = (offset[1] - offset[0]) * fps
    return (offset[0] + (speed + _RATE * offset[0]) * times) * torch.exp(-_RATE * times)
