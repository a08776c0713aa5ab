"""Characters in BVH files, and writing the motion of any character as a BVH file of its own skeleton.

The rest pose of a BVH file has no rotations, so the nodes of its rig are aligned with the axes of the world.
"""

from __future__ import annotations

import io
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float

from stmc.formats.bvh_parser import Bvh
from stmc.formats.bvh_writer import euler_curves
from stmc.formats.characters.gltf_file import CharacterError
from stmc.formats.characters.upright import Standing
from stmc.formats.characters.vrm_animation import vrma_bytes
from stmc.motion.retargeting import RigMotion

_TURN = "Zrotation Xrotation Yrotation"
_MOST_VALUES = 20_000_000
"""Maximum number of frames times joints of a written file."""


@dataclass(frozen=True, eq=False)
class BvhRig:
    """Joints of a BVH file in its rest pose, in the axes and the unit of the file."""

    names: tuple[str, ...]
    parents: tuple[int, ...]
    places: Float[np.ndarray, "nodes 3"]
    ends: Mapping[int, tuple[float, ...]] = field(default_factory=dict)
    """Offsets of the tips of joints without children."""

    formats = (".bvh", ".vrma")
    fps = None

    @classmethod
    def of(cls, bvh: Bvh) -> BvhRig:
        """Build the rig without rotations, from the offsets or from the positions of the first frame."""
        offsets = bvh.positions[0].numpy()
        places = np.empty_like(offsets)
        for node, parent in enumerate(bvh.parents):
            places[node] = offsets[node] * 0 if parent < 0 else places[parent] + offsets[node]
        if not np.abs(places).max() <= 1e6:
            raise CharacterError("its joints are more than a million units from the first")
        return cls(bvh.names, bvh.parents, places, bvh.ends)

    def content(self, suffix: str, motion: RigMotion, standing: Standing) -> bytes:
        """Return the bytes of a file of this suffix, one of `formats`."""
        return vrma_bytes(motion) if suffix == ".vrma" else bvh_text(self, motion, standing)


def bvh_text(body: BvhRig, motion: RigMotion, standing: Standing) -> bytes:
    """Write a motion as a BVH file of the character's own skeleton, in the axes and the unit of its file.

    The hierarchy begins at the root above the pelvis. Zero angles are the rest pose. The root and the pelvis have
    position channels.
    """
    rig, turn = motion.rig, standing.turn
    pelvis = rig.joints["pelvis"]
    top = _top(body, pelvis)
    order = _depth_first(body.parents, top)
    if len(order) * len(motion.turns) > _MOST_VALUES:
        raise CharacterError(f"{len(motion.turns)} frames of {len(order)} joints are too many for a BVH file")
    turned = turn.T @ motion.turns.numpy() @ turn
    same = np.broadcast_to(np.eye(3), (len(turned), 3, 3))
    world = [same if rig.carriers[node] < 0 else turned[:, rig.carriers[node]] for node in range(len(body.names))]
    local = [
        world[node] if body.parents[node] < 0 else np.swapaxes(world[body.parents[node]], 1, 2) @ world[node]
        for node in order
    ]
    angles = np.degrees(euler_curves(np.stack(local, axis=1)))
    where = motion.places[:, rig.place("pelvis")].numpy() @ turn
    columns = []
    for number, node in enumerate(order):
        if node == pelvis:
            above = 0.0 if node == top else body.places[body.parents[node]] - _ground(standing)
            columns.append(where - above)
        elif node == top:
            columns.append(np.broadcast_to(body.places[node] - _ground(standing), where.shape))
        columns.append(angles[:, number])
    lines = ["HIERARCHY", *_lines(body, order, top, pelvis), "MOTION", f"Frames: {len(where)}"]
    lines.append(f"Frame Time: {1.0 / motion.fps:.8f}")
    text = io.BytesIO()
    np.savetxt(text, np.concatenate(columns, axis=1), fmt="%.6f")
    return ("\n".join(lines) + "\n").encode() + text.getvalue()


def _ground(standing: Standing) -> Float[np.ndarray, " 3"]:
    """Return the point of the floor below the origin of the file, in its axes."""
    return standing.turn[2] * standing.floor


def _top(body: BvhRig, pelvis: int) -> int:
    """Return the root above the pelvis."""
    node = pelvis
    while body.parents[node] >= 0:
        node = body.parents[node]
    return node


def _depth_first(parents: Sequence[int], top: int) -> list[int]:
    below: dict[int, list[int]] = {}
    for node, parent in enumerate(parents):
        below.setdefault(parent, []).append(node)
    order, left = [], [top]
    while left:
        order.append(left.pop())
        left += reversed(below.get(order[-1], []))
    return order


def _lines(body: BvhRig, order: Sequence[int], top: int, pelvis: int) -> list[str]:
    """Return the lines of the hierarchy: offset and channels of each joint, and an end site for each leaf."""
    lines: list[str] = []
    open_nodes: list[int] = []
    for node in order:
        while open_nodes and open_nodes[-1] != body.parents[node]:
            open_nodes.pop()
            lines.append("\t" * len(open_nodes) + "}")
        indent = "\t" * len(open_nodes)
        name = re.sub(r"\s+", "_", body.names[node].strip()) or f"joint_{node}"
        offset = np.zeros(3) if node == top else body.places[node] - body.places[body.parents[node]]
        moves = "6 Xposition Yposition Zposition" if node in (top, pelvis) else "3"
        lines += [f"{indent}{'ROOT' if node == top else 'JOINT'} {name}", indent + "{"]
        lines += [f"{indent}\t{_offset(offset)}", f"{indent}\tCHANNELS {moves} {_TURN}"]
        if node not in body.parents:
            lines += [f"{indent}\tEnd Site", f"{indent}\t{{", f"{indent}\t\t{_offset(_tip(body, node, offset))}"]
            lines.append(f"{indent}\t}}")
        open_nodes.append(node)
    while open_nodes:
        open_nodes.pop()
        lines.append("\t" * len(open_nodes) + "}")
    return lines


def _tip(body: BvhRig, node: int, offset: np.ndarray) -> Sequence[float]:
    """Return the tip of a joint: that of the file, or half of the joint's own offset."""
    return body.ends.get(node) or (0.5 * offset).tolist()


def _offset(offset: Sequence[float] | np.ndarray) -> str:
    return "OFFSET " + " ".join(f"{value:.6f}" for value in offset)
