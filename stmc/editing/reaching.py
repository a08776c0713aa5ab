"""Reaching: an arm of a motion follows a sequence of goals for its wrist, and the rest stays as it is.

Depends on shoulders, elbows and wrists; independent of trunk movement (see `posture`), feet and text.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import normalize

from stmc.editing.keys import Timing, check_order, frame_times, minimum_jerk, replace_frames
from stmc.motion.body import JOINTS, MIRROR, PARENTS
from stmc.motion.body_model import Skeleton
from stmc.motion.geometry import (
    axis_angle_to_matrix,
    global_rotations,
    matrix_to_axis_angle,
    mirror_rotations,
    shortest_arc,
)
from stmc.motion.inverse_kinematics import arm_rotations
from stmc.motion.motion import Motion

Triple = tuple[float | int, float | int, float | int]

_NEAREST, _FARTHEST = 0.3, 0.998
"""Least and greatest distance of a wrist from its shoulder, as fractions of the arm's length."""
_ELBOW = 0.1
"""Length in metres of a key's elbow direction, when it is blended with the offset of the recorded elbow."""
_TREMOR_HERTZ = 4.0
"""Mean frequency of a hand's tremor."""


@dataclass(frozen=True)
class Oscillation:
    """A small periodic movement about a goal, `hertz` times per second.

    `along` is its amplitude in metres, in the axes of the goal; with `across`, the path is an ellipse. The movement
    begins at arrival, always with the same phase, and reaches its full size within half a period.

    Examples:
        >>> clap = stmc.Oscillation(2.0, along=(0.05, 0, 0))
    """

    hertz: float | int
    along: Triple
    across: Triple = (0.0, 0.0, 0.0)

    def offsets(self, since: Float[Tensor, " frames"]) -> Float[Tensor, "frames 3"]:
        """Compute offsets in metres at times since the arrival.

        Examples:
            >>> stmc.Oscillation(2.0, along=(0.05, 0, 0)).offsets(torch.tensor([0.0, 1.125]))[:, 0]
            tensor([0.0000, 0.0500])
        """
        angle = 2 * torch.pi * self.hertz * since.clamp(min=0)
        size = minimum_jerk((2 * self.hertz * since).clamp(0, 1))
        sine, cosine = (size * torch.sin(angle))[:, None], (size * torch.cos(angle))[:, None]
        return sine * since.new_tensor(self.along) + cosine * since.new_tensor(self.across)


@dataclass(frozen=True)
class WristKey:
    """A goal of a wrist: it arrives at `time` (seconds) after `takes` seconds; see `Timing`.

    `goal` is in metres in the axes of `frame` (outwards to the arm's side, up, forward), so that the same numbers serve
    both arms; None leads the arm back to the motion. Frames are "chest" (origin midway between the shoulders, axes of
    the upper spine), "head" (its joint and axes), "shoulder" (its joint, level, in the pelvis' heading) and "ground"
    (between the toes on the floor at z = 0, in the pelvis' heading).

    `pole` is the direction from the arm to its elbow, in the axes of the chest. `roundness` shapes the path: 0 leads
    the wrist straight to its goal, 1 round the shoulder. `arc` is an offset in metres at the middle of the path, in the
    axes of the chest. `shrug` raises the collar bone, in radians. `oscillation` moves the wrist about the goal from the
    arrival on.

    Examples:
        >>> stmc.WristKey(1.2, 0.6, goal=(0.1, -0.2, 0.3)).timing
        Timing(time=1.2, takes=0.6, skew=1.0)
    """

    time: float | int
    takes: float | int
    goal: Triple | None = None
    frame: str = "chest"
    pole: Triple = (0.5, -1.0, -0.2)
    skew: float | int = 1.0
    roundness: float | int = 0.5
    arc: Triple = (0.0, 0.0, 0.0)
    shrug: float | int = 0.0
    oscillation: Oscillation | None = None

    @property
    def timing(self) -> Timing:
        """The timing of the movement."""
        return Timing(self.time, self.takes, self.skew)


def reach(
    motion: Motion, side: str, keys: Sequence[WristKey], tremor: float | int = 0.0, seed: int | None = None
) -> Motion:
    """Lead one arm through goals of its wrist, in order.

    Everything but the arm stays exactly the same, and so does the arm before the first key begins and after a last key
    without a `goal`. Goals move with the trunk, the head and the legs of each frame, so turn those first. A wrist gets
    as near as possible to a goal out of reach, and stays at least 0.3 arm lengths from its shoulder. The elbow bends
    towards each key's pole, and the hand keeps its rotation relative to the forearm.

    Args:
        motion: Motion to edit.
        side: "left" or "right".
        keys: Goals of the wrist, in the order of their times.
        tremor: Root mean square of the hand's tremor, in metres.
        seed: Seed of the tremor.

    Raises:
        ValueError: If keys are not in the order of their times, or if there is a tremor without a seed.

    Examples:
        >>> [motion] = stmc.load().generate("walk # 0 # 2", steps=1)
        >>> ear = stmc.WristKey(0.8, 0.6, (0.17, 0.02, 0.06), "head", pole=(0.6, -1, 0.3))
        >>> stmc.reach(motion, "left", [ear, stmc.WristKey(1.9, 0.6)])
        Motion(40 frames at 20 fps, 2.00 s)
    """
    _check_arguments(side, keys, tremor, seed)
    arm = _Arm.of(motion, side)
    seconds = frame_times(motion)
    path = _Path.of(arm)
    for key in keys:
        path = path.add_key(key, arm, seconds)
    wrist = path.wrist + (1 - path.recorded) * tremor * _draw_tremor(motion, seed if tremor else 0)
    edited = arm.pose(path.shrug, wrist, path.elbow, path.recorded)
    joints = [JOINTS.index(f"{side}_{name}") for name in ("collar", "shoulder", "elbow", "wrist", "hand")]
    return replace_frames(motion, edited, joints[0 if path.shrug.any() else 1 :], path.recorded[:, 0] < 1)


def copy_arm(motion: Motion, side: str) -> Motion:
    """Make the arm of one `side` the mirror image of the other arm: a waving hand then rests like the other one.

    Examples:
        >>> [motion] = stmc.load().generate("wave with the left hand # 0 # 1", steps=1)
        >>> stmc.copy_arm(motion, "left")
        Motion(20 frames at 20 fps, 1.00 s)
    """
    _check_side(side)
    joints = [JOINTS.index(f"{side}_{name}") for name in ("collar", "shoulder", "elbow", "wrist", "hand")]
    rotations = motion.rotations.clone()
    rotations[:, joints[:-1]] = mirror_rotations(motion.rotations, MIRROR[: rotations.shape[1]])[:, joints[:-1]]
    skeleton = Skeleton.measured(motion.rotations, motion.joints)
    edited = Motion.posed(rotations, motion.translation, motion.fps, skeleton)
    return replace_frames(motion, edited, joints, torch.ones(motion.frames, dtype=torch.bool))


def body_frame(motion: Motion, frame: str, side: str) -> tuple[Float[Tensor, "frames 3"], Float[Tensor, "frames 3 3"]]:
    """Return origin and axes of a coordinate frame for goals of wrists; see `WristKey`.

    Columns of the axes are outwards to the `side`, up and forward. The axes of the right side are left-handed: mirror
    images of the left side's.

    Args:
        motion: Motion of the body.
        frame: "chest", "head", "shoulder" or "ground".
        side: "left" or "right".

    Examples:
        >>> [motion] = stmc.load().generate("walk # 0 # 1", steps=1)
        >>> origin, axes = stmc.editing.body_frame(motion, "chest", "left")
        >>> wrist = motion.joints[:, stmc.motion.body.JOINTS.index("left_wrist")]
        >>> ((wrist - origin)[:, None] @ axes).shape
        torch.Size([20, 1, 3])
    """
    _check_side(side)
    joint = {name: motion.joints[:, JOINTS.index(name)] for name in JOINTS}
    outwards = motion.joints.new_tensor([1.0 if side == "left" else -1.0, 1.0, 1.0])
    if frame in ("chest", "head"):
        world = global_rotations(motion.rotations, PARENTS)
        axes = world[:, JOINTS.index("spine3" if frame == "chest" else "head")] * outwards
        return (joint["left_shoulder"] + joint["right_shoulder"]) / 2 if frame == "chest" else joint["head"], axes
    if frame not in ("shoulder", "ground"):
        raise ValueError(f"frame={frame!r}: choose from chest, head, shoulder, ground")
    up = torch.zeros_like(motion.facing)
    up[:, 2] = 1
    axes = torch.stack([torch.linalg.cross(up, motion.facing), up, motion.facing], dim=-1) * outwards
    toes = (joint["left_foot"] + joint["right_foot"]) / 2 * (1 - up)
    return joint[f"{side}_shoulder"] if frame == "shoulder" else toes, axes


@dataclass(frozen=True)
class _Arm:
    """One arm of a motion (float64, CPU), with the frames of its goals."""

    motion: Motion
    side: str
    skeleton: Skeleton
    world: Float[Tensor, "frames 24 3 3"]

    @classmethod
    def of(cls, motion: Motion, side: str) -> _Arm:
        exact = motion.to("cpu", torch.float64)
        skeleton = Skeleton.measured(exact.rotations, exact.joints)
        return cls(exact, side, skeleton, global_rotations(exact.rotations, PARENTS))

    def at(self, name: str) -> Float[Tensor, "frames 3"]:
        return self.motion.joints[:, JOINTS.index(f"{self.side}_{name}")]

    @property
    def chest(self) -> Float[Tensor, "frames 3 3"]:
        return body_frame(self.motion, "chest", self.side)[1]

    def shoulder(self, shrug: Float[Tensor, "frames 1"]) -> Float[Tensor, "frames 3"]:
        """Compute the position of the shoulder with a raised collar bone."""
        world = self.world[:, JOINTS.index("spine3")]
        bone = self.at("shoulder") - self.at("collar")
        lifted = world @ self._raise(shrug) @ world.mT @ bone[..., None]
        return self.at("collar") + torch.where(shrug == 0, bone, lifted[..., 0])

    def _raise(self, shrug: Float[Tensor, "frames 1"]) -> Float[Tensor, "frames 3 3"]:
        forward = shrug.new_tensor([0.0, 0.0, 1.0 if self.side == "left" else -1.0])
        return axis_angle_to_matrix(shrug * forward)

    def pose(self, shrug: Tensor, wrist: Tensor, elbow: Tensor, recorded: Tensor) -> Motion:
        """Pose the arm with its wrist as near as possible to `wrist`; bones keep a fraction `recorded` of their twist.

        `elbow` is the offset of the elbow from the line between shoulder and wrist, in metres in the world.
        """
        names = [f"{self.side}_{name}" for name in ("collar", "shoulder", "elbow", "wrist")]
        indices = [JOINTS.index(name) for name in names]
        joints, before = self.motion.joints.clone(), self.motion.joints
        shoulder = self.shoulder(shrug)
        joints[:, indices[1]] = shoulder
        joints[:, indices[2]], joints[:, indices[3]] = self._solve(shoulder, wrist, elbow)
        rotations = self.motion.rotations.clone()
        rotations[:, indices[0]] = self._raise(shrug) @ rotations[:, indices[0]]
        collar = self.world[:, JOINTS.index("spine3")] @ rotations[:, indices[0]]
        new, old = (arm_rotations(points, self.side, self.world[:, 9], self.skeleton) for points in (joints, before))
        world = self.world[:, indices[1:3]]
        twist = matrix_to_axis_angle(old.mT @ world)
        turned = new @ axis_angle_to_matrix(recorded[:, None] * twist)
        rotations[:, indices[1]] = collar.mT @ turned[:, 0]
        rotations[:, indices[2]] = turned[:, 0].mT @ turned[:, 1]
        return Motion.posed(rotations, self.motion.translation, self.motion.fps, self.skeleton)

    def _solve(self, shoulder: Tensor, wrist: Tensor, elbow: Tensor) -> tuple[Tensor, Tensor]:
        """Compute elbow and wrist by the law of cosines."""
        upper = (self.at("elbow") - self.at("shoulder")).norm(dim=-1, keepdim=True)
        fore = (self.at("wrist") - self.at("elbow")).norm(dim=-1, keepdim=True)
        recorded = (self.at("wrist") - self.at("shoulder")).norm(dim=-1, keepdim=True)
        length = upper + fore
        nearest, farthest = torch.minimum(_NEAREST * length, recorded), torch.maximum(_FARTHEST * length, recorded)
        along = normalize(wrist - shoulder, dim=-1)
        distance = (wrist - shoulder).norm(dim=-1, keepdim=True).clamp(nearest, farthest)
        aside = normalize(elbow - (elbow * along).sum(dim=-1, keepdim=True) * along, dim=-1)
        onward = (upper**2 - fore**2 + distance**2) / (2 * distance)
        height = (upper**2 - onward**2).clamp(min=0).sqrt()
        return shoulder + onward * along + height * aside, shoulder + distance * along


@dataclass(frozen=True)
class _Path:
    """Target positions of a wrist and its elbow, after some of the keys."""

    wrist: Float[Tensor, "frames 3"]
    elbow: Float[Tensor, "frames 3"]
    """Offset from the line between shoulder and wrist, in metres in the world."""
    shrug: Float[Tensor, "frames 1"]
    recorded: Float[Tensor, "frames 1"]
    """Weight of the recorded pose: exactly 1 where nothing changes."""

    @classmethod
    def of(cls, arm: _Arm) -> _Path:
        """Return the recorded path of an arm."""
        one = torch.ones(arm.motion.frames, 1, dtype=torch.float64)
        return cls(arm.at("wrist"), _elbow_offset(arm), torch.zeros_like(one), one)

    def add_key(self, key: WristKey, arm: _Arm, seconds: Float[Tensor, " frames"]) -> _Path:
        """Return the path with one more key."""
        fraction = key.timing.progress(seconds)[:, None]
        shrug = torch.lerp(self.shrug, torch.full_like(self.shrug, 0.0 if key.goal is None else key.shrug), fraction)
        back = torch.full_like(self.recorded, float(key.goal is None))
        goal, elbow = self._goal(key, arm, seconds)
        shoulder = arm.shoulder(shrug)
        wrist = _interpolate(shoulder, self.wrist, goal, fraction, key.roundness)
        bulge = 16 * (fraction * (1 - fraction)) ** 2 * (arm.chest @ seconds.new_tensor(key.arc))
        return _Path(
            wrist + bulge,
            torch.lerp(self.elbow, elbow, fraction),
            shrug,
            self.recorded * (1 - fraction) + back * fraction,
        )

    def _goal(self, key: WristKey, arm: _Arm, seconds: Tensor) -> tuple[Tensor, Tensor]:
        """Return the key's position of the wrist and offset of the elbow, in the world."""
        if key.goal is None:
            return arm.at("wrist"), _elbow_offset(arm)
        origin, axes = body_frame(arm.motion, key.frame, arm.side)
        goal = seconds.new_tensor(key.goal).expand(len(seconds), 3)
        if key.oscillation:
            goal = goal + key.oscillation.offsets(seconds - key.time)
        pole = normalize(seconds.new_tensor(key.pole), dim=-1)
        return origin + (axes @ goal[..., None])[..., 0], _ELBOW * (arm.chest @ pole)


def _elbow_offset(arm: _Arm) -> Float[Tensor, "frames 3"]:
    """Compute the offset of the recorded elbow from the line between shoulder and wrist."""
    along = normalize(arm.at("wrist") - arm.at("shoulder"), dim=-1)
    upper = arm.at("elbow") - arm.at("shoulder")
    return upper - (upper * along).sum(dim=-1, keepdim=True) * along


def _interpolate(shoulder: Tensor, start: Tensor, end: Tensor, fraction: Tensor, roundness: float | int) -> Tensor:
    """Interpolate from `start` to `end`, partly straight, partly round the shoulder."""
    first, last = start - shoulder, end - shoulder
    arc = matrix_to_axis_angle(shortest_arc(normalize(first, dim=-1), normalize(last, dim=-1)))
    direction = axis_angle_to_matrix(fraction * arc) @ normalize(first, dim=-1)[..., None]
    distance = torch.lerp(first.norm(dim=-1, keepdim=True), last.norm(dim=-1, keepdim=True), fraction)
    offset = torch.lerp(torch.lerp(first, last, fraction), direction[..., 0] * distance, roundness)
    offset = torch.where(fraction == 0, first, torch.where(fraction == 1, last, offset))
    return shoulder + offset


def _draw_tremor(motion: Motion, seed: int | None) -> Float[Tensor, "frames 3"]:
    """Draw noise about one frequency, with root mean square 1."""
    generator = torch.Generator().manual_seed(seed or 0)
    noise = torch.randn(motion.frames, 3, generator=generator, dtype=torch.float64)
    hertz = torch.fft.rfftfreq(motion.frames, 1 / motion.fps).double()
    band = torch.exp(-(((hertz - _TREMOR_HERTZ) / 1.5) ** 2))[:, None]
    noise = torch.fft.irfft(torch.fft.rfft(noise, dim=0) * band, n=motion.frames, dim=0)
    return noise / noise.square().mean().sqrt().clamp(min=1e-12)


def _check_side(side: str) -> None:
    if side not in ("left", "right"):
        raise ValueError(f"side={side!r}: choose left or right")


def _check_arguments(side: str, keys: Sequence[WristKey], tremor: float | int, seed: int | None) -> None:
    _check_side(side)
    check_order(keys)
    if tremor and seed is None:
        raise ValueError(f"tremor={tremor}: a random tremor needs a seed")
