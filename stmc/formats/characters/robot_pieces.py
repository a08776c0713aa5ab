"""The joints of a robot as nodes of a tree, and hinges that together are one joint of a person.

A shoulder of three hinges is one joint whose place is the point nearest to their axes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float

from stmc.formats.characters.robot import Hinge, Link, Robot

_NEAR = 0.03
"""The greatest distance of axes from the place of their joint, as a share of the robot's size."""
_PARALLEL = 0.9
"""The cosine between axes from which on they turn the same way, so that they are no one joint."""


@dataclass(frozen=True, eq=False)
class Pieces:
    """What a robot's hinges move apart: a node for every hinge, and one for every link without a hinge of its own."""

    robot: Robot
    names: tuple[str, ...]
    """The hinges' names, or the links'."""
    links: tuple[int, ...]
    """The link that each node is, or is a part of."""
    parents: tuple[int, ...]
    hinges: tuple[Hinge | None, ...]

    @classmethod
    def of(cls, robot: Robot) -> Pieces:
        """Take a robot apart."""
        names, links, parents, hinges, last = [], [], [], [], {-1: -1}
        for number, link in enumerate(robot.links):
            above = last[link.parent]
            for hinge in link.hinges or (None,):
                names.append(link.name if hinge is None else hinge.name)
                links.append(number)
                parents.append(above)
                hinges.append(hinge)
                above = len(names) - 1
            last[number] = above
        return cls(robot, tuple(names), tuple(links), tuple(parents), tuple(hinges))

    def link(self, node: int) -> Link:
        """Return the link that a node is, or is a part of."""
        return self.robot.links[self.links[node]]

    @cached_property
    def places(self) -> Float[np.ndarray, "nodes 3"]:
        """The nodes at rest: a point of a hinge's axis, or where the link is."""
        pairs = zip(self.hinges, range(len(self.names)), strict=True)
        return np.stack([self.link(node).place if hinge is None else hinge.anchor for hinge, node in pairs])

    @cached_property
    def movers(self) -> tuple[int, ...]:
        """For each node, the node of the last hinge from the root down to it; -1 for none."""
        movers: list[int] = []
        for node, (parent, hinge) in enumerate(zip(self.parents, self.hinges, strict=True)):
            movers.append(node if hinge is not None else movers[parent] if parent >= 0 else -1)
        return tuple(movers)

    def above(self, node: int) -> int:
        """Return the node of the hinge that carries a node's own hinge; -1 for none."""
        parent = self.parents[node]
        return self.movers[parent] if parent >= 0 else -1

    @cached_property
    def joints(self) -> tuple[tuple[int, ...], ...]:
        """Groups of one to three consecutive hinges, whose axes nearly intersect in a point and are not parallel."""
        near = _NEAR * float(np.ptp(self.places, axis=0).max())
        hinged = [node for node, hinge in enumerate(self.hinges) if hinge is not None]
        carried = [self.above(node) for node in hinged]
        joints: list[list[int]] = []
        places: dict[int, list[int]] = {}
        for node, above in zip(hinged, carried, strict=True):
            before = places.get(above)
            if before is not None and carried.count(above) == 1 and self._meet([*before, node], near):
                before.append(node)
            else:
                before = [node]
                joints.append(before)
            places[node] = before
        return tuple(map(tuple, joints))

    def joint(self, node: int) -> tuple[int, ...]:
        """Return the nodes of the joint that a node is a part of; the node alone if it has no hinge."""
        return next((joint for joint in self.joints if node in joint), (node,))

    def centre(self, nodes: Sequence[int]) -> Float[np.ndarray, " 3"]:
        """Return the point nearest to the axes of some nodes; of several, the one nearest to the mean of the nodes."""
        middle = self.places[list(nodes)].mean(axis=0)
        squares, sides = 1e-6 * np.eye(3), 1e-6 * middle
        for node in nodes:
            hinge = self.hinges[node]
            if hinge is not None:
                across = np.eye(3) - np.outer(hinge.axis, hinge.axis)
                squares, sides = squares + across, sides + across @ hinge.anchor
        return np.linalg.solve(squares, sides)

    def _meet(self, nodes: list[int], near: float) -> bool:
        hinges = [hinge for hinge in (self.hinges[node] for node in nodes) if hinge is not None]
        *others, last = hinges
        if len(hinges) > 3 or any(abs(last.axis @ other.axis) > _PARALLEL for other in others):
            return False
        centre = self.centre(nodes)
        return all(np.linalg.norm(np.cross(hinge.axis, centre - hinge.anchor)) <= near for hinge in hinges)
