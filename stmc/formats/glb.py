"""Motions as binary glTF 2.0: a skinned figure with its animation, for Blender, Unity, Unreal and the web, in one file.

Knows glTF's nodes, buffers and skins. Its world is y-up and in metres, as SMPL's rest pose is, so that only the pelvis
is turned. Written by hand: the libraries at hand read skins and animations, or neither.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Mapping
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
_TYPES = {"float32": 5126, "uint16": 5123, "uint8": 5121}
_SHAPES = {(): "SCALAR", (3,): "VEC3", (4,): "VEC4", (4, 4): "MAT4"}
_VERTICES, _INDICES = 34962, 34963
_CARRIERS = 4
"""Joints that may carry a vertex."""


def save_glb(motion: Motion, file: IO[bytes], skeleton: Skeleton, timeline: Timeline | None) -> None:
    """Write the mannequin around `skeleton`: 24 joints as nodes in a T-pose, a material for each body part, and an
    animation of 22 rotations and the pelvis' place, a key for each frame.

    The scene's `extras` have the frame rate ("fps") and the timeline as its own JSON has it ("timeline").
    """
    binary = _Binary()
    document = {
        "asset": {"version": "2.0", "generator": "stmc"},
        "scene": 0,
        "scenes": [{"name": "motion", "nodes": [0, len(JOINTS)], "extras": _extras(motion, timeline)}],
        "nodes": [*_joints(skeleton), {"name": "figure", "mesh": 0, "skin": 0}],
        "skins": [_skin(binary, skeleton)],
        "materials": [_material(part) for part in BodyPart],
        "meshes": [_mesh(binary, build_mannequin(skeleton))],
        "animations": [_animation(binary, motion)],
    }
    document |= {"accessors": binary.accessors, "bufferViews": binary.views, "buffers": [{"byteLength": binary.size}]}
    text = json.dumps(document, ensure_ascii=False, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    file.write(struct.pack("<4sII", b"glTF", 2, 12 + 8 + len(text) + 8 + binary.size))
    file.write(struct.pack("<I4s", len(text), b"JSON") + text)
    file.write(struct.pack("<I4s", binary.size, b"BIN\0") + b"".join(binary.chunks))


class _Binary:
    """The one buffer of a file, and what says where in it each array is."""

    def __init__(self) -> None:
        self.chunks: list[bytes] = []
        self.views: list[dict[str, Any]] = []
        self.accessors: list[dict[str, Any]] = []
        self.size = 0

    def add(self, array: np.ndarray, target: int | None = None, bounds: bool = False) -> int:
        """The index of the accessor of an array, whose rows are the elements; matrices are turned column by column."""
        rows = np.ascontiguousarray(array.swapaxes(1, 2) if array.ndim == 3 else array)
        view = {"buffer": 0, "byteOffset": self.size, "byteLength": rows.nbytes}
        self.views.append(view if target is None else view | {"target": target})
        accessor = {"bufferView": len(self.views) - 1, "componentType": _TYPES[array.dtype.name], "count": len(array)}
        accessor["type"] = _SHAPES[array.shape[1:]]
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


def _mesh(binary: _Binary, skin: Skin) -> dict[str, Any]:
    """One piece for each body part, all of the same vertices."""
    most = np.argsort(-skin.weights, axis=1, kind="stable")[:, :_CARRIERS]
    weights = np.take_along_axis(skin.weights, most, axis=1)
    weights = (weights / weights.sum(axis=1, keepdims=True)).astype(np.float32)
    attributes = {
        "POSITION": binary.add(skin.vertices.astype(np.float32), _VERTICES, bounds=True),
        "NORMAL": binary.add(_normals(skin), _VERTICES),
        "JOINTS_0": binary.add(np.where(weights > 0, most, 0).astype(np.uint8), _VERTICES),
        "WEIGHTS_0": binary.add(weights, _VERTICES),
    }
    pieces = []
    for index in range(len(PARTS)):
        corners = skin.faces[skin.parts == index].reshape(-1).astype(np.uint16)
        pieces.append({"attributes": attributes, "indices": binary.add(corners, _INDICES), "material": index})
    return {"name": "mannequin", "primitives": pieces}


def _normals(skin: Skin) -> Float[np.ndarray, "vertices 3"]:
    """Unit normals of the vertices: those of the faces around, by their areas."""
    first, second, third = (skin.vertices[skin.faces[:, corner]] for corner in range(3))
    normals = np.zeros_like(skin.vertices)
    np.add.at(normals, skin.faces.reshape(-1), np.repeat(np.cross(second - first, third - first), 3, axis=0))
    lengths = np.linalg.norm(normals, axis=1, keepdims=True)
    return np.where(lengths > 1e-12, normals / np.maximum(lengths, 1e-12), [0.0, 1.0, 0.0]).astype(np.float32)


def _animation(binary: _Binary, motion: Motion) -> dict[str, Any]:
    """Straight lines and arcs between the frames."""
    times = binary.add((np.arange(motion.frames) / motion.fps).astype(np.float32), bounds=True)
    rotations = motion.rotations.double().cpu().clone()
    up = torch.from_numpy(Z_UP_TO_Y_UP)
    rotations[:, 0] = up @ rotations[:, 0]
    turns = continued(matrix_to_quaternion(rotations))[..., [1, 2, 3, 0]].astype(np.float32)
    places = (motion.translation.double().cpu() @ up.T).numpy().astype(np.float32)
    tracks = [(0, "translation", places), *((joint, "rotation", turns[:, joint]) for joint in range(NUM_ROTATIONS))]
    samplers = [{"input": times, "output": binary.add(values), "interpolation": "LINEAR"} for *_, values in tracks]
    channels = [
        {"sampler": index, "target": {"node": node, "path": path}} for index, (node, path, _) in enumerate(tracks)
    ]
    return {"name": "motion", "samplers": samplers, "channels": channels}
