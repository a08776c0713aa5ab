"""Motions as binary glTF 2.0: a skinned figure with its animation, for Blender, Unity, Unreal and the web, in one file.

Depends on glTF's nodes, buffers and skins. Files are y-up and in metres, like SMPL's rest pose, so that only the pelvis
is turned. The writer is our own, since the available libraries do not write skins and animations.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from typing import IO, Any

import numpy as np
import torch
from jaxtyping import Float

from stmc.formats.axes import Z_UP_TO_Y_UP, continued
from stmc.formats.glb_container import pack_glb
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
"""Greatest number of joints that carry a vertex."""


@dataclass(frozen=True, eq=False)
class Animation:
    """A motion of a figure, with scale factors (1: unchanged) of joints and the limbs below them."""

    motion: Motion
    scales: Mapping[str, Float[np.ndarray, " frames"]] | None = None


def save_glb(motion: Motion, file: IO[bytes], skeleton: Skeleton, timeline: Timeline | None) -> None:
    """Write the mannequin around a skeleton, with its animation.

    The file holds 24 joints as nodes in a T-pose, a material for each body part, and an animation of 22 rotations and
    the position of the pelvis, with one key per frame. The scene's `extras` hold the frame rate ("fps") and the
    timeline's JSON ("timeline").

    Args:
        motion: Motion to write.
        file: Binary file.
        skeleton: Body of the mannequin.
        timeline: Timeline to store, or None.
    """
    file.write(glb_of(build_mannequin(skeleton), {"motion": Animation(motion)}, _extras(motion, timeline)))


def glb_of(
    skin: Skin,
    animations: Mapping[str, Animation],
    extras: Mapping[str, Any] | None = None,
    tints: Float[np.ndarray, "vertices 3"] | None = None,
    compact: bool = False,
) -> bytes:
    """Return the bytes of a `.glb` file of a figure with named animations.

    Args:
        skin: The figure.
        animations: Animations by name.
        extras: Extras of the scene.
        tints: Linear colours of the vertices (0 to 1), which multiply those of the materials.
        compact: Whether to halve the file: quaternions and weights become integers of 16 and 8 bits (glTF 2.0,
            3.6.2.2), exact to 0.01 degrees and 0.4 %.
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
        "animations": [_animation(binary, name, item, compact) for name, item in animations.items()],
    }
    document |= {"accessors": binary.accessors, "bufferViews": binary.views, "buffers": [{"byteLength": binary.size}]}
    return pack_glb(document, b"".join(binary.chunks))


class _Binary:
    """The only buffer of a file, with the views and accessors of its arrays."""

    def __init__(self) -> None:
        self.chunks: list[bytes] = []
        self.views: list[dict[str, Any]] = []
        self.accessors: list[dict[str, Any]] = []
        self.size = 0

    def add(self, array: np.ndarray, target: int | None = None, bounds: bool = False, normalized: bool = False) -> int:
        """Append an array and return the index of its accessor. Rows are elements; matrices are stored by columns.

        Args:
            array: Array to append.
            target: Kind of the buffer view.
            bounds: Whether to store minimum and maximum.
            normalized: Whether integers represent numbers from -1 to 1, or from 0 to 1.
        """
        rows = np.ascontiguousarray(array.swapaxes(1, 2) if array.ndim == 3 else array)
        view = {"buffer": 0, "byteOffset": self.size, "byteLength": rows.nbytes}
        self.views.append(view if target is None else view | {"target": target})
        view_index, kind = len(self.views) - 1, _TYPES[array.dtype.name]
        accessor: dict[str, Any] = {"bufferView": view_index, "componentType": kind, "count": len(array)}
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
    stored = {} if timeline is None else {"timeline": json.loads(timeline.to_json())}
    return {"fps": motion.fps} | stored


def _joints(skeleton: Skeleton) -> list[dict[str, Any]]:
    """Return a node for each joint, in SMPL's order, at its rest position."""
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
    """Return a mesh with one primitive for each body part; all share the same vertices."""
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
    """Return the joints with the largest weights of each vertex, and these weights, which sum to 1."""
    most = np.argsort(-skin.weights, axis=1, kind="stable")[:, :_CARRIERS]
    weights = np.take_along_axis(skin.weights, most, axis=1)
    weights = (weights / weights.sum(axis=1, keepdims=True)).astype(np.float32)
    return np.where(weights > 0, most, 0).astype(np.uint8), weights


def _in_bytes(weights: Float[np.ndarray, "vertices 4"]) -> np.ndarray:
    """Convert weights to 255ths that still sum to 1: the first and largest takes the remainder."""
    parts = np.round(255 * weights).astype(int)
    parts[:, 0] += 255 - parts.sum(axis=1)
    return parts.astype(np.uint8)


def _normals(skin: Skin) -> Float[np.ndarray, "vertices 3"]:
    """Compute unit normals of the vertices: means of the adjacent faces, weighted by area."""
    first, second, third = (skin.vertices[skin.faces[:, corner]] for corner in range(3))
    normals = np.zeros_like(skin.vertices)
    np.add.at(normals, skin.faces.reshape(-1), np.repeat(np.cross(second - first, third - first), 3, axis=0))
    lengths = np.linalg.norm(normals, axis=1, keepdims=True)
    return np.where(lengths > 1e-12, normals / np.maximum(lengths, 1e-12), [0.0, 1.0, 0.0]).astype(np.float32)


def _animation(binary: _Binary, name: str, animation: Animation, compact: bool) -> dict[str, Any]:
    """Return an animation with linear interpolation between the frames, on the sphere for rotations."""
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
