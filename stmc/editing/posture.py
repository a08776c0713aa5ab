"""Trunk, head, pelvis and feet that are led by keys, on top of what the motion does by itself.

Knows the spine and the legs; knows no arms (see `reaching`) and no text.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from stmc.editing.keys import Timing, blend_keys, check_order, frame_times, replace_frames
from stmc.editing.leg_posing import SIDES, joint, of_legs
from stmc.editing.reaching import Triple, body_frame
from stmc.motion.body import JOINTS, PARENTS
from stmc.motion.body_model import Skeleton
from stmc.motion.feet.leg_bending import LEG, bend_leg
from stmc.motion.geometry import axis_angle_to_matrix, global_rotations
from stmc.motion.motion import Motion

_NECK, _SPINE = ("neck", "head"), ("spine1", "spine2", "spine3")
_LOWER = (0, 1, 2, 4, 5, 7, 8, 10, 11)
"""The pelvis and the legs."""


@dataclass(frozen=True)
class TurnKey:
    """How far head or trunk are turned at `time` (seconds), beyond what the motion does; it takes `takes` seconds.

    Radians about the axes of the part below: `yaw` to the left, `pitch` forward and down, `roll` leaning to the left.
    Zeros lead back to the motion. `skew` as in `Timing`.

    Examples:
        >>> look = [stmc.TurnKey(1.0, 0.5, yaw=0.9), stmc.TurnKey(2.5, 0.6)]
    """

    time: float | int
    takes: float | int
    yaw: float | int = 0.0
    pitch: float | int = 0.0
    roll: float | int = 0.0
    skew: float | int = 1.0


@dataclass(frozen=True)
class PelvisKey:
    """How far the pelvis is moved at `time` (seconds), beyond what the motion does; it takes `takes` seconds.

    `offset`: metres (left, up, forward) in the pelvis' own heading; turns in radians, as those of `TurnKey`.

    Examples:
        >>> duck = [stmc.PelvisKey(1.0, 0.3, offset=(0, -0.2, 0)), stmc.PelvisKey(1.8, 0.6)]
    """

    time: float | int
    takes: float | int
    offset: Triple = (0.0, 0.0, 0.0)
    yaw: float | int = 0.0
    pitch: float | int = 0.0
    roll: float | int = 0.0
    skew: float | int = 1.0


@dataclass(frozen=True)
class FootKey:
    """Where a foot is set at `time` (seconds): `offset` (left, up, forward; metres, in the pelvis' heading) from where
    the motion has it; the way there takes `takes` seconds and is lifted by `lift` metres in its middle.

    Examples:
        >>> ahead = stmc.FootKey(1.0, 0.5, offset=(0, 0, 0.25))
    """

    time: float | int
    takes: float | int
    offset: Triple = (0.0, 0.0, 0.0)
    lift: float | int = 0.06
    skew: float | int = 1.0


def turn_head(motion: Motion, keys: Sequence[TurnKey]) -> Motion:
    """The motion with a head that turns, nods or tilts: half in the neck, half above it. All else stays as it is.

    Examples:
        >>> [motion] = stmc.load().generate("walk # 0 # 2", steps=1)
        >>> look = stmc.TurnKey(0.8, 0.6, yaw=0.9)
        >>> stmc.turn_head(motion, [look, stmc.TurnKey(1.8, 0.6)])
        Motion(40 frames at 20 fps, 2.00 s)
    """
    turns = _turns(motion, keys)
    return _turned(motion, turns, dict.fromkeys(_NECK, 0.5), [JOINTS.index(name) for name in _NECK])


def turn_trunk(motion: Motion, keys: Sequence[TurnKey], gaze: float | int = 0.0) -> Motion:
    """The motion with a trunk that twists, bends or leans, a third in each part of the spine. Pelvis and legs stay; the
    head and the arms go with the trunk.

    `gaze`: the fraction of the turn that the neck takes back, so that a head with 1 keeps looking where it looked.

    Examples:
        >>> [motion] = stmc.load().generate("walk # 0 # 2", steps=1)
        >>> stmc.turn_trunk(motion, [stmc.TurnKey(1.0, 0.8, yaw=0.4)], gaze=1)
        Motion(40 frames at 20 fps, 2.00 s)
    """
    turns = _turns(motion, keys)
    shares = dict.fromkeys(_SPINE, 1 / 3) | {"neck": -float(gaze)}
    return _turned(motion, turns, shares, [joint for joint in range(len(JOINTS)) if joint not in _LOWER])


def shift_pelvis(motion: Motion, keys: Sequence[PelvisKey]) -> Motion:
    """The motion with a pelvis that moves and turns while the feet stay where they are: weight shifts, hips that turn,
    a body that ducks. The legs bend in closed form; the trunk goes with the pelvis.

    A foot that the legs do not reach any more is led as near as possible.

    Examples:
        >>> [motion] = stmc.load().generate("walk # 0 # 2", steps=1)
        >>> stmc.shift_pelvis(motion, [stmc.PelvisKey(1.0, 0.8, offset=(0, -0.2, 0))])
        Motion(40 frames at 20 fps, 2.00 s)
    """
    values = blend_keys(
        frame_times(motion), _timings(keys), [(*key.offset, key.pitch, key.yaw, -key.roll) for key in keys], 6
    )
    exact = motion.to("cpu", torch.float64)
    axes = body_frame(exact, "ground", "left")[1]
    root = axes @ axis_angle_to_matrix(values[:, 3:]) @ axes.mT @ exact.rotations[:, 0]
    pelvis = exact.translation + (axes @ values[:, :3, None])[..., 0]
    ankles = of_legs(exact.joints, "ankle")
    edited = _standing(exact, root, pelvis, ankles)
    return replace_frames(motion, edited, range(len(JOINTS)), values.any(dim=1), path=True)


def step(motion: Motion, side: str, keys: Sequence[FootKey]) -> Motion:
    """The motion with one foot set elsewhere, lifted on the way; the leg follows in closed form, the rest stays.

    Examples:
        >>> [motion] = stmc.load().generate("stand # 0 # 2", steps=1)
        >>> stmc.step(motion, "right", [stmc.FootKey(1.0, 0.5, offset=(0, 0, 0.2))])
        Motion(40 frames at 20 fps, 2.00 s)
    """
    seconds = frame_times(motion)
    offsets = blend_keys(seconds, _timings(keys), [key.offset for key in keys], 3)
    for key, timing in zip(keys, _timings(keys), strict=True):
        fraction = timing.progress(seconds)
        offsets[:, 1] += key.lift * 16 * (fraction * (1 - fraction)) ** 2
    exact = motion.to("cpu", torch.float64)
    axes = body_frame(exact, "ground", "left")[1]
    ankles = of_legs(exact.joints, "ankle")
    ankles[:, SIDES.index(side)] += (axes @ offsets[..., None])[..., 0]
    edited = _standing(exact, exact.rotations[:, 0], exact.translation, ankles)
    joints = [joint(side, name) for name in (*LEG, "foot")]
    return replace_frames(motion, edited, joints, offsets.any(dim=1))


def bend_down(
    motion: Motion, time: float | int, takes: float | int, stay: float | int = 0.3, depth: float | int = 0.3
) -> Motion:
    """The motion with a body that has bent down at `time` (seconds), within `takes` seconds, stays there for `stay`
    seconds and comes up as fast: the pelvis `depth` metres lower and behind, the trunk forward, the feet in place.

    Reach afterwards (`reach`), so that goals of the hand follow the trunk.

    Examples:
        >>> [motion] = stmc.load().generate("stand # 0 # 3", steps=1)
        >>> stmc.bend_down(motion, 1.5, 1.0)
        Motion(60 frames at 20 fps, 3.00 s)
    """
    up, deep = time + stay + takes, float(depth) / 0.3
    hips = PelvisKey(time, takes, offset=(0.0, -float(depth), -0.1 * deep), pitch=0.75 * deep)
    lowered = shift_pelvis(motion, [hips, PelvisKey(up, takes)])
    return turn_trunk(lowered, [TurnKey(time, takes, pitch=0.45 * deep), TurnKey(up, takes)], gaze=0.4)


def _timings(keys: Sequence[TurnKey | PelvisKey | FootKey]) -> list[Timing]:
    check_order(keys)
    return [Timing(key.time, key.takes, key.skew) for key in keys]


def _turns(motion: Motion, keys: Sequence[TurnKey]) -> Float[Tensor, "frames 3"]:
    """Rotation vectors in a body's axes (left, up, forward)."""
    return blend_keys(frame_times(motion), _timings(keys), [(key.pitch, key.yaw, -key.roll) for key in keys], 3)


def _turned(motion: Motion, turns: Tensor, shares: dict[str, float], joints: Sequence[int]) -> Motion:
    """Each joint of `shares` turned by its share, in its parent's axes; `joints` move with them."""
    exact = motion.to("cpu", torch.float64)
    rotations = exact.rotations.clone()
    for name, share in shares.items():
        joint = JOINTS.index(name)
        rotations[:, joint] = axis_angle_to_matrix(share * turns) @ rotations[:, joint]
    skeleton = Skeleton.measured(exact.rotations, exact.joints)
    edited = Motion.posed(rotations, exact.translation, motion.fps, skeleton)
    return replace_frames(motion, edited, joints, turns.any(dim=1))


def _standing(
    motion: Motion,
    root: Float[Tensor, "frames 3 3"],
    pelvis: Float[Tensor, "frames 3"],
    ankles: Float[Tensor, "frames 2 3"],
) -> Motion:
    """The motion with another pelvis whose legs end in `ankles`, the feet turned as they were."""
    skeleton = Skeleton.measured(motion.rotations, motion.joints)
    world = global_rotations(motion.rotations, PARENTS)
    rotations = motion.rotations.clone()
    rotations[:, 0] = root
    for number, side in enumerate(SIDES):
        reach = ankles[:, number] - (pelvis + root @ skeleton.offsets[joint(side, "hip")])
        foot = world[:, joint(side, "ankle")]
        rotations[:, [joint(side, name) for name in LEG]] = bend_leg(side, world, motion.joints, reach, foot, root)
    return Motion.posed(rotations, pelvis, motion.fps, skeleton)
