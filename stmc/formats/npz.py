"""Motions as `.npz` files in AMASS's layout, and back. Depends on AMASS's names; independent of other formats."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import IO, Any

import numpy as np
import torch
from einops import rearrange
from torch import Tensor

from stmc.io.arrays import ArraysError, Header, npz_headers, read_npz, read_npz_chunks
from stmc.io.bounds import MOST_COLUMNS, BoundsError, check_frames, check_metres
from stmc.io.untrusted import truncate
from stmc.motion.body import JOINTS, NUM_ROTATIONS
from stmc.motion.body_model import Skeleton
from stmc.motion.geometry import axis_angle_to_matrix, matrix_to_axis_angle
from stmc.motion.motion import Motion
from stmc.timeline import Timeline

_BETAS = 16
_FINGERS = 30
"""Number of joints of SMPL-H's two hands, which follow the body's 22."""
_FRAMES_AT_ONCE = 2**14
_RATES = ("mocap_framerate", "mocap_frame_rate")
"""AMASS's two spellings: SMPL-H files, SMPL-X files."""


def save_npz(motion: Motion, file: IO[bytes], skeleton: Skeleton, timeline: Timeline | None) -> None:
    """Write a motion in AMASS's layout (float64, z up, metres), with joints and timeline.

    Arrays are `poses` [frames, 156] (axis-angle, SMPL-H's 52 joints, fingers unturned), `trans` [frames, 3], `betas`
    [16] (zeros), `gender`, `mocap_framerate`, `joints` [frames, 24, 3], and a timeline's JSON as `timeline`. `trans` is
    SMPL's: the pelvis position minus the rest pelvis, so that a body posed by SMPL stands at the joints.

    Args:
        motion: Motion to write.
        file: Binary file.
        skeleton: Body with the rest pelvis.
        timeline: Timeline to store, or None.
    """
    body = rearrange(
        matrix_to_axis_angle(motion.rotations.double().cpu()), "frames joints axes -> frames (joints axes)"
    )
    extra: dict[str, Any] = {} if timeline is None else {"timeline": np.array(timeline.to_json())}
    np.savez_compressed(
        file,
        poses=np.pad(body.numpy(), ((0, 0), (0, 3 * _FINGERS))),
        trans=skeleton.smpl_translation(motion.translation.double()).cpu().numpy(),
        betas=np.zeros(_BETAS),
        gender=np.array("neutral"),
        mocap_framerate=np.array(float(motion.fps)),
        joints=motion.joints.double().cpu().numpy(),
        **extra,
    )


def load_npz(path: Path, skeleton: Skeleton) -> Motion:
    """Read the first 22 joints of an AMASS file (float32), without fingers and face.

    Without `joints`, as in AMASS's own files, `skeleton` is posed. Raises `ValueError` with the file and the array that
    is missing, damaged or has the wrong shape, and for a motion beyond `bounds`, before any array is unpacked.
    """
    headers = npz_headers(path)
    rate = next((name for name in _RATES if name in headers), _RATES[0])
    _check_headers(headers, path, rate)
    fps = float(read_npz(path, (rate,))[rate])
    try:
        frames = headers["poses"].shape[0]
        check_frames(frames, fps)
        names = ("poses", "trans", "joints") if "joints" in headers else ("poses", "trans")
        rotations, joints = torch.empty(frames, NUM_ROTATIONS, 3, 3), torch.empty(frames, len(JOINTS), 3)
        for number, arrays in enumerate(read_npz_chunks(path, names, _FRAMES_AT_ONCE)):
            span = slice(number * _FRAMES_AT_ONCE, (number + 1) * _FRAMES_AT_ONCE)
            rotations[span], joints[span] = _pose_chunk(arrays, skeleton)
        check_metres("joints", max(map(abs, map(float, joints.aminmax()))))
        return Motion(rotations, joints[:, 0].clone(), joints, fps)
    except BoundsError as error:
        raise ValueError(f"{path}: {error}") from error


def _check_headers(headers: Mapping[str, Header], path: Path, rate: str) -> None:
    """Raise `ValueError` unless all arrays are present and numeric, with consistent shapes."""
    if missing := [name for name in ("poses", "trans", rate) if name not in headers]:
        has = truncate(", ".join(headers), 200) or "none"
        raise ArraysError(f"{path} has no array {', '.join(missing)}; it has {has}")
    frames = headers["poses"].shape[:1]
    needed = {"poses": (*frames, None), "trans": (*frames, 3), rate: (), "joints": (*frames, len(JOINTS), 3)}
    for name in needed.keys() & headers.keys():
        shape, dtype = headers[name]
        if len(shape) != len(needed[name]) or not all(map(_fits, needed[name], shape)):
            raise ValueError(f"{path}: {name} has shape {shape}; need {needed[name]}")
        if dtype.kind not in "fiu":
            raise ValueError(f"{path}: {name} holds {truncate(str(dtype))}; need numbers")
    columns = headers["poses"].shape[1]
    if not 3 * NUM_ROTATIONS <= columns <= MOST_COLUMNS:
        raise ValueError(f"{path}: poses has {columns} columns; need {3 * NUM_ROTATIONS} to {MOST_COLUMNS}")
    if not frames[0]:
        raise ValueError(f"{path}: poses has no frames; need at least one")


def _fits(needed: int | None, size: int) -> bool:
    return needed in (None, size)


def _pose_chunk(arrays: Mapping[str, np.ndarray], skeleton: Skeleton) -> tuple[Tensor, Tensor]:
    """Return rotations and joints (float64) of some frames."""
    part = {name: torch.from_numpy(array.astype(np.float64)) for name, array in arrays.items()}
    body = rearrange(part["poses"][:, : 3 * NUM_ROTATIONS], "frames (joints angles) -> frames joints angles", angles=3)
    rotations = axis_angle_to_matrix(body)
    joints = part.get("joints")
    if joints is None:
        joints = skeleton.pose(rotations, part["trans"] + skeleton.offsets[0].double())
    return rotations, joints
