"""Rest before and after a motion: a body that has done something stands and goes on living as a recorded one does.

Knows motions and legs; knows no text and no features.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from stmc.body import PARENTS
from stmc.body_model import Skeleton
from stmc.editing.legs import exact, like, of_legs, reach_with_legs
from stmc.editing.paths import reverse
from stmc.geometry import axis_angle_to_matrix, global_rotations, matrix_to_axis_angle, rotation_z
from stmc.motion import Motion
from stmc.settings import SettingError

_RATE = 6.0
"""Per second, of the critically damped spring with which one pose becomes another: 95 % in 0.8 s."""


def add_rest(motion: Motion, rest: Motion, before: float | int = 0.0, after: float | int = 0.0) -> Motion:
    """The motion with `before` and `after` seconds of standing as in `rest`, a recording of somebody who stands.

    The feet stay where they stand in the motion's first and last frame. All else passes from the pose there, and from
    its speed, to the recorded one: a critically damped spring takes the difference away. So the motion should begin and
    end with both feet on the floor. Raises `SettingError` if `rest` is shorter than either, or has another frame rate.

    After Bollo, *Inertialization* (Game Developers Conference 2018).

    Examples:
        >>> [jump] = stmc.load().generate("jump forward # 0 # 2", steps=1)
        >>> [stand] = stmc.load().generate("stand # 0 # 3", steps=1)
        >>> stmc.add_rest(jump, stand, after=1.5)
        Motion(70 frames at 20 fps, 3.50 s)
    """
    if rest.fps != motion.fps or min(before, after) < 0 or motion.frames < 2:
        raise SettingError(
            f"rest of {before} s before and {after} s after a motion of {motion.frames} frames at {motion.fps:g} fps, "
            f"from a recording at {rest.fps:g} fps: two frames or more, and one frame rate, are needed"
        )
    body, skeleton = exact(motion)
    standing, _ = exact(rest)
    for seconds in (after, before):
        body = reverse(_followed(body, standing, round(seconds * motion.fps), skeleton))
    return like(body, motion)


def _followed(motion: Motion, rest: Motion, frames: int, skeleton: Skeleton) -> Motion:
    """The motion and so many frames of rest."""
    if rest.frames < frames + 2:
        raise SettingError(f"rest: {rest.frames} frames are too few for {frames} frames, and two in which they begin")
    if frames == 0:
        return motion
    local, turn = motion.rotations[-2:], motion.heading[-1] - rest.heading[1]
    wanted = rest.rotations[: frames + 2].clone()
    wanted[:, 0] = rotation_z(turn.expand(frames + 2)) @ wanted[:, 0]
    moved = (rest.translation[: frames + 2] - rest.translation[1]) @ rotation_z(turn).T
    offset = matrix_to_axis_angle(wanted[:2].mT @ local)
    rotations = wanted[2:] @ axis_angle_to_matrix(_sprung(offset, frames, motion.fps))
    places = motion.translation[-1] + moved
    height = rest.translation[: frames + 2, 2:]
    places[:, 2:] = height
    apart = motion.translation[-2:] - places[:2]
    places = places[2:] + _sprung(apart, frames, motion.fps)
    feet = of_legs(global_rotations(motion.rotations[-1:], PARENTS), "ankle").expand(frames, -1, -1, -1)
    ankles = of_legs(motion.joints[-1:], "ankle").expand(frames, -1, -1)
    after = reach_with_legs(Motion.posed(rotations, places, motion.fps, skeleton), ankles, feet, skeleton)
    pairs = [(getattr(motion, name), getattr(after, name)) for name in ("rotations", "translation", "joints")]
    return Motion(*(torch.cat(pair) for pair in pairs), motion.fps)


def _sprung(offset: Float[Tensor, 2 * width], frames: int, fps: float | int) -> Float[Tensor, frames * width]:
    """How an offset goes on after its last two frames, drawn to zero by a critically damped spring."""
    times = torch.arange(1, frames + 1, dtype=offset.dtype).reshape(-1, *[1] * (offset.ndim - 1)) / fps
    speed = (offset[1] - offset[0]) * fps
    return (offset[1] + (speed + _RATE * offset[1]) * times) * torch.exp(-_RATE * times)
