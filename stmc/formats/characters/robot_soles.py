"""The soles of a robot: the lower corners of the boxes around its feet and toes, standing.

Of the shapes that are no meshes; else as wide as a box with the mass and inertia of the foot and as low as a link that
is called a sole; else as ours.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from stmc.formats.characters.robot import Link, enclose
from stmc.formats.characters.robot_pieces import Pieces
from stmc.formats.characters.robot_tree import RobotTree
from stmc.motion.retargeting.rig import SIDES

_LENGTHS = np.array([[-0.05, -0.16], [0.05, 0.06]])
"""Our sole to the right and to the left of the ankle, before and behind it, in lengths of the leg."""
_HEEL = 0.09
"""The height of our ankle above the sole, in lengths of the leg."""


@dataclass(frozen=True, eq=False)
class Soles:
    """Corners in the axes of rigs: z up, facing -y. The floor is where the lowest are."""

    corners: Float[np.ndarray, "corners 3"]
    nodes: tuple[int, ...]
    """The node of the tree that carries each corner."""
    floor: float


def soles_of(tree: RobotTree, turn: Float[np.ndarray, "3 3"]) -> Soles:
    """Return the soles of a robot that `turn` brings to the axes of rigs."""
    corners, nodes = [], []
    for side in SIDES:
        for joint in ("ankle", "foot"):
            if f"{side}_{joint}" in tree.joints:
                bounds = _bounds(tree, side, joint, turn)
                if bounds is not None:
                    (left, front, low), (right, back, _) = bounds
                    corners += [(x, y, low) for x in (left, right) for y in (front, back)]
                    nodes += 4 * [tree.joints[f"{side}_{joint}"]]
    made = np.array(corners)
    return Soles(made, tuple(nodes), float(made[:, 2].min()))


def _bounds(tree: RobotTree, side: str, joint: str, turn: np.ndarray) -> Float[np.ndarray, "2 3"] | None:
    """Return the least and greatest coordinates of a foot, or of toes of their own; None for toes without a shape."""
    links = _rigid(tree.pieces, tree.origins[tree.joints[f"{side}_{joint}"]])
    shape = enclose([link.shape for link in links if link.shape is not None])
    if shape is not None:
        return _turned(shape, turn)
    if joint == "foot":
        return None
    ankle = turn @ tree.at(f"{side}_ankle")
    leg = sum(
        float(np.linalg.norm(tree.at(f"{side}_{above}") - tree.at(f"{side}_{below}")))
        for above, below in (("hip", "knee"), ("knee", "ankle"))
    )
    mass = enclose([link.mass_shape for link in links if link.mass_shape is not None])
    bounds = np.empty((2, 3))
    bounds[:, :2], bounds[:, 2] = ankle[:2] + _LENGTHS * leg, ankle[2] - _HEEL * leg
    bounds = bounds if mass is None else _turned(mass, turn)
    low = [float(turn[2] @ link.place) for link in links if "sole" in link.name.lower()]
    if low:
        bounds[0, 2] = min(low)
    return bounds


def _turned(bounds: Float[np.ndarray, "2 3"], turn: np.ndarray) -> Float[np.ndarray, "2 3"]:
    corners = np.array([[bounds[i, 0], bounds[j, 1], bounds[k, 2]] for i in (0, 1) for j in (0, 1) for k in (0, 1)])
    turned = corners @ turn.T
    return np.stack([turned.min(axis=0), turned.max(axis=0)])


def _rigid(pieces: Pieces, node: int) -> list[Link]:
    """Return the link of a node, and those that hang from it without hinges."""
    found = {pieces.links[node]}
    for number, link in enumerate(pieces.robot.links):
        if link.parent in found and not link.hinges:
            found.add(number)
    return [pieces.robot.links[number] for number in sorted(found)]
