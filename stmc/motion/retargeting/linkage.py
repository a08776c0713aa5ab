"""Robots as hinges: positions and turns of their links, and how these change with the hinges' angles.

Knows kinematics (the product of exponentials: every hinge is a fixed axis at rest); knows no motion.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float, Int


@dataclass(frozen=True, eq=False)
class Linkage:
    """The hinges of a robot that moves freely, at rest in the world of its rig: z up, the floor at 0, facing -y."""

    parents: tuple[int, ...]
    """Each hinge's parent, -1 for one that the base carries; parents stand before their children."""
    axes: Float[np.ndarray, "hinges 3"]
    anchors: Float[np.ndarray, "hinges 3"]
    """A point on each axis."""
    lower: Float[np.ndarray, " hinges"]
    upper: Float[np.ndarray, " hinges"]
    """The limits of the angles, in radians from rest."""
    speeds: Float[np.ndarray, " hinges"]
    """The limits of the speeds, in radians per second."""
    movers: Int[np.ndarray, " nodes"]
    """For each node of the rig, the hinge that moves its position; -1: the base."""
    turners: Int[np.ndarray, " nodes"]
    """For each node of the rig, the hinge that turns it; -1: the base."""
    soles: Float[np.ndarray, "corners 3"]
    """The lower corners of the boxes around feet and toes."""
    sole_nodes: Int[np.ndarray, " corners"]
    """The node of the rig that carries each corner."""

    @cached_property
    def chains(self) -> Bool[np.ndarray, "hinges hinges"]:
        """Whether the second hinge carries the first, or is it."""
        chains = np.eye(len(self.parents), dtype=bool)
        for hinge, parent in enumerate(self.parents):
            if parent >= 0:
                chains[hinge] |= chains[parent]
        return chains

    @cached_property
    def resting(self) -> Float[np.ndarray, " hinges"]:
        """The angles nearest to rest within the limits."""
        return np.clip(np.zeros(len(self.parents)), self.lower, self.upper)

    def pose(self, angles: Float[np.ndarray, " hinges"], base: Base) -> Pose:
        """Return where hinges at these angles bring the links."""
        from scipy.spatial.transform import Rotation  # imported late: it is slow to import

        own = Rotation.from_rotvec(self.axes * angles[:, None]).as_matrix()
        shifts = self.anchors - np.einsum("hij,hj->hi", own, self.anchors)
        turns, places = np.empty((len(angles) + 1, 3, 3)), np.empty((len(angles) + 1, 3))
        turns[-1], places[-1] = base.turn, base.place
        for hinge, parent in enumerate(self.parents):
            turns[hinge] = turns[parent] @ own[hinge]
            places[hinge] = turns[parent] @ shifts[hinge] + places[parent]
        return Pose(self, turns, places)


@dataclass(frozen=True, eq=False)
class Base:
    """The turn and the shift of the base from rest: a point p at rest is at `turn @ p + place`."""

    turn: Float[np.ndarray, "3 3"]
    place: Float[np.ndarray, " 3"]


@dataclass(frozen=True, eq=False)
class Pose:
    """The turns and shifts of all links from rest, by their hinges; the last is the base's."""

    linkage: Linkage
    turns: Float[np.ndarray, "links 3 3"]
    places: Float[np.ndarray, "links 3"]

    def points(
        self, rest: Float[np.ndarray, "points 3"], movers: Int[np.ndarray, " points"]
    ) -> Float[np.ndarray, "points 3"]:
        """Return where points at rest are, each moved by one of the hinges or, -1, by the base."""
        return np.einsum("pij,pj->pi", self.turns[movers], rest) + self.places[movers]

    @cached_property
    def axes(self) -> Float[np.ndarray, "hinges 3"]:
        """The axes of the hinges in this pose."""
        return np.einsum("hij,hj->hi", self.turns[:-1], self.linkage.axes)

    def moves(
        self, points: Float[np.ndarray, "points 3"], movers: Int[np.ndarray, " points"]
    ) -> Float[np.ndarray, "points 3 unknowns"]:
        """Return the derivatives of points to the unknowns: the base's shift, its turn about its own place, angles."""
        anchors = self.points(self.linkage.anchors, np.arange(len(self.linkage.parents)))
        hinged = np.cross(self.axes[None], points[:, None] - anchors[None]) * self._moves(movers)
        origin = np.broadcast_to(np.eye(3), (len(points), 3, 3))
        arms = points - self.places[-1]
        turned = np.cross(np.eye(3)[None], arms[:, None])
        return np.concatenate([origin, turned.swapaxes(1, 2), hinged.swapaxes(1, 2)], axis=2)

    def spins(self, turners: Int[np.ndarray, " links"]) -> Float[np.ndarray, "links 3 unknowns"]:
        """Return the derivatives of links' turns, as rotation vectors in the world, to the same unknowns."""
        hinged = (self.axes[None] * self._moves(turners)).swapaxes(1, 2)
        same = np.broadcast_to(np.eye(3), (len(turners), 3, 3))
        return np.concatenate([0 * same, same, hinged], axis=2)

    def _moves(self, movers: Int[np.ndarray, " links"]) -> Bool[np.ndarray, "links hinges 1"]:
        chains = np.concatenate([self.linkage.chains, np.zeros((1, len(self.linkage.parents)), dtype=bool)])
        return chains[movers][..., None]
