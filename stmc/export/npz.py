"""Motions as `.npz` files laid out as AMASS has them, and back. Knows AMASS's names; knows no other format."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import IO

import numpy as np
import torch
from einops import rearrange

from stmc.arrays import npz_names, read_npz
from stmc.body import JOINTS, NUM_ROTATIONS
from stmc.body_model import Skeleton
from stmc.geometry import axis_angle_to_matrix, matrix_to_axis_angle
from stmc.motion import Motion
from stmc.timeline import Timeline

_BETAS = 16
_FINGERS = 30
"""Joints of SMPL-H's two hands, which follow the body's 22."""
_RATES = ("mocap_framerate", "mocap_frame_rate")
"""AMASS's two spellings: SMPL-H files, SMPL-X files."""


def save_npz(motion: Motion, file: IO[bytes], skeleton: Skeleton, timeline: Timeline | None) -> None:
    """Write `poses` [frames, 156] (axis-angle, SMPL-H's 52 joints, fingers unturned), `trans` [frames, 3], `betas` [16]
    (zeros), `gender`, `mocap_framerate` as AMASS has them (float64, z up, metres), `joints` [frames, 24, 3], and a
    timeline's JSON as `timeline`.

    `trans` is SMPL's: the pelvis position less `skeleton`'s rest pelvis, so that a body posed by SMPL stands where the
    joints are.
    """
    body = rearrange(
        matrix_to_axis_angle(motion.rotations.double().cpu()), "frames joints axes -> frames (joints axes)"
    )
    told = {} if timeline is None else {"timeline": np.array(timeline.to_json())}
    np.savez_compressed(
        file,
        poses=np.pad(body.numpy(), ((0, 0), (0, 3 * _FINGERS))),
        trans=skeleton.smpl_translation(motion.translation.double()).cpu().numpy(),
        betas=np.zeros(_BETAS),
        gender=np.array("neutral"),
        mocap_framerate=np.array(float(motion.fps)),
        joints=motion.joints.double().cpu().numpy(),
        **told,
    )


def load_npz(path: Path, skeleton: Skeleton) -> Motion:
    """The motion of an AMASS file (float32): its first 22 joints, whatever fingers and face follow.

    Without `joints`, as in AMASS's own files, `skeleton` is posed. Raises `ValueError` naming the file and the array
    that is missing, damaged or has the wrong shape.
    """
    rate = next((name for name in _RATES if name in npz_names(path)), _RATES[0])
    arrays = read_npz(path, ("poses", "trans", rate), ("joints",))
    poses = _shaped(arrays, path, "poses", (None, None))
    trans = _shaped(arrays, path, "trans", (len(poses), 3))
    fps = float(_shaped(arrays, path, rate, ()))
    joints = _shaped(arrays, path, "joints", (len(poses), len(JOINTS), 3)) if "joints" in arrays else None
    if poses.shape[1] < 3 * NUM_ROTATIONS:
        raise ValueError(f"{path}: poses has {poses.shape[1]} columns; need at least {3 * NUM_ROTATIONS}")
    body = torch.from_numpy(poses[:, : 3 * NUM_ROTATIONS])
    rotations = axis_angle_to_matrix(rearrange(body, "frames (joints angles) -> frames joints angles", angles=3))
    if joints is None:
        pelvis = torch.from_numpy(trans) + skeleton.offsets[0].double()
        return Motion.posed(rotations, pelvis, fps, skeleton).to(dtype=torch.float32)
    positions = torch.from_numpy(joints)
    return Motion(rotations, positions[:, 0], positions, fps).to(dtype=torch.float32)


def _shaped(arrays: Mapping[str, np.ndarray], path: Path, name: str, shape: tuple[int | None, ...]) -> np.ndarray:
    array = arrays[name].astype(np.float64)
    fits = len(array.shape) == len(shape) and all(
        want in (None, got) for want, got in zip(shape, array.shape, strict=True)
    )
    if not fits:
        raise ValueError(f"{path}: {name} has shape {array.shape}; need {shape}")
    return array
