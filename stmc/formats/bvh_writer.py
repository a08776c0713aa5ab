"""Motions as BVH files for Blender, Maya and MotionBuilder.

Depends on BVH's text and Euler angles. Files are y-up and in metres: Blender's importer, with its defaults, converts y
up to z up and shows the motion in its original place (Maya and MotionBuilder use centimetres: scale by 100 there).
"""

from __future__ import annotations

import io
from typing import IO

import numpy as np
import torch
from einops import rearrange
from jaxtyping import Float

from stmc.formats.axes import Z_UP_TO_Y_UP
from stmc.motion.body import JOINTS, NUM_ROTATIONS, PARENTS
from stmc.motion.body_model import Skeleton
from stmc.motion.motion import Motion
from stmc.timeline import Timeline

_TURN = "Zrotation Xrotation Yrotation"
_TIPS = {"head": (0.0, 0.18, 0.02), "left_foot": (0.0, 0.0, 0.07), "right_foot": (0.0, 0.0, 0.07)}
"""End sites of joints without children, in metres from the joint; the wrists end in SMPL's hands."""


def save_bvh(motion: Motion, file: IO[bytes], skeleton: Skeleton, timeline: Timeline | None) -> None:
    """Write a motion as BVH: a T-pose at rest (SMPL's zero pose), 22 joints, the pelvis' path, and ZXY angles.

    Angles are continuous from frame to frame, without jumps of 360 degrees.

    Args:
        motion: Motion to write.
        file: Binary file.
        skeleton: Body to write.
        timeline: Not used: the format has no field for it.
    """
    lines = ["HIERARCHY", *_joint(0, skeleton, ""), "MOTION", f"Frames: {motion.frames}"]
    lines.append(f"Frame Time: {1.0 / motion.fps:.8f}")
    file.write(("\n".join(lines) + "\n").encode("ascii"))
    rotations = motion.rotations.double().cpu().numpy()
    rotations = np.concatenate([Z_UP_TO_Y_UP @ rotations[:, :1], rotations[:, 1:]], axis=1)
    pelvis = motion.translation.double().cpu().numpy() @ Z_UP_TO_Y_UP.T
    order = [index for index in _depth_first(0) if index < NUM_ROTATIONS]
    angles = rearrange(np.degrees(euler_curves(rotations)[:, order]), "frames joints angles -> frames (joints angles)")
    text = io.BytesIO()
    np.savetxt(text, np.concatenate([pelvis, angles], axis=1), fmt="%.6f")
    file.write(text.getvalue())


def _children(joint: int) -> list[int]:
    return [index for index, parent in enumerate(PARENTS) if parent == joint]


def _depth_first(joint: int) -> list[int]:
    return [joint, *(below for child in _children(joint) for below in _depth_first(child))]


def _joint(joint: int, skeleton: Skeleton, indent: str) -> list[str]:
    """Return the lines of a joint and its descendants."""
    name, inner = JOINTS[joint], indent + "  "
    offset = (0.0, 0.0, 0.0) if joint == 0 else skeleton.offsets[joint].tolist()
    channels = f"6 Xposition Yposition Zposition {_TURN}" if joint == 0 else f"3 {_TURN}"
    lines = [f"{indent}{'ROOT' if joint == 0 else 'JOINT'} {name}", f"{indent}{{"]
    lines += [f"{inner}{_offset(offset)}", f"{inner}CHANNELS {channels}"]
    for child in _children(joint):
        end = child >= NUM_ROTATIONS
        lines += _end(inner, skeleton.offsets[child].tolist()) if end else _joint(child, skeleton, inner)
    if name in _TIPS:
        lines += _end(inner, _TIPS[name])
    return [*lines, f"{indent}}}"]


def _end(indent: str, offset: tuple[float, ...] | list[float]) -> list[str]:
    return [f"{indent}End Site", f"{indent}{{", f"{indent}  {_offset(offset)}", f"{indent}}}"]


def _offset(offset: tuple[float, ...] | list[float]) -> str:
    return "OFFSET " + " ".join(f"{value:.6f}" for value in offset)


def euler_curves(rotations: Float[np.ndarray, "frames joints 3 3"]) -> Float[np.ndarray, "frames joints 3"]:
    """Compute angles (z, x, y) in radians with `rotations = Rz Rx Ry`, each frame's closest to the previous frame's.

    Every rotation has two triples, (z, x, y) and (z + pi, pi - x, y + pi), each up to full turns.
    """
    import roma  # imported late: it takes as long to import as torch

    frames, joints = rotations.shape[:2]
    first = roma.rotmat_to_euler("ZXY", torch.from_numpy(rotations)).numpy()
    second = first * [1, -1, 1] + np.pi
    angles = np.empty((frames, joints, 3))
    before = np.zeros((joints, 3))
    for frame in range(frames):
        triples = (first[frame], second[frame])
        near = [triple + 2 * np.pi * np.round((before - triple) / (2 * np.pi)) for triple in triples]
        far = [np.abs(triple - before).sum(axis=-1, keepdims=True) for triple in near]
        before = angles[frame] = np.where(far[0] <= far[1], *near)
    return angles
