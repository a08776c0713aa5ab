"""Robots as their files describe them: links, hinges, and the row of values that poses them.

Knows trees and places at rest, in metres and in the axes of the file's world; knows no format and no person.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

DEFAULT_SPEED = 4 * np.pi
"""The limit of a hinge's speed, in rad/s, if the file has none, as every MJCF, or one that limits nothing."""
_FASTEST = 100.0
"""Radians per second above which a file's limit limits nothing."""
MOST_LINKS = 1_000


@dataclass(frozen=True, eq=False)
class Hinge:
    """A hinge that turns its link, and what hangs from it, about an axis."""

    name: str
    axis: Float[np.ndarray, " 3"]
    """Its direction, of length 1, at rest."""
    anchor: Float[np.ndarray, " 3"]
    """A point of the axis at rest."""
    lower: float
    upper: float
    """The limits of its turn from rest, in radians."""
    speed: float
    """The limit of its speed, in radians per second."""
    column: int
    """The place of its value in the row, or of the quaternion of the ball joint that it is a third of."""
    zero: float = 0.0
    """Its value at rest."""
    mimics: bool = False
    """Whether it follows another hinge, so that it cannot be chosen."""


@dataclass(frozen=True, eq=False)
class Link:
    """A rigid piece. `parent` is -1 for one that hangs from the world."""

    name: str
    parent: int
    turn: Float[np.ndarray, "3 3"]
    place: Float[np.ndarray, " 3"]
    hinges: tuple[Hinge, ...] = ()
    """The hinges between its parent and it, in order."""
    shape: Float[np.ndarray, "2 3"] | None = None
    """The least and greatest coordinates of its boxes, spheres, cylinders and capsules at rest."""
    mass_shape: Float[np.ndarray, "2 3"] | None = None
    """Those of a box with its mass and inertia."""


@dataclass(frozen=True, eq=False)
class Mimic:
    """A value of the row that follows another: `ratio` times it, plus `offset`, within limits."""

    column: int
    leader: int
    ratio: float
    offset: float
    lower: float
    upper: float


@dataclass(frozen=True, eq=False)
class Robot:
    """The links of a file, parents first, and its row of values: MuJoCo's `qpos`, or the joints of a URDF."""

    links: tuple[Link, ...]
    columns: tuple[str, ...]
    resting: Float[np.ndarray, " columns"]
    """The row at rest, of which the values of hinges are not used."""
    bases: Mapping[int, int]
    """The links that move freely, each with the first of its seven columns: x y z, quaternion w x y z."""
    balls: tuple[int, ...] = ()
    """The first of the four columns of each ball joint, whose link has three hinges."""
    mimics: tuple[Mimic, ...] = ()


def speed_limit(speed: float) -> float:
    """Return a hinge's greatest speed, from that of the file, which is 0 or less if the file has none."""
    return speed if 0 < speed <= _FASTEST else DEFAULT_SPEED


def box_bounds(
    place: Float[np.ndarray, " 3"], turn: Float[np.ndarray, "3 3"], half: Float[np.ndarray, " 3"]
) -> Float[np.ndarray, "2 3"]:
    """Return the least and greatest coordinates of a turned box, of which `half` are the half lengths of its sides."""
    reach = np.abs(turn) @ half
    return np.stack([place - reach, place + reach])


def enclose(bounds: list[Float[np.ndarray, "2 3"]]) -> Float[np.ndarray, "2 3"] | None:
    """Return the bounds of several shapes together, None for none."""
    if not bounds:
        return None
    stacked = np.stack(bounds)
    return np.stack([stacked[:, 0].min(axis=0), stacked[:, 1].max(axis=0)])


def inertia_box(mass: float, inertia: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, " 3"] | None:
    """Return half the sides of the box with this mass and these moments of inertia, None if there is no such box."""
    if not mass > 0:
        return None
    diagonal = np.diagonal(inertia)
    squares = 6.0 * (diagonal.sum() - 2.0 * diagonal) / mass
    return np.sqrt(squares) / 2 if (squares > 0).all() else None
