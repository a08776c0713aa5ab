"""Rotations, kinematic trees and time: what RoMa leaves out, in the conventions of SMPL motions.

Rotations are matrices `[*batch, 3, 3]` that act on column vectors; angles are radians; z is up. Functions keep the
dtype and device of their arguments and broadcast over leading axes. Knows no joint by name: trees and left-right
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
    """Rotation matrices of axis-angle vectors (SMPL's poses); any length, also zero."""
    import roma  # not above: it takes as long to import as torch

    return roma.rotvec_to_rotmat(axis_angle)


def matrix_to_axis_angle(matrix: Float[Tensor, "*batch 3 3"]) -> Float[Tensor, "*batch 3"]:
    """Axis-angle vectors of length at most pi. At exactly pi either of the two axes may come."""
    import roma  # not above: it takes as long to import as torch

    return roma.rotmat_to_rotvec(matrix)


def quaternion_to_matrix(quaternion: Float[Tensor, "*batch 4"]) -> Float[Tensor, "*batch 3 3"]:
    """Rotation matrices of unit quaternions, real part first."""
    import roma  # not above: it takes as long to import as torch

    return roma.unitquat_to_rotmat(roma.quat_wxyz_to_xyzw(quaternion))


def matrix_to_quaternion(matrix: Float[Tensor, "*batch 3 3"]) -> Float[Tensor, "*batch 4"]:
    """Unit quaternions, real part first and not negative."""
    import roma  # not above: it takes as long to import as torch

    quaternion = roma.quat_xyzw_to_wxyz(roma.rotmat_to_unitquat(matrix))
    return torch.where(quaternion[..., :1] < 0, -quaternion, quaternion)


def euler_zyx_to_matrix(angles: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3 3"]:
    """`Rz(angles[0]) Ry(angles[1]) Rx(angles[2])`."""
    import roma  # not above: it takes as long to import as torch

    return roma.euler_to_rotmat("ZYX", angles)


def matrix_to_euler_zyx(matrix: Float[Tensor, "*batch 3 3"]) -> Float[Tensor, "*batch 3"]:
    """Angles (z, y, x) with `matrix = Rz Ry Rx`; y within +-pi/2, where z and x are not unique."""
    y = torch.atan2(-matrix[..., 2, 0], torch.hypot(matrix[..., 0, 0], matrix[..., 1, 0]))
    x = torch.atan2(matrix[..., 2, 1], matrix[..., 2, 2])
    return torch.stack([heading(matrix), y, x], dim=-1)


def heading(matrix: Float[Tensor, "*batch 3 3"]) -> Float[Tensor, "*batch"]:
    """The z angle of `matrix` written as `Rz Ry Rx`: where the matrix sends the x axis, seen from above.

    For SMPL's root in a z-up world: 0 faces -y (the left hip towards +x), pi/2 faces +x.
    """
    return torch.atan2(matrix[..., 1, 0], matrix[..., 0, 0])


def rotation_z(angle: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch 3 3"]:
    """Rotations about the up axis, counter-clockwise seen from above."""
    cos, sin, zero, one = torch.cos(angle), torch.sin(angle), torch.zeros_like(angle), torch.ones_like(angle)
    return rearrange(
        torch.stack([cos, -sin, zero, sin, cos, zero, zero, zero, one], dim=-1), "... (row column) -> ... row column",
        row=3,
    )  # fmt: skip


def wrap(angle: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
    """The same angles within [-pi, pi]."""
    return torch.atan2(torch.sin(angle), torch.cos(angle))


def matrix_to_rows(matrix: Float[Tensor, "*batch 3 3"]) -> Float[Tensor, "*batch 6"]:
    """The continuous 6D representation (Zhou et al. 2019): the first two rows, one after the other."""
    return rearrange(matrix[..., :2, :], "... row column -> ... (row column)")


def rows_to_matrix(rows: Float[Tensor, "*batch 6"]) -> Float[Tensor, "*batch 3 3"]:
    """Gram-Schmidt on two rows: the inverse of `matrix_to_rows`, and a rotation for any finite input.

    Where a row is zero or the two are parallel, which no rotation gives, an axis of the world stands in.
    """
    first, second = rearrange(rows, "... (row column) -> row ... column", row=2)
    x = _unit(first, torch.eye(3, dtype=rows.dtype, device=rows.device)[0].expand_as(first))
    least = torch.nn.functional.one_hot(x.abs().argmin(dim=-1), 3).to(rows.dtype)
    spare = _unit(_without(least, x), least)
    y = _unit(_without(_unit(second, torch.zeros_like(second)), x), spare)
    return torch.stack([x, y, torch.linalg.cross(x, y)], dim=-2)


def orthonormal_rows(rows: Float[Tensor, "*batch columns"]) -> Float[Tensor, "*batch columns"]:
    """Rotations as `matrix_to_rows` has them, six numbers each, one after the other: rotations again after blending."""
    each = rearrange(rows, "... (rotation six) -> ... rotation six", six=6)
    return rearrange(matrix_to_rows(rows_to_matrix(each)), "... rotation six -> ... (rotation six)")


def _without(vector: Tensor, unit: Tensor) -> Tensor:
    return vector - (vector * unit).sum(dim=-1, keepdim=True) * unit


def _unit(vector: Tensor, otherwise: Tensor) -> Tensor:
    """`vector` with length one, `otherwise` where it has none beyond rounding."""
    norm = torch.linalg.vector_norm(vector, dim=-1, keepdim=True)
    empty = norm <= 16 * torch.finfo(vector.dtype).eps
    return torch.where(empty, otherwise, vector / torch.where(empty, torch.ones_like(norm), norm))


def shortest_arc(start: Float[Tensor, "*batch 3"], end: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3 3"]:
    """The smallest rotation that turns the unit vector `start` to the unit vector `end`.

    Where the two are opposite, a half turn about some axis perpendicular to them.
    """
    least = torch.nn.functional.one_hot(start.abs().argmin(dim=-1), 3).to(start.dtype)
    middle = _unit(start + end, _unit(_without(least, start), least))
    return _half_turn(middle) @ _half_turn(start)


def _half_turn(unit: Tensor) -> Tensor:
    """About `unit`; two of them turn by twice the angle between their axes."""
    return 2 * unit[..., :, None] * unit[..., None, :] - torch.eye(3, dtype=unit.dtype, device=unit.device)


def global_rotations(
    rotations: Float[Tensor, "*batch joints 3 3"], parents: Sequence[int]
) -> Float[Tensor, "*batch _ 3 3"]:
    """Rotations from each joint's frame to the world's, for all joints of `parents` (parents before children).

    `rotations` are relative to the parent; joints beyond its count have none of their own and follow their parent.
    """
    turned: list[Tensor] = []
    for joint, parent in enumerate(parents):
        if joint >= rotations.shape[-3]:
            turned.append(turned[parent])
            continue
        local = rotations[..., joint, :, :]
        turned.append(local if parent < 0 else turned[parent] @ local)
    return torch.stack(turned, dim=-3)


def forward_kinematics(
    rotations: Float[Tensor, "*batch joints 3 3"], offsets: Float[Tensor, "*frames _ 3"], parents: Sequence[int]
) -> Float[Tensor, "*batch _ 3"]:
    """Joint positions relative to the root, in the world's axes.

    `offsets`: each joint's rest position relative to its parent's, in the parent's frame, for all frames or for each;
    the root's row is not used.
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
    """The bones from each joint's parent to it, in the parent's frame, zero for the root: the offsets with which
    `forward_kinematics` gives `positions` again."""
    bones = positions[..., 1:, :] - positions[..., list(parents[1:]), :]
    turns = global_rotations(rotations, parents)[..., list(parents[1:]), :, :]
    local = einsum(turns, bones, "... joints row column, ... joints row -> ... joints column")
    return torch.cat([torch.zeros_like(positions[..., :1, :]), local], dim=-2)


def sampling_positions(frames: int, old_fps: float | int, new_fps: float | int) -> Float[Tensor, " frames"]:
    """Where `floor(frames * new_fps / old_fps)` new frames lie among the old ones (float64, CPU).

    As the published preparation of AMASS: frame i at `(i + 0.5) * old_fps / new_fps - 0.5`, within [0, frames - 1],
    so that both rates cover the same time. Raises `ValueError` where not one new frame fits.
    """
    count = math.floor(frames * new_fps / old_fps)
    if count < 1:
        raise ValueError(f"{frames} frames at {old_fps:g} fps are too short for one frame at {new_fps:g} fps")
    positions = (torch.arange(count, dtype=torch.float64) + 0.5) * (old_fps / new_fps) - 0.5
    return positions.clamp(0, frames - 1)


def resample_positions(
    positions: Float[Tensor, "frames *joints 3"], old_fps: float | int, new_fps: float | int
) -> Float[Tensor, "_ *joints 3"]:
    """`positions` at another frame rate, on straight lines; see `sampling_positions`."""
    before, after, share = _neighbours(positions, old_fps, new_fps)
    return torch.lerp(positions[before], positions[after], share.reshape(-1, *[1] * (positions.ndim - 1)))


def resample_rotations(
    rotations: Float[Tensor, "frames *joints 3 3"], old_fps: float | int, new_fps: float | int
) -> Float[Tensor, "_ *joints 3 3"]:
    """`rotations` at another frame rate, on the shortest arc of the sphere; see `sampling_positions`.

    The published preparation interpolates axis-angle vectors instead, which swings through unrelated rotations where
    their sign flips.
    """
    before, after, share = _neighbours(rotations, old_fps, new_fps)
    start = rotations[before]
    arc = matrix_to_axis_angle(start.mT @ rotations[after])
    return start @ axis_angle_to_matrix(arc * share.reshape(-1, *[1] * (arc.ndim - 1)))


def _neighbours(
    values: Tensor, old_fps: float | int, new_fps: float | int
) -> tuple[Int64[Tensor, " frames"], Int64[Tensor, " frames"], Float[Tensor, " frames"]]:
    positions = sampling_positions(len(values), old_fps, new_fps)
    before = positions.floor().long()
    after = (before + 1).clamp(max=len(values) - 1)
    share = (positions - before).to(values.dtype)
    return before.to(values.device), after.to(values.device), share.to(values.device)


def average_frames(values: Float[Tensor, "frames width"], reach: int) -> Float[Tensor, "_ width"]:
    """Means over `reach` frames to both sides under a Hann window, of those frames that have as many."""
    window = torch.hann_window(2 * reach + 3, periodic=False, dtype=values.dtype, device=values.device)[1:-1]
    return torch.nn.functional.conv1d(values.T[:, None], (window / window.sum())[None, None])[:, 0].T


def mirror_rotations(
    rotations: Float[Tensor, "*batch joints 3 3"], order: Sequence[int]
) -> Float[Tensor, "*batch joints 3 3"]:
    """The rotations of the mirror image in the plane x = 0; `order[joint]` is the joint's counterpart."""
    flip = rotations.new_tensor([-1.0, 1.0, 1.0])
    return rotations[..., list(order), :, :] * flip[:, None] * flip


def mirror_positions(
    positions: Float[Tensor, "*batch joints 3"], order: Sequence[int]
) -> Float[Tensor, "*batch joints 3"]:
    """The positions of the mirror image in the plane x = 0; `order[joint]` is the joint's counterpart."""
    return positions[..., list(order), :] * positions.new_tensor([-1.0, 1.0, 1.0])
