"""Reads Acclaim motion capture: a skeleton (`.asf`), and what its bones do frame by frame (`.amc`).

Knows the two file formats and nothing of any body; what the bones mean is the data set's business (see `cmu`).
Format: https://research.cs.wisc.edu/graphics/Courses/cs-838-1999/Jeff/ASF-AMC.html
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from stmc.formats.bvh_parser import MOST_VALUES, Bvh
from stmc.io.untrusted import cut, shown

MOST_WORDS, LONGEST_WORD = 4_000_000, 40
"""Of a motion, and letters of each: twice what three minutes of 30 bones have at 120 frames per second."""

LARGEST = 1e9
"""No number of a body is as large, in whichever unit."""

_ROOT = "root"


class AcclaimError(ValueError):
    """An ASF or AMC file that cannot be read; the message says where and why."""


@dataclass(frozen=True)
class Bone:
    """`offset` is where the bone begins, from where its parent does; it turns about the axes of `frame` ("xyz" angles
    in degrees). `channels` are those of the motion's numbers, in their order. All as in the rest pose."""

    name: str
    parent: int
    offset: np.ndarray
    frame: np.ndarray
    channels: tuple[str, ...]


Acclaim = tuple[Bone, ...]
"""A skeleton: parents stand before their children."""


def parse_asf(text: str) -> Acclaim:
    """Parses the text of one ASF file. Raises `AcclaimError` for a missing section, a bone that is described twice or
    not at all, numbers that are none, and angles in anything but degrees."""
    sections = _sections(text)
    if missing := [name for name in ("root", "bonedata", "hierarchy") if name not in sections]:
        raise AcclaimError(f"sections {', '.join(missing)} are missing: the file is truncated or not an ASF file")
    if ["angle", "deg"] not in sections.get("units", []):
        raise AcclaimError("units: angles must be in degrees")
    described = _described(sections["bonedata"])
    root = {words[0].lower(): words[1:] for words in sections["root"]}
    bones = [Bone(_ROOT, -1, np.zeros(3), np.zeros(3), tuple(word.lower() for word in root.get("order", ())))]
    ends, places = {_ROOT: np.zeros(3)}, {_ROOT: 0}
    for parent, *children in sections["hierarchy"]:
        if parent in ("begin", "end"):
            continue
        for child in children:
            if parent not in places or child not in described or child in places:
                raise AcclaimError(f"hierarchy: {shown(parent)} cannot carry {shown(child)}: unknown, or duplicated")
            frame, channels, ends[child] = described[child]
            places[child] = len(bones)
            bones.append(Bone(child, places[parent], ends[parent], frame, channels))
    return tuple(bones)


def parse_amc(text: str, skeleton: Acclaim, fps: float | int) -> Bvh:
    """Parses the text of one AMC file, which does not say its frame rate.

    Joint i is where bone i begins, and turns by as much as the bone has turned from the rest pose. Raises
    `AcclaimError` for frames that are not alike, bones that the skeleton lacks, values that are not finite, and more
    than `MOST_VALUES` or `MOST_WORDS`.
    """
    words = _words(text)
    table = words.reshape(-1, _words_of_a_frame(words))
    if len(table) * len(skeleton) > MOST_VALUES:
        raise AcclaimError(f"{len(table):,} frames of {len(skeleton):,} bones: more than {MOST_VALUES:,}, the limit")
    columns, names = _columns(table[0], skeleton)
    if not (table[:, names] == table[0, names]).all():
        frame = int((table[:, names] != table[0, names]).any(axis=1).argmax())
        raise AcclaimError(f"frame {frame + 1} names other bones than the first")
    positions, rotations = _posed(skeleton, table, columns)
    return Bvh(
        tuple(bone.name for bone in skeleton), tuple(bone.parent for bone in skeleton), positions, rotations, fps
    )


def _sections(text: str) -> dict[str, list[list[str]]]:
    """The words of every line of a section; what stands behind the section's own name counts as a line."""
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


def _described(lines: list[list[str]]) -> dict[str, tuple[np.ndarray, tuple[str, ...], np.ndarray]]:
    """Of every bone: its axes' angles, its channels, and where it ends, from where it begins."""
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
                raise AcclaimError(f"bonedata, bone {shown(name)}: {cut(str(error), 100)}") from error
        else:
            fields[words[0]] = words[1:]
    return bones


def _vector(words: list[str]) -> np.ndarray:
    vector = np.array(words, dtype=np.float64)
    if vector.shape != (3,) or not (np.abs(vector) < LARGEST).all():
        raise ValueError(f"{shown(' '.join(words))} is not the one or three numbers below {LARGEST:g} that are needed")
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
    """How many words each frame has: its number, and bones' names with their values."""
    again = np.flatnonzero(words == words[1]) if len(words) > 1 else np.zeros(0, dtype=int)
    width = int(again[1] - again[0]) if len(again) > 1 else len(words)
    if words[0] != "1" or len(words) % width:
        raise AcclaimError(f"{len(words)} words are not frames of {width}: the file is truncated or damaged")
    return width


def _columns(frame: np.ndarray, skeleton: Acclaim) -> tuple[dict[str, dict[str, int]], list[int]]:
    """Where each bone's channels stand in a frame's words, and where the names do."""
    known = {bone.name: bone for bone in skeleton}
    columns: dict[str, dict[str, int]] = {}
    names, place = [], 1
    while place < len(frame):
        name = str(frame[place])
        if name not in known or name in columns:
            raise AcclaimError(f"{shown(name)} is not a bone of the skeleton, or duplicated")
        channels = known[name].channels
        columns[name] = {channel: place + 1 + index for index, channel in enumerate(channels)}
        names.append(place)
        place += 1 + len(channels)
    if place != len(frame):
        raise AcclaimError(f"bone {frame[names[-1]]!r} lacks values")
    return columns, names


def _posed(
    skeleton: Acclaim, table: np.ndarray, columns: dict[str, dict[str, int]]
) -> tuple[torch.Tensor, torch.Tensor]:
    """Every bone's position in its parent's frame and its rotation from the rest pose, [frames, bones, …]."""
    frames = len(table)
    positions = np.broadcast_to(np.stack([bone.offset for bone in skeleton]), (frames, len(skeleton), 3)).copy()
    rotations = np.broadcast_to(np.eye(3), (frames, len(skeleton), 3, 3)).copy()
    for index, bone in enumerate(skeleton):
        known = columns.get(bone.name, {}).items()
        values = {channel: _numbers(table[:, place], bone.name) for channel, place in known}
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
        raise AcclaimError(f"bone {shown(bone)}: {error}") from error
    finite = np.abs(numbers) < LARGEST  # NaN is not
    if not finite.all():
        raise AcclaimError(f"bone {shown(bone)}: values must be below {LARGEST:g}; frame {int((~finite).argmax()) + 1}")
    return numbers
