"""Rotations, kinematic trees and resampling that RoMa does not offer, in the conventions of SMPL motions.

Rotations are matrices `[*batch, 3, 3]` that act on column vectors; angles are radians; z is up. Functions preserve the
dtype and device of their arguments and broadcast over leading axes. Joints have no names here: trees and left-right
permutations are arguments.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from einops import einsum, rearrange
from jaxtyping import Float, Int64
from torch import Tensor


def axis_angle_to_matrix(axis_angle: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3 3"]:
    """Convert axis-angle vectors (SMPL's poses) of any length, including zero, to rotation matrices."""
    import roma  # imported late: it takes as long to import as torch

    return roma.rotvec_to_rotmat(axis_angle)


def matrix_to_axis_angle(matrix: Float[Tensor, "*batch 3 3"]) -> Float[Tensor, "*batch 3"]:
    """Convert to axis-angle vectors of length at most pi. At exactly pi the result is either of the two axes."""
    import roma  # imported late: it takes as long to import as torch

    return roma.rotmat_to_rotvec(matrix)


def quaternion_to_matrix(quaternion: Float[Tensor, "*batch 4"]) -> Float[Tensor, "*batch 3 3"]:
    """Convert unit quaternions, real part first, to rotation matrices."""
    import roma  # imported late: it takes as long to import as torch

    return roma.unitquat_to_rotmat(roma.quat_wxyz_to_xyzw(quaternion))


def matrix_to_quaternion(matrix: Float[Tensor, "*batch 3 3"]) -> Float[Tensor, "*batch 4"]:
    """Convert to unit quaternions with a non-negative real part, which comes first."""
    import roma  # imported late: it takes as long to import as torch

    quaternion = roma.quat_xyzw_to_wxyz(roma.rotmat_to_unitquat(matrix))
    return torch.where(quaternion[..., :1] < 0, -quaternion, quaternion)


def heading(matrix: Float[Tensor, "*batch 3 3"]) -> Float[Tensor, "*batch"]:
    """Return the z angle of `matrix` written as `Rz Ry Rx`: the direction of its x axis, seen from above.

    For SMPL's root in a z-up world: 0 faces -y (the left hip towards +x), pi/2 faces +x.
    """
    return torch.atan2(matrix[..., 1, 0], matrix[..., 0, 0])


def rotation_z(angle: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch 3 3"]:
    """Build rotations about the up axis, counter-clockwise seen from above."""
    cos, sin, zero, one = torch.cos(angle), torch.sin(angle), torch.zeros_like(angle), torch.ones_like(angle)
    return rearrange(
        torch.stack([cos, -sin, zero, sin, cos, zero, zero, zero, one], dim=-1), "... (row column) -> ... row column",
        row=3,
    )  # fmt: skip


def wrap(angle: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
    """Wrap angles to [-pi, pi]."""
    return torch.atan2(torch.sin(angle), torch.cos(angle))


def matrix_to_rows(matrix: Float[Tensor, "*batch 3 3"]) -> Float[Tensor, "*batch 6"]:
    """Convert to the continuous 6D representation (Zhou et al. 2019): the first two rows, concatenated."""
    return rearrange(matrix[..., :2, :], "... row column -> ... (row column)")


def rows_to_matrix(rows: Float[Tensor, "*batch 6"]) -> Float[Tensor, "*batch 3 3"]:
    """Orthonormalise two rows (Gram-Schmidt): invert `matrix_to_rows`, with a rotation for any finite input.

    If a row is zero or the rows are parallel, an axis of the world replaces the missing direction.
    """
    first, second = rearrange(rows, "... (row column) -> row ... column", row=2)
    x = _unit(first, torch.eye(3, dtype=rows.dtype, device=rows.device)[0].expand_as(first))
    least = torch.nn.functional.one_hot(x.abs().argmin(dim=-1), 3).to(rows.dtype)
    spare = _unit(_reject(least, x), least)
    y = _unit(_reject(_unit(second, torch.zeros_like(second)), x), spare)
    return torch.stack([x, y, torch.linalg.cross(x, y)], dim=-2)


def orthonormal_rows(rows: Float[Tensor, "*batch columns"]) -> Float[Tensor, "*batch columns"]:
    """Orthonormalise concatenated 6D rotations, six numbers each, for example after blending."""
    rotations = rearrange(rows, "... (rotation six) -> ... rotation six", six=6)
    return rearrange(matrix_to_rows(rows_to_matrix(rotations)), "... rotation six -> ... (rotation six)")


def _reject(vector: Tensor, unit: Tensor) -> Tensor:
    return vector - (vector * unit).sum(dim=-1, keepdim=True) * unit


def _unit(vector: Tensor, otherwise: Tensor) -> Tensor:
    """Scale `vector` to length one, or return `otherwise` if its length is zero up to rounding."""
    norm = torch.linalg.vector_norm(vector, dim=-1, keepdim=True)
    empty = norm <= 16 * torch.finfo(vector.dtype).eps
    return torch.where(empty, otherwise, vector / torch.where(empty, torch.ones_like(norm), norm))


def shortest_arc(start: Float[Tensor, "*batch 3"], end: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3 3"]:
    """Return the smallest rotation from the unit vector `start` to the unit vector `end`.

    For opposite vectors it is a half turn about some perpendicular axis.
    """
    least = torch.nn.functional.one_hot(start.abs().argmin(dim=-1), 3).to(start.dtype)
    middle = _unit(start + end, _unit(_reject(least, start), least))
    return _half_turn(middle) @ _half_turn(start)


def _half_turn(unit: Tensor) -> Tensor:
    """Rotate by a half turn about `unit`; two half turns rotate by twice the angle between their axes."""
    return 2 * unit[..., :, None] * unit[..., None, :] - torch.eye(3, dtype=unit.dtype, device=unit.device)


def global_rotations(
    rotations: Float[Tensor, "*batch joints 3 3"], parents: Sequence[int]
) -> Float[Tensor, "*batch _ 3 3"]:
    """Compute rotations from each joint's frame to the world, for all joints of `parents` (parents before children).

    `rotations` are relative to the parent. Joints beyond their count have no rotation and follow their parent.
    """
    world: list[Tensor] = []
    for joint, parent in enumerate(parents):
        if joint >= rotations.shape[-3]:
            world.append(world[parent])
            continue
        local = rotations[..., joint, :, :]
        world.append(local if parent < 0 else world[parent] @ local)
    return torch.stack(world, dim=-3)


def forward_kinematics(
    rotations: Float[Tensor, "*batch joints 3 3"], offsets: Float[Tensor, "*frames _ 3"], parents: Sequence[int]
) -> Float[Tensor, "*batch _ 3"]:
    """Compute joint positions relative to the root, in the world's axes.

    Args:
        rotations: Local rotations, [*batch, joints, 3, 3].
        offsets: Rest position of each joint relative to its parent, in the parent's frame, constant or per frame; the
            row of the root is not used.
        parents: Index of each joint's parent.
    """
    turns = global_rotations(rotations, parents)[..., list(parents[1:]), :, :]
    bones = einsum(turns, offsets[..., 1:, :], "... joints row column, ... joints column -> ... joints row")
    positions = [torch.zeros_like(bones[..., 0, :])]
    for joint, parent in enumerate(parents[1:]):
        positions.append(positions[parent] + bones[..., joint, :])
    return torch.stack(positions, dim=-2)


def local_bones(
    rotations: Float[Tensor, "*batch joints 3 3"], positions: Float[Tensor, "*batch all 3"], parents: Sequence[int]
) -> Float[Tensor, "*batch all 3"]:
    """Compute the bone from each joint's parent to the joint, in the parent's frame; zero for the root.

    With these offsets `forward_kinematics` reproduces `positions` relative to the root.

    Args:
        rotations: Local rotations, [*batch, joints, 3, 3].
        positions: Joint positions, [*batch, all, 3].
        parents: Index of each joint's parent.
    """
    bones = positions[..., 1:, :] - positions[..., list(parents[1:]), :]
    turns = global_rotations(rotations, parents)[..., list(parents[1:]), :, :]
    local = einsum(turns, bones, "... joints row column, ... joints row -> ... joints column")
    return torch.cat([torch.zeros_like(positions[..., :1, :]), local], dim=-2)


def sampling_positions(frames: int, old_fps: float | int, new_fps: float | int) -> Float[Tensor, " frames"]:
    """Return the positions of `floor(frames * new_fps / old_fps)` new frames among the old frames (float64, CPU).

    As in the published preparation of AMASS, frame i is at `(i + 0.5) * old_fps / new_fps - 0.5`, clamped to [0, frames
    - 1], so that both rates cover the same time.

    Args:
        frames: Number of old frames.
        old_fps: Old frame rate.
        new_fps: New frame rate.

    Raises:
        ValueError: If not even one new frame fits.
    """
    count = math.floor(frames * new_fps / old_fps)
    if count < 1:
        raise ValueError(f"{frames} frames at {old_fps:g} fps are too short for one frame at {new_fps:g} fps")
    positions = (torch.arange(count, dtype=torch.float64) + 0.5) * (old_fps / new_fps) - 0.5
    return positions.clamp(0, frames - 1)


def resample_positions(
    positions: Float[Tensor, "frames *joints 3"], old_fps: float | int, new_fps: float | int
) -> Float[Tensor, "_ *joints 3"]:
    """Resample `positions` linearly to another frame rate; see `sampling_positions`.

    Args:
        positions: Positions, [frames, *joints, 3].
        old_fps: Old frame rate.
        new_fps: New frame rate.
    """
    before, after, weight = _neighbours(positions, old_fps, new_fps)
    return torch.lerp(positions[before], positions[after], weight.reshape(-1, *[1] * (positions.ndim - 1)))


def resample_rotations(
    rotations: Float[Tensor, "frames *joints 3 3"], old_fps: float | int, new_fps: float | int
) -> Float[Tensor, "_ *joints 3 3"]:
    """Resample `rotations` to another frame rate by spherical interpolation; see `sampling_positions`.

    The published preparation interpolates axis-angle vectors instead, which passes through unrelated rotations if their
    sign flips.

    Args:
        rotations: Rotations, [frames, *joints, 3, 3].
        old_fps: Old frame rate.
        new_fps: New frame rate.
    """
    before, after, weight = _neighbours(rotations, old_fps, new_fps)
    start = rotations[before]
    arc = matrix_to_axis_angle(start.mT @ rotations[after])
    return start @ axis_angle_to_matrix(arc * weight.reshape(-1, *[1] * (arc.ndim - 1)))


def _neighbours(
    values: Tensor, old_fps: float | int, new_fps: float | int
) -> tuple[Int64[Tensor, " frames"], Int64[Tensor, " frames"], Float[Tensor, " frames"]]:
    positions = sampling_positions(len(values), old_fps, new_fps)
    before = positions.floor().long()
    after = (before + 1).clamp(max=len(values) - 1)
    weight = (positions - before).to(values.dtype)
    return before.to(values.device), after.to(values.device), weight.to(values.device)


def average_frames(values: Float[Tensor, "frames width"], reach: int) -> Float[Tensor, "_ width"]:
    """Average over `reach` frames on both sides with a Hann window, without padding."""
    window = torch.hann_window(2 * reach + 3, periodic=False, dtype=values.dtype, device=values.device)[1:-1]
    return torch.nn.functional.conv1d(values.T[:, None], (window / window.sum())[None, None])[:, 0].T


def mirror_rotations(
    rotations: Float[Tensor, "*batch joints 3 3"], order: Sequence[int]
) -> Float[Tensor, "*batch joints 3 3"]:
    """Mirror rotations in the plane x = 0; `order[joint]` is the joint's counterpart."""
    flip = rotations.new_tensor([-1.0, 1.0, 1.0])
    return rotations[..., list(order), :, :] * flip[:, None] * flip


def mirror_positions(
    positions: Float[Tensor, "*batch joints 3"], order: Sequence[int]
) -> Float[Tensor, "*batch joints 3"]:
    """Mirror positions in the plane x = 0; `order[joint]` is the joint's counterpart."""
    return positions[..., list(order), :] * positions.new_tensor([-1.0, 1.0, 1.0])
