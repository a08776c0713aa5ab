"""Key-driven movement of trunk, head, pelvis and feet, added to the recorded motion.

Depends on the spine and the legs; independent of arms (see `reaching`) and text.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from stmc.editing.keys import Timing, blend_keys, check_order, frame_times, replace_frames
from stmc.editing.leg_posing import SIDES, joint, select_legs
from stmc.editing.reaching import Triple, body_frame
from stmc.motion.body import JOINTS, PARENTS
from stmc.motion.body_model import Skeleton
from stmc.motion.feet.leg_bending import LEG, bend_leg
from stmc.motion.geometry import axis_angle_to_matrix, global_rotations
from stmc.motion.motion import Motion

_NECK, _SPINE = ("neck", "head"), ("spine1", "spine2", "spine3")
_LOWER = (0, 1, 2, 4, 5, 7, 8, 10, 11)
"""Joints of the pelvis and the legs."""


@dataclass(frozen=True)
class TurnKey:
    """A turn of the head or the trunk, added to the motion: it arrives at `time` (seconds) after `takes` seconds.

    Angles are in radians about the axes of the part below: `yaw` to the left, `pitch` forward and down, `roll` leaning
    to the left. Zeros lead back to the motion. `skew` as in `Timing`.

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
    """A shift of the pelvis, added to the motion: it arrives at `time` (seconds) after `takes` seconds.

    `offset` is in metres (left, up, forward) in the pelvis' heading; angles are in radians, as in `TurnKey`.

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
    """A step of a foot, added to the motion: it arrives at `time` (seconds) after `takes` seconds.

    `offset` is in metres (left, up, forward) in the pelvis' heading, from the foot's position in the motion; half way
    there, the foot is lifted by `lift` metres.

    Examples:
        >>> ahead = stmc.FootKey(1.0, 0.5, offset=(0, 0, 0.25))
    """

    time: float | int
    takes: float | int
    offset: Triple = (0.0, 0.0, 0.0)
    lift: float | int = 0.06
    skew: float | int = 1.0


def turn_head(motion: Motion, keys: Sequence[TurnKey]) -> Motion:
    """Turn, nod or tilt the head, half in the neck and half above it. Everything else stays as it is.

    Examples:
        >>> [motion] = stmc.load().generate("walk # 0 # 2", steps=1)
        >>> look = stmc.TurnKey(0.8, 0.6, yaw=0.9)
        >>> stmc.turn_head(motion, [look, stmc.TurnKey(1.8, 0.6)])
        Motion(40 frames at 20 fps, 2.00 s)
    """
    turns = _turns(motion, keys)
    return _turn_joints(motion, turns, dict.fromkeys(_NECK, 0.5), [JOINTS.index(name) for name in _NECK])


def turn_trunk(motion: Motion, keys: Sequence[TurnKey], gaze: float | int = 0.0) -> Motion:
    """Twist, bend or lean the trunk, a third in each joint of the spine.

    Pelvis and legs stay; the head and the arms move with the trunk.

    Args:
        motion: Motion to edit.
        keys: Turns of the trunk, in the order of their times.
        gaze: Fraction of the turn that the neck takes back; with 1, the head keeps its direction.

    Examples:
        >>> [motion] = stmc.load().generate("walk # 0 # 2", steps=1)
        >>> stmc.turn_trunk(motion, [stmc.TurnKey(1.0, 0.8, yaw=0.4)], gaze=1)
        Motion(40 frames at 20 fps, 2.00 s)
    """
    turns = _turns(motion, keys)
    fractions = dict.fromkeys(_SPINE, 1 / 3) | {"neck": -float(gaze)}
    return _turn_joints(motion, turns, fractions, [joint for joint in range(len(JOINTS)) if joint not in _LOWER])


def shift_pelvis(motion: Motion, keys: Sequence[PelvisKey]) -> Motion:
    """Move and turn the pelvis while the feet stay in place: shift the weight, turn the hips or duck.

    The legs bend in closed form, and the trunk moves with the pelvis. A foot that gets out of reach stays as near as
    possible.

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
    ankles = select_legs(exact.joints, "ankle")
    edited = _pose_legs(exact, root, pelvis, ankles)
    return replace_frames(motion, edited, range(len(JOINTS)), values.any(dim=1), path=True)


def step(motion: Motion, side: str, keys: Sequence[FootKey]) -> Motion:
    """Move one foot, lifted on the way; the leg follows in closed form, and the rest stays.

    Args:
        motion: Motion to edit.
        side: "left" or "right".
        keys: Steps of the foot, in the order of their times.

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
    ankles = select_legs(exact.joints, "ankle")
    ankles[:, SIDES.index(side)] += (axes @ offsets[..., None])[..., 0]
    edited = _pose_legs(exact, exact.rotations[:, 0], exact.translation, ankles)
    joints = [joint(side, name) for name in (*LEG, "foot")]
    return replace_frames(motion, edited, joints, offsets.any(dim=1))


def bend_down(
    motion: Motion, time: float | int, takes: float | int, stay: float | int = 0.3, depth: float | int = 0.3
) -> Motion:
    """Bend the body down and up again: the pelvis moves down and back, the trunk bends forward, and the feet stay.

    Call `reach` afterwards, so that goals of the hand follow the trunk.

    Args:
        motion: Motion to edit.
        time: Time at which the body is down, in seconds.
        takes: Seconds to bend down, and to come up again.
        stay: Seconds in between.
        depth: Metres by which the pelvis is lowered.

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
    """Compute rotation vectors in a body's axes (left, up, forward)."""
    return blend_keys(frame_times(motion), _timings(keys), [(key.pitch, key.yaw, -key.roll) for key in keys], 3)


def _turn_joints(motion: Motion, turns: Tensor, fractions: dict[str, float], joints: Sequence[int]) -> Motion:
    """Turn joints by fractions of `turns`, in the axes of their parents; `joints` move with them."""
    exact = motion.to("cpu", torch.float64)
    rotations = exact.rotations.clone()
    for name, fraction in fractions.items():
        joint = JOINTS.index(name)
        rotations[:, joint] = axis_angle_to_matrix(fraction * turns) @ rotations[:, joint]
    skeleton = Skeleton.measured(exact.rotations, exact.joints)
    edited = Motion.posed(rotations, exact.translation, motion.fps, skeleton)
    return replace_frames(motion, edited, joints, turns.any(dim=1))


def _pose_legs(
    motion: Motion,
    root: Float[Tensor, "frames 3 3"],
    pelvis: Float[Tensor, "frames 3"],
    ankles: Float[Tensor, "frames 2 3"],
) -> Motion:
    """Replace the pelvis of a motion, and bend the legs to end in `ankles`, with the directions of the feet kept."""
    skeleton = Skeleton.measured(motion.rotations, motion.joints)
    world = global_rotations(motion.rotations, PARENTS)
    rotations = motion.rotations.clone()
    rotations[:, 0] = root
    for number, side in enumerate(SIDES):
        offset = ankles[:, number] - (pelvis + root @ skeleton.offsets[joint(side, "hip")])
        foot = world[:, joint(side, "ankle")]
        rotations[:, [joint(side, name) for name in LEG]] = bend_leg(side, world, motion.joints, offset, foot, root)
    return Motion.posed(rotations, pelvis, motion.fps, skeleton)
