"""Reads BVH motion capture: a tree of named joints and, frame by frame, where each stands in its parent.

Knows the file format and nothing of any body; what the joints mean is the data set's business (see `bandai`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from einops import einsum
from jaxtyping import Float
from scipy.spatial.transform import Rotation
from torch import Tensor

_AXES = {"X": 0, "Y": 1, "Z": 2}


class BvhError(ValueError):
    """A BVH file that cannot be read; the message says where and why."""


@dataclass(frozen=True)
class Bvh:
    """A motion as its file has it: in the file's unit and axes, each joint in its parent's frame.

    `parents` holds -1 for roots; a parent always stands before its children.
    """

    names: tuple[str, ...]
    parents: tuple[int, ...]
    positions: Float[Tensor, "frames joints 3"]
    rotations: Float[Tensor, "frames joints 3 3"]
    fps: float

    def world(self) -> tuple[Float[Tensor, "frames joints 3 3"], Float[Tensor, "frames joints 3"]]:
        """Rotations and positions of every joint in the file's world frame, by forward kinematics."""
        rotations, positions = [], []
        for joint, parent in enumerate(self.parents):
            rotation, position = self.rotations[:, joint], self.positions[:, joint]
            if parent >= 0:
                above = rotations[parent]
                position = positions[parent] + einsum(above, position, "frames i j, frames j -> frames i")
                rotation = above @ rotation
            rotations.append(rotation)
            positions.append(position)
        return torch.stack(rotations, dim=1), torch.stack(positions, dim=1)


@dataclass(frozen=True)
class _Joint:
    name: str
    parent: int
    offset: tuple[float, ...]
    channels: tuple[str, ...]


def parse_bvh(text: str) -> Bvh:
    """Parses the text of one BVH file.

    A joint's position is its position channels where it has them (as in the Bandai data set), else its OFFSET.
    Euler angles are intrinsic, in the order of the channels, in degrees. Raises `BvhError` for a missing section, an
    unknown channel, a frame count that does not match the numbers, or values that are not finite.
    """
    header, mark, rest = text.partition("MOTION")
    if not mark:
        raise BvhError("no MOTION section: the file is truncated or not a BVH file")
    joints = _hierarchy(header.split())
    words = rest.split(maxsplit=5)
    if len(words) < 5 or words[0] != "Frames:" or words[2:4] != ["Frame", "Time:"]:
        raise BvhError(f"expected 'Frames: N Frame Time: S' after MOTION, found {' '.join(words[:5])!r}")
    frames, seconds = _number(words[1], int), _number(words[4], float)
    if frames < 1 or not 0 < seconds < 10:
        raise BvhError(f"{frames} frames of {seconds} s: at least one frame of a positive time is needed")
    return _motion(joints, _values(words[5] if len(words) > 5 else "", frames, joints), 1 / seconds)


def _hierarchy(words: list[str]) -> list[_Joint]:
    joints: list[_Joint] = []
    stack: list[int | None] = []
    current: int | None = None
    stream = iter(words)
    try:
        for word in stream:
            if word in ("ROOT", "JOINT"):
                parents = [index for index in stack if index is not None]
                joints.append(_Joint(next(stream), parents[-1] if parents else -1, (), ()))
                current = len(joints) - 1
            elif word == "End":
                current = None
            elif word == "{":
                stack.append(current)
            elif word == "}":
                stack.pop()
                current = None
            elif word == "OFFSET":
                offset = tuple(float(next(stream)) for _ in range(3))
                if current is not None:
                    joints[current] = _Joint(joints[current].name, joints[current].parent, offset, ())
            elif word == "CHANNELS":
                channels = tuple(next(stream) for _ in range(int(next(stream))))
                joints[current] = _Joint(*(getattr(joints[current], key) for key in ("name", "parent", "offset")), channels)
    except (StopIteration, IndexError, TypeError, ValueError, RuntimeError) as error:
        raise BvhError(f"malformed HIERARCHY near joint {len(joints)}: {error}") from error
    if not joints or stack:
        raise BvhError("HIERARCHY has no joints or its braces do not match")
    return joints


def _values(text: str, frames: int, joints: list[_Joint]) -> np.ndarray:
    width = sum(len(joint.channels) for joint in joints)
    try:
        values = np.array(text.split(), dtype=np.float64)
    except ValueError as error:
        raise BvhError(f"MOTION holds something that is not a number: {error}") from error
    if values.size != frames * width:
        raise BvhError(f"{values.size} numbers for {frames} frames of {width} channels ({frames * width} expected)")
    if not np.isfinite(values).all():
        raise BvhError("MOTION holds values that are not finite")
    return values.reshape(frames, width)


def _motion(joints: list[_Joint], values: np.ndarray, fps: float) -> Bvh:
    positions = np.empty((len(values), len(joints), 3))
    rotations = np.empty((len(values), len(joints), 3, 3))
    column = 0
    for index, joint in enumerate(joints):
        positions[:, index] = joint.offset
        order, angles = "", []
        for channel in joint.channels:
            axis, kind = channel[:1], channel[1:]
            if axis not in _AXES or kind not in ("position", "rotation"):
                raise BvhError(f"unknown channel {channel!r} at joint {joint.name!r}")
            if kind == "position":
                positions[:, index, _AXES[axis]] = values[:, column]
            else:
                order, angles = order + axis, [*angles, values[:, column]]
            column += 1
        stacked = np.stack(angles, axis=-1) if order else np.zeros((len(values), 1))
        rotations[:, index] = Rotation.from_euler(order or "X", stacked, degrees=True).as_matrix()
    return Bvh(
        names=tuple(joint.name for joint in joints),
        parents=tuple(joint.parent for joint in joints),
        positions=torch.from_numpy(positions),
        rotations=torch.from_numpy(rotations),
        fps=fps,
    )


def _number(word: str, kind: type) -> float:
    try:
        return kind(word)
    except ValueError as error:
        raise BvhError(f"expected a number, found {word!r}") from error
