"""Robots in MuJoCo's models (MJCF): bodies, joints and the row of `qpos`. Meshes are not read."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np
from jaxtyping import Float

from stmc.formats.characters.gltf_file import CharacterError
from stmc.formats.characters.mjcf_text import Mjcf, turn_from_z
from stmc.formats.characters.robot import (
    MOST_LINKS,
    Hinge,
    Link,
    Robot,
    box_bounds,
    enclose,
    inertia_box,
    speed_limit,
)
from stmc.formats.characters.robot_xml import number, numbers, unit
from stmc.io.untrusted import quote

_GENERATORS = ("attach", "composite", "flexcomp", "replicate")
"""Elements of which MuJoCo makes bodies."""
_FREE = ("x", "y", "z", "qw", "qx", "qy", "qz")


@dataclass(frozen=True, eq=False)
class _Pose:
    """A body or a frame at rest in the world."""

    place: Float[np.ndarray, " 3"]
    turn: Float[np.ndarray, "3 3"]

    def child(self, model: Mjcf, element: Element, said: str) -> _Pose:
        place = numbers(element, "pos", (3,), said)
        return _Pose(self.at(np.zeros(3) if place is None else place), self.turn @ model.orientation(element, said))

    def at(self, point: Float[np.ndarray, " 3"]) -> Float[np.ndarray, " 3"]:
        return self.place + self.turn @ point


@dataclass(eq=False)
class _Parts:
    """What a body has by itself: its joints, and the bounds of its shapes."""

    hinges: list[Hinge] = field(default_factory=list)
    shapes: list[Float[np.ndarray, "2 3"]] = field(default_factory=list)
    mass_shape: Float[np.ndarray, "2 3"] | None = None


@dataclass(eq=False)
class _Reader:
    """The links and the row so far."""

    model: Mjcf
    links: list[Link] = field(default_factory=list)
    columns: list[str] = field(default_factory=list)
    resting: list[float] = field(default_factory=list)
    bases: dict[int, int] = field(default_factory=dict)
    balls: list[int] = field(default_factory=list)

    def bodies(self, element: Element, pose: _Pose, parent: int, around: str | None) -> None:
        """Add the bodies in an element, which hang from the link `parent`, also those in frames."""
        for child in element:
            if child.tag in _GENERATORS:
                raise CharacterError(
                    f"its bodies are made by <{child.tag}>, which is not read: save the model from MuJoCo"
                )
            if child.tag == "frame":
                self.bodies(child, pose.child(self.model, child, "a frame"), parent, child.get("childclass", around))
            elif child.tag == "body":
                self._body(child, pose, parent, child.get("childclass", around))

    def _body(self, body: Element, above: _Pose, parent: int, around: str | None) -> None:
        name = body.get("name") or f"body {len(self.links)}"
        if len(self.links) >= MOST_LINKS:
            raise CharacterError(f"it has more than {MOST_LINKS:,} bodies")
        pose, parts = above.child(self.model, body, f"body {quote(name)}"), _Parts()
        own = len(self.links)
        self._own(body, pose, parts, name, around)
        if own in self.bases:
            if parent >= 0:
                raise CharacterError(f"body {quote(name)} moves freely, but hangs from another")
            self.resting[self.bases[own] : self.bases[own] + 3] = pose.place.tolist()
        shape = enclose(parts.shapes)
        self.links.append(Link(name, parent, pose.turn, pose.place, tuple(parts.hinges), shape, parts.mass_shape))
        self.bodies(body, pose, own, around)

    def _own(self, element: Element, pose: _Pose, parts: _Parts, body: str, around: str | None) -> None:
        """Add what belongs to a body itself, also what is in frames."""
        for child in element:
            if child.tag == "frame":
                frame = pose.child(self.model, child, f"a frame of body {quote(body)}")
                self._own(child, frame, parts, body, child.get("childclass", around))
            elif child.tag == "freejoint":
                self._free(child.get("name") or body)
            elif child.tag == "joint":
                self._joint(self.model.attributes(child, around), pose, parts, body)
            elif child.tag == "geom":
                parts.shapes += self._shape(self.model.attributes(child, around), pose, body)
            elif child.tag == "inertial":
                parts.mass_shape = self._mass_shape(child, pose, body)

    def _free(self, name: str) -> None:
        if len(self.links) in self.bases:
            raise CharacterError(f"{quote(name)} is a second free joint of its body")
        self.bases[len(self.links)] = len(self.columns)
        self.columns += [f"{name}_{axis}" for axis in _FREE]
        self.resting += [0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0]

    def _joint(self, joint: Element, pose: _Pose, parts: _Parts, body: str) -> None:
        kind = joint.get("type", "hinge")
        first = f"{body} joint {len(parts.hinges) + 1}" if parts.hinges else body
        name = joint.get("name") or first
        said = f"joint {quote(name)}"
        if kind == "free":
            return self._free(name)
        if kind not in ("hinge", "ball", "slide"):
            raise CharacterError(f"{said} is {quote(kind)}; joints are free, ball, slide or hinge")
        place = numbers(joint, "pos", (3,), said)
        anchor, column = pose.at(np.zeros(3) if place is None else place), len(self.columns)
        if kind == "ball":
            if self._limits(joint, said) is not None:
                raise CharacterError(f"{said} is a ball with limits, which are not kept: use three hinges")
            self.balls.append(column)
            self.columns += [f"{name}_{axis}" for axis in _FREE[3:]]
            self.resting += [1.0, 0.0, 0.0, 0.0]
            for axis, letter in zip(pose.turn.T, "xyz", strict=True):
                parts.hinges.append(Hinge(f"{name}_{letter}", axis, anchor, -np.inf, np.inf, speed_limit(0.0), column))
            return None
        reference = number(joint, "ref", 0.0, said)
        reference = self.model.angle(reference) if kind == "hinge" else reference
        self.columns.append(name)
        self.resting.append(reference)
        if kind == "hinge":
            axis = numbers(joint, "axis", (3,), said)
            axis = pose.turn @ unit(np.array([0.0, 0.0, 1.0]) if axis is None else axis, "axis", said)
            limits = self._limits(joint, said)
            lower, upper = (-np.inf, np.inf) if limits is None else (limits - reference).tolist()
            parts.hinges.append(Hinge(name, axis, anchor, lower, upper, speed_limit(0.0), column, reference))
        return None

    def _limits(self, joint: Element, said: str) -> Float[np.ndarray, " 2"] | None:
        """Return the range of a joint in radians, None if it is not limited."""
        limits, limited = numbers(joint, "range", (2,), said), joint.get("limited", "auto")
        if limited == "false" or limits is None or (limited == "auto" and not self.model.autolimits):
            return None
        if limits[0] > limits[1]:
            raise CharacterError(f"range of {said} is {quote(limits.tolist())}: the lower limit comes first")
        return np.array([self.model.angle(limit) for limit in limits])

    def _shape(self, geom: Element, pose: _Pose, body: str) -> list[Float[np.ndarray, "2 3"]]:
        """Return the bounds of a geom, none for meshes and planes."""
        said, kind = f"a geom of body {quote(body)}", geom.get("type", "sphere")
        size = numbers(geom, "size", (1, 2, 3), said)
        ends = numbers(geom, "fromto", (6,), said)
        if kind not in ("sphere", "capsule", "cylinder", "box", "ellipsoid") or size is None:
            return []
        own = pose.child(self.model, geom, said)
        size = np.abs(np.concatenate([size, np.zeros(3 - len(size))]))
        if ends is not None:
            along = ends[3:] - ends[:3]
            turn = pose.turn @ turn_from_z(unit(along, "fromto", said))
            own = _Pose(pose.at((ends[:3] + ends[3:]) / 2), turn)
            length = np.linalg.norm(along) / 2
            size = np.array(
                [size[0], length, 0.0] if kind in ("capsule", "cylinder") else [size[0], size[1] or size[0], length]
            )
        if kind in ("sphere", "capsule"):
            ball = np.full((2, 3), size[0]) * np.array([[-1.0], [1.0]])
            middle = box_bounds(own.place, own.turn, np.array([0.0, 0.0, size[1] if kind == "capsule" else 0.0]))
            return [middle + ball]
        half = np.array([size[0], size[0], size[1]]) if kind == "cylinder" else size
        return [box_bounds(own.place, own.turn, half)]

    def _mass_shape(self, inertial: Element, pose: _Pose, body: str) -> Float[np.ndarray, "2 3"] | None:
        said = f"the inertial of body {quote(body)}"
        own, inertia = pose.child(self.model, inertial, said), np.zeros((3, 3))
        diagonal, full = numbers(inertial, "diaginertia", (3,), said), numbers(inertial, "fullinertia", (6,), said)
        moments = full if diagonal is None else diagonal
        if moments is None:
            return None
        inertia = np.diag(moments[:3])
        half = inertia_box(number(inertial, "mass", 0.0, said), inertia)
        return None if half is None else box_bounds(own.place, own.turn, half)


def read_mjcf(path: Path) -> Robot:
    """Read a robot. Raise `CharacterError`, which says what is missing, for a file that is none."""
    from scipy.spatial.transform import Rotation  # imported late: it is slow to import

    reader = _Reader(Mjcf.read(path))
    for section in reader.model.sections:
        if section.tag == "worldbody":
            reader.bodies(section, _Pose(np.zeros(3), np.eye(3)), -1, section.get("childclass"))
    if not reader.links:
        raise CharacterError("its world has no bodies")
    for link, column in reader.bases.items():
        x, y, z, w = Rotation.from_matrix(reader.links[link].turn).as_quat()
        reader.resting[column + 3 : column + 7] = [w, x, y, z]
    return Robot(
        tuple(reader.links),
        tuple(reader.columns),
        np.array(reader.resting),
        reader.bases,
        tuple(reader.balls),
    )
