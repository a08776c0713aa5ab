"""Robots in URDF files: links, and joints of which each has one child. Meshes are not read.

A row of values is the base's place and quaternion, then the joints that move, in the file's order.
"""

from __future__ import annotations

from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np
from jaxtyping import Float

from stmc.formats.characters.gltf_file import CharacterError
from stmc.formats.characters.robot import (
    MOST_LINKS,
    Hinge,
    Link,
    Mimic,
    Robot,
    box_bounds,
    enclose,
    inertia_box,
    speed_limit,
)
from stmc.formats.characters.robot_xml import number, numbers, read_xml, unit
from stmc.io.untrusted import quote, truncate

_HINGES = ("revolute", "continuous")
_KINDS = (*_HINGES, "prismatic", "fixed")


def read_urdf(path: Path) -> Robot:
    """Read a robot. Raise `CharacterError`, which says what is missing, for a file that is none."""
    root = read_xml(path)
    if root.tag != "robot":
        raise CharacterError(f"its outermost element is <{truncate(root.tag)}>; a URDF begins with <robot>")
    if any("xacro" in element.tag for element in root):
        raise CharacterError("it is a template of xacro: write it out first, with `xacro robot.urdf.xacro`")
    links = _named(root, "link")
    joints = _named(root, "joint")
    if not 1 <= len(links) <= MOST_LINKS:
        raise CharacterError(f"it has {len(links)} links; a robot has 1 to {MOST_LINKS:,}")
    tree, kinds = _tree(links, joints), {name: _kind(joint, name) for name, joint in joints.items()}
    moving = [name for name, kind in kinds.items() if kind != "fixed"]
    made: list[Link] = []
    places = {name: number for number, name in enumerate(tree)}
    for name, (above, joint) in tree.items():
        place = -1 if above is None else places[above]
        parent = None if above is None else made[place]
        column = moving.index(joint) if joint in moving else -1
        made.append(_link(links[name], name, parent, place, joints.get(joint), column))
    resting = np.array([_resting(joints[name], kinds[name], name) for name in moving])
    return Robot(tuple(made), tuple(moving), resting, {}, mimics=_mimics(joints, moving))


def _named(root: Element, tag: str) -> dict[str, Element]:
    """Return the elements directly below the root by their names, which must differ."""
    named: dict[str, Element] = {}
    for element in root.findall(tag):
        name = element.get("name")
        if not name or name in named:
            raise CharacterError(f"a <{tag}> has {'no name' if not name else f'the name of another, {quote(name)}'}")
        named[name] = element
    return named


def _tree(links: dict[str, Element], joints: dict[str, Element]) -> dict[str, tuple[str | None, str]]:
    """Return each link, parents first, with its parent and the joint between both; None and "" for the root."""
    below: dict[str, list[tuple[str, str]]] = {}
    children: set[str] = set()
    for name, joint in joints.items():
        ends = []
        for tag in ("parent", "child"):
            end = joint.find(tag)
            ends.append("" if end is None else end.get("link", ""))
            if ends[-1] not in links:
                raise CharacterError(f"the {tag} of joint {quote(name)} is {quote(ends[-1])}, which is not a link")
        parent, child = ends
        if child in children:
            raise CharacterError(f"link {quote(child)} has two parents: links must be a tree")
        children.add(child)
        below.setdefault(parent, []).append((child, name))
    roots = [name for name in links if name not in children]
    if len(roots) > 1:
        raise CharacterError(f"it has {len(roots)} links without a parent, such as {quote(roots[1])}: keep one robot")
    tree: dict[str, tuple[str | None, str]] = {root: (None, "") for root in roots}
    left = list(roots)
    while left:
        parent = left.pop(0)
        for link, joint_above in below.get(parent, []):
            tree[link] = (parent, joint_above)
            left.append(link)
    if len(tree) < len(links):
        raise CharacterError("its links form a cycle")
    return tree


def _kind(joint: Element, name: str) -> str:
    kind = joint.get("type", "")
    if kind not in _KINDS:
        raise CharacterError(f"joint {quote(name)} is {quote(kind)}; joints that are read are {', '.join(_KINDS)}")
    return kind


def _link(element: Element, name: str, parent: Link | None, above: int, joint: Element | None, column: int) -> Link:
    place, turn = (np.zeros(3), np.eye(3)) if parent is None else (parent.place, parent.turn)
    hinges: tuple[Hinge, ...] = ()
    if joint is not None:
        joint_name = joint.get("name", "")
        place, turn = _posed(place, turn, joint.find("origin"), f"joint {quote(joint_name)}")
        if joint.get("type") in _HINGES:
            hinges = (_hinge(joint, joint_name, place, turn, column),)
    shape = _shape(element, place, turn, f"link {quote(name)}")
    return Link(name, above, turn, place, hinges, shape, _mass_shape(element, place, turn, f"link {quote(name)}"))


def _posed(
    place: Float[np.ndarray, " 3"], turn: Float[np.ndarray, "3 3"], origin: Element | None, name: str
) -> tuple[np.ndarray, np.ndarray]:
    """Return a place and turn further on by an `<origin>`."""
    from scipy.spatial.transform import Rotation  # imported late: it is slow to import

    if origin is None:
        return place, turn
    xyz, rpy = (
        numbers(origin, "xyz", (3,), f"the origin of {name}"),
        numbers(origin, "rpy", (3,), f"the origin of {name}"),
    )
    place = place if xyz is None else place + turn @ xyz
    return place, turn if rpy is None else turn @ Rotation.from_euler("xyz", rpy).as_matrix()


def _hinge(joint: Element, name: str, place: np.ndarray, turn: np.ndarray, column: int) -> Hinge:
    said = f"joint {quote(name)}"
    axis_element, limit = joint.find("axis"), joint.find("limit")
    axis = None if axis_element is None else numbers(axis_element, "xyz", (3,), f"the axis of {said}")
    axis = np.array([1.0, 0.0, 0.0]) if axis is None else unit(axis, "the axis", said)
    lower, upper, speed = -np.inf, np.inf, 0.0
    if limit is not None:
        speed = number(limit, "velocity", 0.0, f"the limit of {said}")
        if joint.get("type") == "revolute":
            lower, upper = _range(limit, said)
    mimics = joint.find("mimic") is not None
    return Hinge(name, turn @ axis, place, lower, upper, speed_limit(speed), column, mimics=mimics)


def _range(limit: Element, said: str) -> tuple[float, float]:
    lower, upper = (number(limit, end, 0.0, f"the limit of {said}") for end in ("lower", "upper"))
    if lower > upper:
        raise CharacterError(f"the limits of {said} are {lower:g} and {upper:g}: the lower one comes first")
    return lower, upper


def _resting(joint: Element, kind: str, name: str) -> float:
    """Return the value of a joint that nothing moves: 0 if its limits allow that."""
    limit = joint.find("limit")
    if limit is None or kind == "continuous":
        return 0.0
    lower, upper = _range(limit, f"joint {quote(name)}")
    return float(np.clip(0.0, lower, upper))


def _mimics(joints: dict[str, Element], moving: list[str]) -> tuple[Mimic, ...]:
    found = []
    for column, name in enumerate(moving):
        mimic, limit = joints[name].find("mimic"), joints[name].find("limit")
        if mimic is None:
            continue
        said, leader = f"the mimic of joint {quote(name)}", mimic.get("joint", "")
        if leader not in moving or joints[leader].find("mimic") is not None:
            raise CharacterError(f"{said} is {quote(leader)}, which is not a joint that moves by itself")
        lower, upper = (-np.inf, np.inf) if limit is None else _range(limit, f"joint {quote(name)}")
        ratio, offset = number(mimic, "multiplier", 1.0, said), number(mimic, "offset", 0.0, said)
        found.append(Mimic(column, moving.index(leader), ratio, offset, lower, upper))
    return tuple(found)


def _shape(link: Element, place: np.ndarray, turn: np.ndarray, said: str) -> Float[np.ndarray, "2 3"] | None:
    """Return the bounds of the collision shapes that are no meshes, or, without any, of the visual ones."""
    for kind in ("collision", "visual"):
        bounds = []
        for element in link.findall(kind):
            at, turned = _posed(place, turn, element.find("origin"), said)
            half = _half(element.find("geometry"), said)
            bounds += [] if half is None else [box_bounds(at, turned, half)]
        if bounds:
            return enclose(bounds)
    return None


def _half(geometry: Element | None, said: str) -> Float[np.ndarray, " 3"] | None:
    """Return half the sides of the box around a shape, None for a mesh or no shape."""
    for shape in geometry if geometry is not None else ():
        if shape.tag == "box":
            size = numbers(shape, "size", (3,), f"the box of {said}")
            return None if size is None else np.abs(size) / 2
        radius = number(shape, "radius", 0.0, f"the shape of {said}")
        if shape.tag == "sphere":
            return np.full(3, abs(radius))
        if shape.tag in ("cylinder", "capsule"):
            half = number(shape, "length", 0.0, f"the shape of {said}") / 2
            return np.abs([radius, radius, half + (radius if shape.tag == "capsule" else 0.0)])
    return None


def _mass_shape(link: Element, place: np.ndarray, turn: np.ndarray, said: str) -> Float[np.ndarray, "2 3"] | None:
    inertial = link.find("inertial")
    mass, inertia = (None, None) if inertial is None else (inertial.find("mass"), inertial.find("inertia"))
    if inertial is None or mass is None or inertia is None:
        return None
    at, turned = _posed(place, turn, inertial.find("origin"), f"the inertial of {said}")
    diagonal = [number(inertia, name, 0.0, f"the inertia of {said}") for name in ("ixx", "iyy", "izz")]
    half = inertia_box(number(mass, "value", 0.0, f"the mass of {said}"), np.diag(diagonal))
    return None if half is None else box_bounds(at, turned, half)
