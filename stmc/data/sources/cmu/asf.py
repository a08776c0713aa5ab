"""Parser of Acclaim motion capture: a skeleton (`.asf`), and the motion of its bones (`.amc`).

Depends on the two file formats only; `catalogue` interprets the bones. Format:
https://research.cs.wisc.edu/graphics/Courses/cs-838-1999/Jeff/ASF-AMC.html
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from stmc.formats.bvh_parser import MOST_VALUES, Bvh
from stmc.io.untrusted import quote, truncate

MOST_WORDS, LONGEST_WORD = 4_000_000, 40
"""Maximum number of words of a motion, and of letters per word: twice what three minutes of 30 bones have at 120 fps.
"""

LARGEST = 1e9
"""Maximum number, in any unit."""
_ROOT = "root"


class AcclaimError(ValueError):
    """An ASF or AMC file that cannot be read; the message gives the place and the reason."""


@dataclass(frozen=True)
class Bone:
    """A bone in the rest pose.

    Args:
        name: Name of the bone.
        parent: Index of the parent.
        offset: Start of the bone relative to the start of its parent.
        frame: Angles ("xyz", degrees) of the axes that the bone rotates about.
        channels: Channels of the motion, in order.
    """

    name: str
    parent: int
    offset: np.ndarray
    frame: np.ndarray
    channels: tuple[str, ...]


Acclaim = tuple[Bone, ...]
"""A skeleton; parents precede their children."""


def parse_asf(text: str) -> Acclaim:
    """Parse the text of one ASF file.

    Raises `AcclaimError` if a section is missing, a bone is described twice or not at all, a number is invalid, or
    angles are not in degrees.
    """
    sections = _sections(text)
    if missing := [name for name in ("root", "bonedata", "hierarchy") if name not in sections]:
        raise AcclaimError(f"sections {', '.join(missing)} are missing: the file is truncated or not an ASF file")
    if ["angle", "deg"] not in sections.get("units", []):
        raise AcclaimError("units: angles must be in degrees")
    descriptions = _parse_bones(sections["bonedata"])
    root = {words[0].lower(): words[1:] for words in sections["root"]}
    bones = [Bone(_ROOT, -1, np.zeros(3), np.zeros(3), tuple(word.lower() for word in root.get("order", ())))]
    ends, indices = {_ROOT: np.zeros(3)}, {_ROOT: 0}
    for parent, *children in sections["hierarchy"]:
        if parent in ("begin", "end"):
            continue
        for child in children:
            if parent not in indices or child not in descriptions or child in indices:
                raise AcclaimError(f"hierarchy: {quote(parent)} cannot carry {quote(child)}: unknown, or duplicated")
            frame, channels, ends[child] = descriptions[child]
            indices[child] = len(bones)
            bones.append(Bone(child, indices[parent], ends[parent], frame, channels))
    return tuple(bones)


def parse_amc(text: str, skeleton: Acclaim, fps: float | int) -> Bvh:
    """Parse the text of one AMC file, which does not contain its frame rate.

    Joint i is at the start of bone i and has the bone's rotation from the rest pose.

    Args:
        text: Text of the file.
        skeleton: Its skeleton.
        fps: Its frame rate.

    Raises:
        AcclaimError: If frames differ in their bones, bones are not in the skeleton, values are not finite, or
            `MOST_VALUES` or `MOST_WORDS` is exceeded.
    """
    words = _words(text)
    table = words.reshape(-1, _words_of_a_frame(words))
    if len(table) * len(skeleton) > MOST_VALUES:
        raise AcclaimError(f"{len(table):,} frames of {len(skeleton):,} bones: more than {MOST_VALUES:,}, the limit")
    columns, names = _columns(table[0], skeleton)
    if not (table[:, names] == table[0, names]).all():
        frame = int((table[:, names] != table[0, names]).any(axis=1).argmax())
        raise AcclaimError(f"frame {frame + 1} names other bones than the first")
    positions, rotations = _pose(skeleton, table, columns)
    return Bvh(
        tuple(bone.name for bone in skeleton), tuple(bone.parent for bone in skeleton), positions, rotations, fps
    )


def _sections(text: str) -> dict[str, list[list[str]]]:
    """Split lines into words by section; words after a section's own name count as a line."""
    sections: dict[str, list[list[str]]] = {}
    lines: list[list[str]] = []
    for line in text.splitlines():
        words = line.partition("#")[0].split()
        if words and words[0].startswith(":"):
            lines = sections.setdefault(words[0][1:].lower(), [])
            words = words[1:]
        if words:
            lines.append(words)
    return sections


def _parse_bones(lines: list[list[str]]) -> dict[str, tuple[np.ndarray, tuple[str, ...], np.ndarray]]:
    """Return the axis angles, the channels and the end (relative to the start) of every bone."""
    bones: dict[str, tuple[np.ndarray, tuple[str, ...], np.ndarray]] = {}
    fields: dict[str, list[str]] = {}
    for words in lines:
        if words[0] == "begin":
            fields = {}
        elif words[0] == "end":
            name = " ".join(fields.get("name", ["without a name"]))
            try:
                if name in bones:
                    raise ValueError("it is duplicated")
                if fields["axis"][3:] not in (["XYZ"], ["xyz"]):
                    raise ValueError(f"axis {' '.join(fields['axis'])} is not three angles and XYZ")
                frame, direction = _vector(fields["axis"][:3]), _vector(fields["direction"])
                channels = tuple(word.lower() for word in fields.get("dof", ()))
                bones[name] = frame, channels, direction * _vector(fields["length"] * 3)
            except (KeyError, ValueError) as error:
                raise AcclaimError(f"bonedata, bone {quote(name)}: {truncate(str(error), 100)}") from error
        else:
            fields[words[0]] = words[1:]
    return bones


def _vector(words: list[str]) -> np.ndarray:
    vector = np.array(words, dtype=np.float64)
    if vector.shape != (3,) or not (np.abs(vector) < LARGEST).all():
        raise ValueError(f"{quote(' '.join(words))} must be one or three numbers below {LARGEST:g}")
    return vector


def _words(text: str) -> np.ndarray:
    _, marked, body = text.partition(":DEGREES")
    words = body.split()
    if not marked or not words:
        raise AcclaimError("no frames after ':DEGREES': the file is truncated or not an AMC file")
    if len(words) > MOST_WORDS or max(map(len, words)) > LONGEST_WORD:
        raise AcclaimError(f"more than {MOST_WORDS:,} words, or one of more than {LONGEST_WORD} letters, the limits")
    return np.array(words)


def _words_of_a_frame(words: np.ndarray) -> int:
    """Return the number of words per frame: its index, and names of bones with their values."""
    repeats = np.flatnonzero(words == words[1]) if len(words) > 1 else np.zeros(0, dtype=int)
    width = int(repeats[1] - repeats[0]) if len(repeats) > 1 else len(words)
    if words[0] != "1" or len(words) % width:
        raise AcclaimError(f"{len(words)} words are not frames of {width}: the file is truncated or damaged")
    return width


def _columns(frame: np.ndarray, skeleton: Acclaim) -> tuple[dict[str, dict[str, int]], list[int]]:
    """Return the indices of each bone's channels, and of the names, among the words of a frame."""
    bones = {bone.name: bone for bone in skeleton}
    columns: dict[str, dict[str, int]] = {}
    names, index = [], 1
    while index < len(frame):
        name = str(frame[index])
        if name not in bones or name in columns:
            raise AcclaimError(f"{quote(name)} is not a bone of the skeleton, or duplicated")
        channels = bones[name].channels
        columns[name] = {channel: index + 1 + offset for offset, channel in enumerate(channels)}
        names.append(index)
        index += 1 + len(channels)
    if index != len(frame):
        raise AcclaimError(f"bone {frame[names[-1]]!r} lacks values")
    return columns, names


def _pose(
    skeleton: Acclaim, table: np.ndarray, columns: dict[str, dict[str, int]]
) -> tuple[torch.Tensor, torch.Tensor]:
    """Compute every bone's position in its parent's frame and its rotation from the rest pose, [frames, bones, …]."""
    frames = len(table)
    positions = np.broadcast_to(np.stack([bone.offset for bone in skeleton]), (frames, len(skeleton), 3)).copy()
    rotations = np.broadcast_to(np.eye(3), (frames, len(skeleton), 3, 3)).copy()
    for index, bone in enumerate(skeleton):
        bone_columns = columns.get(bone.name, {}).items()
        values = {channel: _numbers(table[:, column], bone.name) for channel, column in bone_columns}
        angles = np.stack([values.get(channel, np.zeros(frames)) for channel in ("rx", "ry", "rz")], axis=-1)
        axes = Rotation.from_euler("xyz", bone.frame, degrees=True).as_matrix()  # lower case: about fixed axes
        rotations[:, index] = axes @ Rotation.from_euler("xyz", angles, degrees=True).as_matrix() @ axes.T
        for axis, channel in enumerate(("tx", "ty", "tz")):
            if channel in values:
                positions[:, index, axis] = values[channel]
    return torch.from_numpy(positions), torch.from_numpy(rotations)


def _numbers(words: np.ndarray, bone: str) -> np.ndarray:
    try:
        numbers = words.astype(np.float64)
    except ValueError as error:
        raise AcclaimError(f"bone {quote(bone)}: {error}") from error
    finite = np.abs(numbers) < LARGEST  # also false for NaN
    if not finite.all():
        raise AcclaimError(f"bone {quote(bone)}: values must be below {LARGEST:g}; frame {int((~finite).argmax()) + 1}")
    return numbers
