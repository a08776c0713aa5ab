"""Parser of BVH motion capture: a tree of named joints and, in each frame, their transforms relative to their parents.

Depends on the file format; independent of any body. Data sets (`data.sources`) and `formats.bvh_reader` interpret the
joints.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TypeVar

import numpy as np
import torch
from einops import einsum
from jaxtyping import Float
from torch import Tensor

from stmc.io.bounds import BoundsError, check_frames
from stmc.io.untrusted import quote, truncate

MOST_VALUES = 2_000_000
"""Limit of frames times joints: a hundred times a minute of a hundred joints at 3 frames per second."""

LONGEST_HIERARCHY = 2**22
"""Characters before the frames; a hundred joints have some 10,000."""

_AXES = {"X": 0, "Y": 1, "Z": 2}
_MOST_WORDS = 9
"""Words in a line of the hierarchy: a joint has at most three position and three rotation channels."""

Number = TypeVar("Number", int, float)

_LARGEST = float(np.finfo(np.float32).max)


class BvhError(ValueError):
    """A BVH file cannot be read; the message gives the location and the reason."""


@dataclass(frozen=True)
class Bvh:
    """A motion in the unit and the axes of its file, each joint in its parent's frame.

    `parents` holds -1 for roots; a parent always stands before its children.
    """

    names: tuple[str, ...]
    parents: tuple[int, ...]
    positions: Float[Tensor, "frames joints 3"]
    rotations: Float[Tensor, "frames joints 3 3"]
    fps: float | int
    ends: Mapping[int, tuple[float, ...]] = field(default_factory=dict)
    """The offset of the first End Site of a joint, by the joint's index."""

    def world(self) -> tuple[Float[Tensor, "frames joints 3 3"], Float[Tensor, "frames joints 3"]]:
        """Compute rotations and positions of all joints in the file's world frame, by forward kinematics."""
        rotations: list[Tensor] = []
        positions: list[Tensor] = []
        for joint, parent in enumerate(self.parents):
            rotation, position = self.rotations[:, joint], self.positions[:, joint]
            if parent >= 0:
                above = rotations[parent]
                position = positions[parent] + einsum(above, position, "frames i j, frames j -> frames i")
                rotation = above @ rotation
            rotations.append(rotation)
            positions.append(position)
        return torch.stack(rotations, dim=1), torch.stack(positions, dim=1)


@dataclass(eq=False)
class _Joint:
    name: str
    index: int
    parent: int
    offset: tuple[float, ...] = ()
    channels: tuple[str, ...] = ()
    end: _Joint | None = None


def parse_bvh(text: str) -> Bvh:
    """Parse the text of one BVH file.

    The position of a joint is that of its position channels if it has any (as in the Bandai data set), or else its
    OFFSET. Euler angles are intrinsic, in the order of the channels, in degrees. Raises `BvhError` for a missing
    section, an unknown line or channel, a frame count that does not match the numbers, values that are not finite in
    float32, a motion beyond `bounds` or of more than `MOST_VALUES`, or a hierarchy above `LONGEST_HIERARCHY`.
    """
    header, *rest = re.split(r"^[ \t]*MOTION[ \t\r]*$", text, maxsplit=1, flags=re.MULTILINE)
    if not rest:
        raise BvhError("no MOTION section: the file is truncated or not a BVH file")
    if len(header) > LONGEST_HIERARCHY:
        raise BvhError(f"HIERARCHY has {len(header):,} characters, more than {LONGEST_HIERARCHY:,}, the limit")
    joints = _hierarchy(header.splitlines())
    words = rest[0].split(maxsplit=5)
    if len(words) < 5 or words[0] != "Frames:" or words[2:4] != ["Frame", "Time:"]:
        raise BvhError(f"expected 'Frames: N Frame Time: S' after MOTION, found {quote(' '.join(words[:5]))}")
    frames, seconds = _number(words[1], int), _number(words[4], float)
    if frames < 1 or not 0.001 <= seconds <= 1:
        valid = "must be at least one frame of 0.001 to 1 s"
        raise BvhError(f"{quote(frames)} frames of {seconds:g} s: {valid}")
    if frames * len(joints) > MOST_VALUES:
        raise BvhError(f"{quote(frames)} frames of {len(joints)} joints are more than {MOST_VALUES:,}, the limit")
    try:
        check_frames(frames, 1 / seconds)
    except BoundsError as error:
        raise BvhError(str(error)) from error
    fps = round(1 / seconds, 2)  # files round the time: 0.0333333 s
    return _motion(joints, _values(words[5] if len(words) > 5 else "", frames, joints), fps)


def _hierarchy(lines: Sequence[str]) -> list[_Joint]:
    joints: list[_Joint] = []
    path: list[_Joint] = []
    opening = _Joint("", -1, -1)
    for number, line in enumerate(lines, start=1):
        try:
            match line.split(maxsplit=_MOST_WORDS):
                case ["ROOT" | "JOINT", name]:
                    opening = _Joint(name, len(joints), path[-1].index if path else -1)
                    joints.append(opening)
                case ["End", "Site"]:
                    opening = _Joint("End Site", -1, -1)  # it has an offset and no motion
                    path[-1].end = path[-1].end or opening
                case ["{"]:
                    path.append(opening)
                case ["}"]:
                    path.pop()
                case ["OFFSET", x, y, z]:
                    path[-1].offset = _single(x), _single(y), _single(z)
                case ["CHANNELS", count, *channels] if int(count) == len(channels):
                    path[-1].channels = tuple(channels)
                case [] | ["HIERARCHY"]:
                    pass
                case _:
                    raise ValueError("not a line of a BVH hierarchy")
        except (IndexError, ValueError) as error:
            wrong = "no brace is open here" if isinstance(error, IndexError) else error
            raise BvhError(f"HIERARCHY, line {number}: {quote(line.strip())}: {truncate(str(wrong), 100)}") from error
    if not joints or path:
        raise BvhError(f"HIERARCHY has {len(joints)} joints, and {len(path)} braces that are never closed")
    if missing := [joint.name for joint in joints if not joint.offset]:
        raise BvhError(f"joints without an OFFSET: {truncate(', '.join(missing), 100)}")
    return joints


def _values(text: str, frames: int, joints: Sequence[_Joint]) -> np.ndarray:
    columns = [(channel, joint.name) for joint in joints for channel in joint.channels]
    expected = frames * len(columns)
    words = text.split(maxsplit=expected)
    if len(words) != expected:
        found = f"{len(words)} numbers" if len(words) < expected else "more numbers than expected"
        raise BvhError(f"{found} for {frames} frames of {len(columns)} channels ({expected} expected)")
    try:
        values = np.array(words, dtype=np.float64)
    except ValueError as error:
        raise BvhError(f"MOTION holds something that is not a number: {truncate(str(error), 100)}") from error
    values = values.reshape(frames, len(columns))
    finite = np.abs(values) <= _LARGEST  # NaN is not
    if not finite.all():
        frame, column = np.argwhere(~finite)[0]
        channel, joint = columns[column]
        number = f"{truncate(channel)} of {quote(joint)} is {values[frame, column]} in frame {frame}"
        raise BvhError(f"{number}: values must be finite, in float32 too")
    return values


def _motion(joints: Sequence[_Joint], values: np.ndarray, fps: float | int) -> Bvh:
    positions = np.empty((len(values), len(joints), 3))
    rotations = np.empty((len(values), len(joints), 3, 3))
    column = 0
    for index, joint in enumerate(joints):
        positions[:, index] = joint.offset
        order = ""
        angles: list[np.ndarray] = []
        for channel in joint.channels:
            axis, kind = channel[:1], channel[1:]
            if axis not in _AXES or kind not in ("position", "rotation"):
                raise BvhError(f"unknown channel {quote(channel)} at joint {quote(joint.name)}")
            if kind == "position":
                positions[:, index, _AXES[axis]] = values[:, column]
            else:
                order += axis
                angles.append(values[:, column])
            column += 1
        rotations[:, index] = _rotations(order, angles, joint) if order else np.eye(3)
    return Bvh(
        names=tuple(joint.name for joint in joints),
        parents=tuple(joint.parent for joint in joints),
        positions=torch.from_numpy(positions),
        rotations=torch.from_numpy(rotations),
        fps=fps,
        ends={joint.index: joint.end.offset for joint in joints if joint.end is not None and joint.end.offset},
    )


def _rotations(order: str, angles: Sequence[np.ndarray], joint: _Joint) -> np.ndarray:
    try:
        from scipy.spatial.transform import Rotation  # not above: it is slow to import

        return Rotation.from_euler(order, np.stack(angles, axis=-1), degrees=True).as_matrix()  # upper case: intrinsic
    except ValueError as error:
        channels = f"the rotation channels of joint {quote(joint.name)} are {truncate(', '.join(order))}"
        raise BvhError(f"{channels}: {truncate(str(error), 100)}") from error


def _number(word: str, kind: type[Number]) -> Number:
    try:
        return kind(word)
    except ValueError as error:
        raise BvhError(f"expected a number, found {quote(word)}") from error


def _single(word: str) -> float:
    number = float(word)
    if not abs(number) <= _LARGEST:
        raise ValueError(f"{number} is not finite in float32")
    return number
