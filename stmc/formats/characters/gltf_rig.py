"""Characters in glTF files: the rest transforms of their nodes, and adding an animation to the file.

Knows transforms of nodes and the storage of animations; sees motions only through the rig.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
import torch
from jaxtyping import Float

from stmc.formats.axes import continued
from stmc.formats.characters.bvh_rig import BvhRig, bvh_text
from stmc.formats.characters.gltf_file import (
    CharacterError,
    Gltf,
    animation_of,
    index,
    numbers,
    objects,
    parents_of,
    skin_joints,
    with_animation,
)
from stmc.formats.characters.joint_names import VRM_BONES
from stmc.formats.characters.upright import Standing
from stmc.formats.characters.vrm_animation import vrma_bytes
from stmc.io.untrusted import quote
from stmc.motion.geometry import matrix_to_quaternion
from stmc.motion.retargeting import RigMotion

_EVEN = 1e-2
"""Tolerance of the ratio between the three scales of a node, which must preserve angles."""
_DEEPEST = 500
"""Maximum number of nodes from a root to a joint."""


@dataclass(frozen=True, eq=False)
class GltfRig:
    """Joints of a glTF file and the nodes above them at rest, parents before children, in the file's coordinates."""

    gltf: Gltf
    nodes: tuple[int, ...]
    """Indices of the nodes in the file."""
    parents: tuple[int, ...]
    """Parent of each node, as an index into `nodes`; -1 for roots."""
    turns: Float[np.ndarray, "nodes 3 3"]
    places: Float[np.ndarray, "nodes 3"]
    scales: Float[np.ndarray, " nodes"]
    joints: frozenset[int]
    """Nodes that carry skin or belong to a humanoid map, as indices into `nodes`."""

    @classmethod
    def of(cls, gltf: Gltf) -> GltfRig:
        """Build the rig of the only skeleton. Raises `CharacterError` for none, for several, and for bad transforms."""
        above, skins = parents_of(objects(gltf.document, "nodes")), skin_joints(gltf)
        vrm = set(vrm_joints(gltf).values())
        wanted = set().union(*skins)
        depths = {node: _depth(above, node) for node in wanted | vrm}
        _check_one_skeleton(gltf, above, skins)
        chosen = set(wanted | vrm)
        for node in depths:
            while above[node] >= 0 and above[node] not in chosen:
                node = above[node]
                chosen.add(node)
        nodes = sorted(chosen, key=lambda node: (_depth(above, node), node))
        places = {node: place for place, node in enumerate(nodes)}
        parents = tuple(places[above[node]] if above[node] >= 0 else -1 for node in nodes)
        turns, positions, scales = _rest(gltf, nodes, parents)
        carried = frozenset(places[node] for node in wanted | vrm)
        return cls(gltf, tuple(nodes), parents, turns, positions, scales, carried)

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Names of the nodes; "node" and the index for those without one."""
        named = (self.gltf.nodes[node].get("name") for node in self.nodes)
        pairs = zip(named, self.nodes, strict=True)
        return tuple(name if isinstance(name, str) and name else f"node {number}" for name, number in pairs)

    def humanoid(self) -> dict[str, int]:
        """Return the node of each of our joints by VRM's humanoid map, empty without one."""
        places = {node: place for place, node in enumerate(self.nodes)}
        return {joint: places[node] for joint, node in vrm_joints(self.gltf).items()}

    @property
    def is_vrm(self) -> bool:
        """Whether the file has VRM's humanoid map."""
        return bool(vrm_joints(self.gltf))

    @property
    def formats(self) -> tuple[str, ...]:
        """File suffixes that the rig can be written as, its own first."""
        return (*((".vrm",) if self.is_vrm else ()), ".glb", ".vrma", ".bvh")

    fps = None

    def content(self, suffix: str, motion: RigMotion, standing: Standing) -> bytes:
        """Return the bytes of a file of this suffix, one of `formats`."""
        if suffix == ".bvh":
            return bvh_text(BvhRig(self.names, self.parents, self.places), motion, standing)
        return vrma_bytes(motion) if suffix == ".vrma" else self.glb(motion, standing)

    def glb(self, motion: RigMotion, standing: Standing) -> bytes:
        """Return the bytes of a `.glb` file with the motion as its first animation.

        The animation has the rotations of the driven nodes and the position of the pelvis. Everything else is
        unchanged, except that the matrix of a driven node is split into translation, rotation and scale.
        """
        rotations, pelvis = self.local_pose(motion, standing)
        times = np.arange(len(pelvis)) / motion.fps
        pelvis_node = motion.rig.joints["pelvis"]
        tracks = [(pelvis_node, "translation", pelvis), *((n, "rotation", r) for n, r in rotations.items())]
        nodes = [self.nodes[node] for node, *_ in tracks]
        targets = [(node, path) for node, (_, path, _) in zip(nodes, tracks, strict=True)]
        made = animation_of(times, targets, [values for *_, values in tracks], motion.fps)
        document = dict(self.gltf.document)
        document["nodes"] = [
            _without_matrix(node) if number in nodes else node for number, node in enumerate(self.gltf.nodes)
        ]
        return with_animation(replace(self.gltf, document=document), *made).to_glb()

    def local_pose(self, motion: RigMotion, standing: Standing) -> tuple[dict[int, np.ndarray], np.ndarray]:
        """Return quaternions x y z w of each driven node, and positions of the pelvis, in their parents' frames."""
        rig = motion.rig
        turn = standing.turn
        turned = turn.T @ motion.turns.numpy() @ turn  # in the file's world
        rotations = {}
        for place, node in enumerate(rig.driven):
            parent = self.parents[node]
            own = turned[:, place] @ self.turns[node]
            carrier = rig.carriers[parent] if parent >= 0 else -1
            above = np.eye(3) if parent < 0 else self.turns[parent]
            above = above if carrier < 0 else turned[:, carrier] @ above
            rotations[node] = np.swapaxes(np.broadcast_to(above, own.shape), 1, 2) @ own
        quaternions = continued(matrix_to_quaternion(torch.from_numpy(np.stack(list(rotations.values()), axis=1))))
        rotations = {node: quaternions[:, place, [1, 2, 3, 0]] for place, node in enumerate(rotations)}
        pelvis = rig.joints["pelvis"]
        places, parent = motion.places[:, rig.place("pelvis")].numpy() @ turn, self.parents[pelvis]
        if parent >= 0:
            places = (places - self.places[parent]) @ self.turns[parent] / self.scales[parent]
        return rotations, places


def vrm_joints(gltf: Gltf) -> dict[str, int]:
    """Return the nodes of VRM's humanoid map (version 0 or 1) by our joint names, empty without one."""
    extensions = gltf.document.get("extensions", {})
    if not isinstance(extensions, dict):
        raise CharacterError("extensions is not an object")
    new, old = (_humanoid(extensions.get(name)) for name in ("VRMC_vrm", "VRM"))
    count = len(objects(gltf.document, "nodes"))
    bones: dict[str, Any] = {}
    if isinstance(new, dict):
        bones = {bone: each.get("node") for bone, each in new.items() if isinstance(each, dict)}
    elif isinstance(old, list):
        rows = [each for each in old if isinstance(each, dict) and isinstance(each.get("bone"), str)]
        bones = {each["bone"]: each.get("node") for each in rows}
    return {
        joint: index(bones[bone], count, f"VRM's bone {bone}") for bone, joint in VRM_BONES.items() if bone in bones
    }


def _humanoid(extension: Any) -> Any:
    humanoid = extension.get("humanoid") if isinstance(extension, dict) else None
    return humanoid.get("humanBones") if isinstance(humanoid, dict) else None


def _depth(above: Sequence[int], node: int) -> int:
    depth = 0
    while above[node] >= 0:
        node, depth = above[node], depth + 1
        if depth > _DEEPEST:
            raise CharacterError(f"its joints hang more than {_DEEPEST} nodes deep")
    return depth


def _check_one_skeleton(gltf: Gltf, above: Sequence[int], skins: Sequence[Sequence[int]]) -> None:
    """Raise `CharacterError` if the skeletons of two skins share neither a joint nor a parent node."""
    everything = set().union(*skins)

    def tops(joints: Sequence[int]) -> set[int]:
        found = set()
        for joint in joints:
            while above[joint] in everything:
                joint = above[joint]
            found.add(joint)
        return found

    homes = [tops(joints) for joints in skins]
    homes = [home | {~above[top] for top in home if above[top] >= 0} for home in homes]  # ~: the node above, apart
    first, rest = homes[0], list(range(1, len(homes)))
    while joined := [number for number in rest if homes[number] & first]:
        first = first.union(*(homes[number] for number in joined))
        rest = [number for number in rest if number not in joined]
    if rest:
        names = [objects(gltf.document, "skins")[number].get("name", f"skin {number}") for number in (0, rest[0])]
        raise CharacterError(f"it has two skeletons, {quote(names[0])} and {quote(names[1])}: keep one character")


def _rest(gltf: Gltf, nodes: Sequence[int], parents: Sequence[int]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    turns, places, scales = np.empty((len(nodes), 3, 3)), np.empty((len(nodes), 3)), np.empty(len(nodes))
    carriers = set(parents)
    for place, (node, parent) in enumerate(zip(nodes, parents, strict=True)):
        name = f"nodes[{node}]"
        translation, turn, scale = transform(gltf.nodes[node], name)
        if place in carriers and not max(scale) <= (1 + _EVEN) * min(scale):
            raise CharacterError(f"{name} is scaled unevenly, by {quote(scale.tolist())}: apply its scale first")
        if parent >= 0:
            translation = places[parent] + turns[parent] @ translation * scales[parent]
            turn, scale = turns[parent] @ turn, scale * scales[parent]
        turns[place], places[place], scales[place] = turn, translation, scale.mean()
    if not np.abs(places).max() <= 1e6 or not scales.min() > 1e-9:
        raise CharacterError("its joints are too far from the origin, or its scales too small")
    return turns, places, scales


def transform(node: Mapping[str, Any], name: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the translation, the rotation matrix and the three scales of a node relative to its parent."""
    if "matrix" in node:
        matrix = np.array(numbers(node["matrix"], 16, f"the matrix of {name}")).reshape(4, 4).T
        scale = np.linalg.norm(matrix[:3, :3], axis=0)
        turn = matrix[:3, :3] / np.maximum(scale, 1e-12)
        skewed = not np.abs(turn.T @ turn - np.eye(3)).max() < 1e-2
        if skewed or np.linalg.det(turn) < 0 or not np.allclose(matrix[3], [0, 0, 0, 1]):
            raise CharacterError(f"the matrix of {name} is no rotation, scale and translation")
        left, _, right = np.linalg.svd(turn)
        return matrix[:3, 3], left @ right, scale
    translation = np.array(numbers(node.get("translation", [0, 0, 0]), 3, f"the translation of {name}"))
    rotation = np.array(numbers(node.get("rotation", [0, 0, 0, 1]), 4, f"the rotation of {name}"))
    scale = np.array(numbers(node.get("scale", [1, 1, 1]), 3, f"the scale of {name}"))
    length = np.linalg.norm(rotation)
    if not length > 1e-6:
        raise CharacterError(f"the rotation of {name} is {quote(rotation.tolist())}, which is not a rotation")
    if not scale.min() > 1e-9:
        raise CharacterError(f"the scale of {name} is {quote(scale.tolist())}: it must be positive")
    return translation, _matrix(rotation / length), scale


def _matrix(quaternion: Float[np.ndarray, " 4"]) -> Float[np.ndarray, "3 3"]:
    """Return the rotation matrix of a unit quaternion x y z w."""
    x, y, z, w = quaternion
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


def _without_matrix(node: Mapping[str, Any]) -> dict[str, Any]:
    """Return the node with its matrix split into parts, because glTF cannot animate a matrix."""
    if "matrix" not in node:
        return dict(node)
    translation, turn, scale = transform(node, "a node")
    quaternion = matrix_to_quaternion(torch.from_numpy(turn)).numpy()[[1, 2, 3, 0]]
    kept = {name: value for name, value in node.items() if name != "matrix"}
    return kept | {"translation": translation.tolist(), "rotation": quaternion.tolist(), "scale": scale.tolist()}
