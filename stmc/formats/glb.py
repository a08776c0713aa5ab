"""Motions as binary glTF 2.0: a skinned figure with its animation, for Blender, Unity, Unreal and the web, in one file.

Knows glTF's nodes, buffers and skins. Its world is y-up and in metres, as SMPL's rest pose is, so that only the pelvis
is turned. Written by hand: the libraries at hand read skins and animations, or neither.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Mapping
from dataclasses import dataclass
from typing import IO, Any

import numpy as np
import torch
from jaxtyping import Float

from stmc.formats.axes import Z_UP_TO_Y_UP, continued
from stmc.motion.body import JOINTS, NUM_ROTATIONS, PARENTS, BodyPart
from stmc.motion.body_model import Skeleton
from stmc.motion.geometry import matrix_to_quaternion
from stmc.motion.motion import Motion
from stmc.motion.skins import PARTS, Skin, build_mannequin
from stmc.timeline import Timeline

_COLOURS: Mapping[BodyPart, str] = {
    BodyPart.LEFT_ARM: "#e08a5b",
    BodyPart.RIGHT_ARM: "#5b8fd6",
    BodyPart.LEGS: "#5d6b80",
    BodyPart.HEAD: "#e6c9a8",
    BodyPart.SPINE: "#8fa3b8",
}
_TYPES = {"float32": 5126, "uint16": 5123, "uint8": 5121, "int16": 5122}
_SHAPES = {(): "SCALAR", (3,): "VEC3", (4,): "VEC4", (4, 4): "MAT4"}
_VERTICES, _INDICES = 34962, 34963
_CARRIERS = 4
"""Joints that may carry a vertex."""


@dataclass(frozen=True, eq=False)
class Animation:
    """A motion of a figure, and factors (1: as they are) by which joints enlarge the limbs that hang on them."""

    motion: Motion
    scales: Mapping[str, Float[np.ndarray, " frames"]] | None = None


def save_glb(motion: Motion, file: IO[bytes], skeleton: Skeleton, timeline: Timeline | None) -> None:
    """Write the mannequin around `skeleton`: 24 joints as nodes in a T-pose, a material for each body part, and an
    animation of 22 rotations and the pelvis' place, a key for each frame.

    The scene's `extras` have the frame rate ("fps") and the timeline as its own JSON has it ("timeline").
    """
    file.write(glb_of(build_mannequin(skeleton), {"motion": Animation(motion)}, _extras(motion, timeline)))


def glb_of(
    skin: Skin,
    animations: Mapping[str, Animation],
    extras: Mapping[str, Any] | None = None,
    tints: Float[np.ndarray, "vertices 3"] | None = None,
    compact: bool = False,
) -> bytes:
    """The file of a figure with named animations, and `extras` of its scene.

    `tints`: linear colours (0 to 1) of the vertices, which multiply the materials'. A `compact` file is half as large:
    its quaternions and weights are whole numbers of 16 and 8 bits (glTF 2.0, 3.6.2.2), exact to 0.01 degrees and 0.4 %.
    """
    binary = _Binary()
    scene = {"name": "motion", "nodes": [0, len(JOINTS)]} | ({"extras": dict(extras)} if extras else {})
    document = {
        "asset": {"version": "2.0", "generator": "stmc"},
        "scene": 0,
        "scenes": [scene],
        "nodes": [*_joints(skin.skeleton), {"name": "figure", "mesh": 0, "skin": 0}],
        "skins": [_skin(binary, skin.skeleton)],
        "materials": [_material(part) for part in BodyPart],
        "meshes": [_mesh(binary, skin, tints, compact)],
        "animations": [_animation(binary, name, each, compact) for name, each in animations.items()],
    }
    document |= {"accessors": binary.accessors, "bufferViews": binary.views, "buffers": [{"byteLength": binary.size}]}
    text = json.dumps(document, ensure_ascii=False, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    chunks = [struct.pack("<I4s", len(text), b"JSON"), text, struct.pack("<I4s", binary.size, b"BIN\0"), *binary.chunks]
    return b"".join([struct.pack("<4sII", b"glTF", 2, 12 + 8 + len(text) + 8 + binary.size), *chunks])


class _Binary:
    """The one buffer of a file, and what says where in it each array is."""

    def __init__(self) -> None:
        self.chunks: list[bytes] = []
        self.views: list[dict[str, Any]] = []
        self.accessors: list[dict[str, Any]] = []
        self.size = 0

    def add(self, array: np.ndarray, target: int | None = None, bounds: bool = False, normalized: bool = False) -> int:
        """The index of the accessor of an array, whose rows are the elements; matrices are turned column by column.
        `normalized`: whole numbers that stand for -1 to 1, or 0 to 1."""
        rows = np.ascontiguousarray(array.swapaxes(1, 2) if array.ndim == 3 else array)
        view = {"buffer": 0, "byteOffset": self.size, "byteLength": rows.nbytes}
        self.views.append(view if target is None else view | {"target": target})
        accessor = {"bufferView": len(self.views) - 1, "componentType": _TYPES[array.dtype.name], "count": len(array)}
        accessor["type"] = _SHAPES[array.shape[1:]]
        if normalized:
            accessor["normalized"] = True
        if bounds:
            accessor |= {"min": np.atleast_1d(array.min(axis=0)).tolist(), "max": np.atleast_1d(array.max(0)).tolist()}
        self.accessors.append(accessor)
        self.chunks.append(rows.tobytes() + b"\0" * (-rows.nbytes % 4))
        self.size += len(self.chunks[-1])
        return len(self.accessors) - 1


def _extras(motion: Motion, timeline: Timeline | None) -> dict[str, Any]:
    told = {} if timeline is None else {"timeline": json.loads(timeline.to_json())}
    return {"fps": motion.fps} | told


def _joints(skeleton: Skeleton) -> list[dict[str, Any]]:
    """A node for each joint, in SMPL's order, resting where the skeleton has it."""
    nodes = []
    for joint, (name, offset) in enumerate(zip(JOINTS, skeleton.offsets.tolist(), strict=True)):
        below = [index for index, parent in enumerate(PARENTS) if parent == joint]
        nodes.append({"name": name, "translation": offset} | ({"children": below} if below else {}))
    return nodes


def _skin(binary: _Binary, skeleton: Skeleton) -> dict[str, Any]:
    inverse = np.tile(np.eye(4, dtype=np.float32), (len(JOINTS), 1, 1))
    inverse[:, :3, 3] = -skeleton.rest.cpu().numpy()
    joints = list(range(len(JOINTS)))
    return {"name": "skeleton", "skeleton": 0, "joints": joints, "inverseBindMatrices": binary.add(inverse)}


def _material(part: BodyPart) -> dict[str, Any]:
    srgb = np.array([int(_COLOURS[part][at : at + 2], 16) for at in (1, 3, 5)]) / 255
    linear = np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)
    colour = [*linear.round(5).tolist(), 1.0]
    return {
        "name": str(part),
        "pbrMetallicRoughness": {"baseColorFactor": colour, "metallicFactor": 0, "roughnessFactor": 0.7},
    }


def _mesh(binary: _Binary, skin: Skin, tints: Float[np.ndarray, "vertices 3"] | None, compact: bool) -> dict[str, Any]:
    """One piece for each body part, all of the same vertices."""
    carriers, weights = _carriers(skin)
    attributes = {
        "POSITION": binary.add(skin.vertices.astype(np.float32), _VERTICES, bounds=True),
        "NORMAL": binary.add(_normals(skin), _VERTICES),
        "JOINTS_0": binary.add(carriers, _VERTICES),
        "WEIGHTS_0": binary.add(_in_bytes(weights) if compact else weights, _VERTICES, normalized=compact),
    }
    if tints is not None:
        opaque = np.column_stack([tints, np.ones(len(tints))])
        attributes["COLOR_0"] = binary.add(np.round(255 * opaque).astype(np.uint8), _VERTICES, normalized=True)
    pieces = []
    for index in range(len(PARTS)):
        corners = skin.faces[skin.parts == index].reshape(-1).astype(np.uint16)
        pieces.append({"attributes": attributes, "indices": binary.add(corners, _INDICES), "material": index})
    return {"name": "mannequin", "primitives": pieces}


def _carriers(skin: Skin) -> tuple[np.ndarray, Float[np.ndarray, "vertices 4"]]:
    """The joints that carry each vertex most, and their weights, which sum to 1."""
    most = np.argsort(-skin.weights, axis=1, kind="stable")[:, :_CARRIERS]
    weights = np.take_along_axis(skin.weights, most, axis=1)
    weights = (weights / weights.sum(axis=1, keepdims=True)).astype(np.float32)
    return np.where(weights > 0, most, 0).astype(np.uint8), weights


def _in_bytes(weights: Float[np.ndarray, "vertices 4"]) -> np.ndarray:
    """Weights in 255ths that still sum to 1: the first, which is the largest, takes the rest."""
    parts = np.round(255 * weights).astype(int)
    parts[:, 0] += 255 - parts.sum(axis=1)
    return parts.astype(np.uint8)


def _normals(skin: Skin) -> Float[np.ndarray, "vertices 3"]:
    """Unit normals of the vertices: those of the faces around, by their areas."""
    first, second, third = (skin.vertices[skin.faces[:, corner]] for corner in range(3))
    normals = np.zeros_like(skin.vertices)
    np.add.at(normals, skin.faces.reshape(-1), np.repeat(np.cross(second - first, third - first), 3, axis=0))
    lengths = np.linalg.norm(normals, axis=1, keepdims=True)
    return np.where(lengths > 1e-12, normals / np.maximum(lengths, 1e-12), [0.0, 1.0, 0.0]).astype(np.float32)


def _animation(binary: _Binary, name: str, animation: Animation, compact: bool) -> dict[str, Any]:
    """Straight lines and arcs between the frames."""
    motion = animation.motion
    times = binary.add((np.arange(motion.frames) / motion.fps).astype(np.float32), bounds=True)
    rotations = motion.rotations.double().cpu().clone()
    up = torch.from_numpy(Z_UP_TO_Y_UP)
    rotations[:, 0] = up @ rotations[:, 0]
    turns = continued(matrix_to_quaternion(rotations))[..., [1, 2, 3, 0]]
    turns = np.round(32767 * turns).astype(np.int16) if compact else turns.astype(np.float32)
    places = (motion.translation.double().cpu() @ up.T).numpy().astype(np.float32)
    tracks = [(0, "translation", places), *((joint, "rotation", turns[:, joint]) for joint in range(NUM_ROTATIONS))]
    for joint, factors in (animation.scales or {}).items():
        tracks.append((JOINTS.index(joint), "scale", np.repeat(factors[:, None], 3, axis=1).astype(np.float32)))
    samplers = [
        {"input": times, "output": binary.add(values, normalized=values.dtype == np.int16), "interpolation": "LINEAR"}
        for *_, values in tracks
    ]
    channels = [
        {"sampler": index, "target": {"node": node, "path": path}} for index, (node, path, _) in enumerate(tracks)
    ]
    return {"name": name, "samplers": samplers, "channels": channels}
