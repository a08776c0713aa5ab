"""A moving person: the rotations, root and joints of a body over time.

Uses SMPL's joint order and the world's axes (metres, radians, z up). Independent of body proportions (see `body_model`)
and feature vectors (see `representation`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from stmc.io.bounds import check_fps, check_frames
from stmc.motion.body import JOINTS, MIRROR, NUM_ROTATIONS, PARENTS
from stmc.motion.geometry import (
    forward_kinematics,
    heading,
    local_bones,
    mirror_positions,
    mirror_rotations,
    resample_positions,
    resample_rotations,
    rotation_z,
)


@runtime_checkable
class Posable(Protocol):
    """An object that converts local rotations and pelvis positions to joint positions, as `Skeleton` does."""

    def pose(
        self, rotations: Float[Tensor, "*batch 22 3 3"], translation: Float[Tensor, "*batch 3"]
    ) -> Float[Tensor, "*batch 24 3"]: ...


@dataclass(frozen=True, eq=False)
class Motion:
    """A body moving through a z-up world, frame by frame. All three tensors share dtype and device.

    Args:
        rotations: Local rotations of SMPL's first 22 joints, relative to the parent joint, [frames, 22, 3, 3]. The
            root's rotation, which contains the heading, rotates SMPL's rest pose (x left, y up, z forward) into the
            world.
        translation: Positions of the pelvis in metres, [frames, 3]. SMPL's own translation is this minus the pelvis of
            the rest pose (`Skeleton.smpl_translation`).
        joints: Positions of all 24 joints in metres, in the order of `body.JOINTS`, [frames, 24, 3].
        fps: Frames per second.
        overlap: Duration in seconds of the transitions between the prompts of a sampled motion; None if there are none.

    Raises:
        ValueError: If a shape is wrong, there are no frames, a value is not finite, a matrix is not a rotation, or the
            frames, seconds or frame rate exceed `bounds`.

    Examples:
        >>> [motion] = stmc.load().generate("walk # 0 # 1", steps=1)
        >>> motion
        Motion(20 frames at 20 fps, 1.00 s)
        >>> motion.rotations.shape, motion.translation.shape, motion.joints.shape
        (torch.Size([20, 22, 3, 3]), torch.Size([20, 3]), torch.Size([20, 24, 3]))
    """

    rotations: Float[Tensor, "frames 22 3 3"]
    """Local rotations of SMPL's first 22 joints."""
    translation: Float[Tensor, "frames 3"]
    """Pelvis positions in metres."""
    joints: Float[Tensor, "frames 24 3"]
    """Positions of all 24 joints in metres, in the order of `body.JOINTS`."""
    fps: float | int
    """Frames per second."""
    overlap: float | int | None = None
    """Seconds of the transitions between the prompts of a sampled motion; None if there are none."""

    def __post_init__(self) -> None:
        _check(self.rotations, self.translation, self.joints, self.fps)

    @classmethod
    def posed(
        cls,
        rotations: Float[Tensor, "frames 22 3 3"],
        translation: Float[Tensor, "frames 3"],
        fps: float | int,
        skeleton: Posable,
    ) -> Motion:
        """Pose `skeleton` with local rotations and pelvis positions.

        Args:
            rotations: Local rotations, [frames, 22, 3, 3].
            translation: Pelvis positions in metres, [frames, 3].
            fps: Frames per second.
            skeleton: Skeleton to pose.

        Examples:
            >>> rotations, translation = torch.eye(3).repeat(20, 22, 1, 1), torch.zeros(20, 3)
            >>> stmc.Motion.posed(rotations, translation, fps=20, skeleton=stmc.Skeleton.default())
            Motion(20 frames at 20 fps, 1.00 s)
        """
        return cls(rotations, translation, skeleton.pose(rotations, translation), fps)

    def __repr__(self) -> str:
        return f"Motion({self.frames} frames at {self.fps:g} fps, {self.duration:.2f} s)"

    def _repr_html_(self) -> str:
        """Draw up to eight moments as stick figures for notebooks. `stmc.view` shows the moving body."""
        return f"<div>{self}</div>{_film_strip(self.joints.double().cpu(), self.facing[0].double().cpu(), self.fps)}"

    def __len__(self) -> int:
        return self.frames

    @property
    def frames(self) -> int:
        """Number of frames, at least one."""
        return len(self.translation)

    @property
    def duration(self) -> float:
        """Duration in seconds: frames divided by frame rate."""
        return self.frames / self.fps

    @property
    def heading(self) -> Float[Tensor, " frames"]:
        """Angle about the up axis in radians, counter-clockwise seen from above, within [-pi, pi]; 0 faces -y."""
        return heading(self.rotations[:, 0])

    @property
    def facing(self) -> Float[Tensor, "frames 3"]:
        """Horizontal unit vectors in the direction that the pelvis faces: -y rotated by the heading."""
        angle = self.heading
        return torch.stack([torch.sin(angle), -torch.cos(angle), torch.zeros_like(angle)], dim=-1)

    def mirrored(self) -> Motion:
        """Mirror the motion in the plane x = 0, which swaps left and right. Mirroring twice restores the motion.

        Examples:
            >>> [motion] = stmc.load().generate("walk # 0 # 1", steps=1)
            >>> torch.equal(motion.mirrored().translation[:, 0], -motion.translation[:, 0])
            True
        """
        return Motion(
            mirror_rotations(self.rotations, MIRROR[:NUM_ROTATIONS]),
            self.translation * self.translation.new_tensor([-1.0, 1.0, 1.0]),
            mirror_positions(self.joints, MIRROR),
            self.fps,
            self.overlap,
        )

    def resampled(self, fps: float | int) -> Motion:
        """Resample the motion to another frame rate.

        Rotations are interpolated on the sphere and the pelvis linearly. Bones are interpolated in their parents'
        frames, so that they keep their lengths. At its own frame rate the result is the motion itself. Raises
        `ValueError` if no frame remains, or more frames than `bounds` allows.

        Examples:
            >>> [motion] = stmc.load().generate("walk # 0 # 1", steps=1)
            >>> motion.resampled(fps=30)
            Motion(30 frames at 30 fps, 1.00 s)
        """
        check_fps(fps)
        if fps == self.fps:
            return self
        check_frames(self.frames * fps / self.fps, fps)
        rotations = resample_rotations(self.rotations, self.fps, fps)
        pelvis = resample_positions(self.joints[:, 0], self.fps, fps)
        bones = resample_positions(local_bones(self.rotations, self.joints, PARENTS), self.fps, fps)
        return Motion(
            rotations,
            resample_positions(self.translation, self.fps, fps),
            pelvis[:, None] + forward_kinematics(rotations, bones, PARENTS),
            fps,
            self.overlap,
        )

    def trimmed(self, start: int, end: int) -> Motion:
        """Return frames `[start, end)`, unmoved in the world. Raises `ValueError` unless `0 <= start < end <= frames`.

        Examples:
            >>> [motion] = stmc.load().generate("walk # 0 # 1", steps=1)
            >>> motion.trimmed(5, 15)
            Motion(10 frames at 20 fps, 0.50 s)
        """
        if not 0 <= start < end <= self.frames:
            raise ValueError(
                f"cannot trim {self.frames} frames to [{start}, {end}); choose 0 <= start < end <= {self.frames}"
            )
        values = (self.rotations, self.translation, self.joints)
        rotations, translation, joints = (value[start:end] for value in values)
        return Motion(rotations, translation, joints, self.fps, self.overlap)

    def to(self, device: torch.device | str | None = None, dtype: torch.dtype | None = None) -> Motion:
        """Return the motion on another device or in another floating-point dtype.

        Examples:
            >>> [motion] = stmc.load().generate("walk # 0 # 1", steps=1)
            >>> motion.to(dtype=torch.float64).joints.dtype
            torch.float64
        """
        values = (self.rotations, self.translation, self.joints)
        rotations, translation, joints = (value.to(device=device, dtype=dtype) for value in values)
        return Motion(rotations, translation, joints, self.fps, self.overlap)


def _check(rotations: Tensor, translation: Tensor, joints: Tensor, fps: float | int) -> None:
    frames = len(translation)
    if frames == 0:
        raise ValueError("a motion needs at least one frame")
    check_frames(frames, fps)
    expected = {
        "rotations": (rotations, (frames, NUM_ROTATIONS, 3, 3)),
        "translation": (translation, (frames, 3)),
        "joints": (joints, (frames, len(JOINTS), 3)),
    }
    for name, (value, shape) in expected.items():
        if tuple(value.shape) != shape:
            raise ValueError(f"{name} must have shape {shape}, not {tuple(value.shape)}")
        if value.dtype != joints.dtype or value.device != joints.device or not value.is_floating_point():
            raise ValueError(f"{name} is {value.dtype} on {value.device}, joints are {joints.dtype} on {joints.device}")
        chunks = (torch.isfinite(chunk).flatten(start_dim=1).all(dim=1) for chunk in value.split(_FRAMES_AT_ONCE))
        invalid = ~torch.cat(list(chunks))
        if invalid.any():
            raise ValueError(f"{name} has values that are not finite, first in frame {int(invalid.nonzero()[0])}")
    _check_rotations(rotations)


_FRAMES_AT_ONCE = 2**14


def _check_rotations(rotations: Tensor) -> None:
    invalid = torch.cat([_is_no_rotation(frames) for frames in rotations.split(_FRAMES_AT_ONCE)])
    if invalid.any():
        frame, joint = (int(index) for index in invalid.nonzero()[0])
        raise ValueError(f"rotations[{frame}, {joint}] ({JOINTS[joint]}) is not a rotation matrix")


def _is_no_rotation(rotations: Float[Tensor, "frames 22 3 3"]) -> Bool[Tensor, "frames 22"]:
    excess = (rotations @ rotations.mT - torch.eye(3, dtype=rotations.dtype, device=rotations.device)).abs()
    return (excess.amax(dim=(-2, -1)) > 1e-2) | (torch.linalg.det(rotations) < 0)


_PIXELS = 100
"""Scale of a film strip: pixels per metre, and between neighbouring figures."""
_COLOURS = {"left": "#ea580c", "midline": "#555", "right": "#2563eb"}


def _film_strip(joints: Float[Tensor, "frames 24 3"], facing: Float[Tensor, " 3"], fps: float | int) -> str:
    """Draw stick figures as SVG, side by side on one floor, seen from 40 degrees to the right of `facing`."""
    moments = torch.linspace(0, len(joints) - 1, min(8, len(joints))).round().long().tolist()
    across = (joints - joints[:, :1]) @ (rotation_z(torch.tensor(math.radians(50.0)).to(facing)) @ facing)
    height = joints[..., 2] - joints[..., 2].min()
    width, floor = _PIXELS * len(moments), _PIXELS * float(height.max()) + 10
    figures = []
    for index, frame in enumerate(moments):
        x, y = _PIXELS * (across[frame] + index + 0.5), floor - _PIXELS * height[frame]
        for side, colour in _COLOURS.items():
            path = "".join(
                f"M{x[parent]:.1f} {y[parent]:.1f}L{x[joint]:.1f} {y[joint]:.1f}"
                for joint, parent in enumerate(PARENTS)
                if joint and (JOINTS[joint].partition("_")[0] if "_" in JOINTS[joint] else "midline") == side
            )
            figures.append(f'<path d="{path}" stroke="{colour}"/>')
        figures.append(f'<text x="{x[0]:.1f}" y="{floor + 16:.1f}" fill="#333">{frame / fps:.1f} s</text>')
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{width}" height="{floor + 24:.0f}" style="background:#fff" '
        'fill="none" stroke-width="4" stroke-linecap="round" font-size="11" text-anchor="middle">'
        f'<path d="M0 {floor:.1f}H{width}" stroke="#ccc" stroke-width="1"/>{"".join(figures)}</svg>'
    )
