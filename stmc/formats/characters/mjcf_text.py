"""The text of MuJoCo models (MJCF): includes, defaults and the compiler's settings. Knows no robot.

A model may include files of its own folder and of folders in it, and none other.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np
from jaxtyping import Float

from stmc.formats.characters.gltf_file import CharacterError
from stmc.formats.characters.robot_xml import MOST_ELEMENTS, numbers, read_xml, unit
from stmc.io.untrusted import quote, truncate

_MOST_INCLUDES = 50
_MAIN = "main"
_WITH_DEFAULTS = ("joint", "geom")


@dataclass(frozen=True, eq=False)
class Mjcf:
    """A model with its includes in place."""

    sections: tuple[Element, ...]
    """The elements below <mujoco>."""
    degrees: bool
    """Whether angles are in degrees."""
    euler: str
    """The axes of its Euler angles; small letters turn with the body."""
    autolimits: bool
    """Whether a joint with a range and without `limited` is limited."""
    classes: Mapping[str, Mapping[str, Mapping[str, str]]] = field(default_factory=dict)
    """The default attributes of joints and geoms in each class."""

    @classmethod
    def read(cls, path: Path) -> Mjcf:
        """Read a model. Raise `CharacterError` for a file that is none, and for includes from elsewhere."""
        root = read_xml(path)
        if root.tag != "mujoco":
            raise CharacterError(f"its outermost element is <{truncate(root.tag)}>; an MJCF model begins with <mujoco>")
        _include(root, path.parent, set())
        if sum(1 for _ in root.iter()) > MOST_ELEMENTS:
            raise CharacterError(f"more than {MOST_ELEMENTS:,} elements")
        settings = {name: value for element in root.findall("compiler") for name, value in element.attrib.items()}
        if settings.get("coordinate", "local") != "local":
            raise CharacterError("its coordinates are global, but MuJoCo supports only local ones")
        euler = settings.get("eulerseq", "xyz")
        if len(euler) != 3 or not set(euler) <= set("xyzXYZ") or euler not in (euler.lower(), euler.upper()):
            raise CharacterError(f"eulerseq of its compiler is {quote(euler)}, not an order of axes such as xyz or XYZ")
        degrees = settings.get("angle", "degree") != "radian"
        classes: dict[str, dict[str, dict[str, str]]] = {_MAIN: {name: {} for name in _WITH_DEFAULTS}}
        for element in root.findall("default"):
            _add_defaults(classes, element, _MAIN, _MAIN)
            classes.setdefault(element.get("class", _MAIN), classes[_MAIN])
        return cls(tuple(root), degrees, euler, settings.get("autolimits", "true") != "false", classes)

    def attributes(self, element: Element, around: str | None) -> Element:
        """Return a joint or geom with its defaults filled in, in the class that is `around` it if it names none."""
        name = element.get("class", around or _MAIN)
        if name not in self.classes:
            raise CharacterError(f"the class {quote(name)} of a {element.tag} has no defaults")
        return Element(element.tag, {**self.classes[name].get(element.tag, {}), **element.attrib})

    def angle(self, value: float) -> float:
        """Return an angle of the file in radians."""
        return float(np.radians(value)) if self.degrees else value

    def orientation(self, element: Element, place: str) -> Float[np.ndarray, "3 3"]:
        """Return the rotation that an element's `quat`, `axisangle`, `xyaxes`, `zaxis` or `euler` describes."""
        from scipy.spatial.transform import Rotation  # imported late: it is slow to import

        if (quat := numbers(element, "quat", (4,), place)) is not None:
            if not np.linalg.norm(quat) > 1e-9:
                raise CharacterError(f"quat of {place} is {quote(quat.tolist())}, which is not a rotation")
            return Rotation.from_quat(quat[[1, 2, 3, 0]]).as_matrix()
        if (turn := numbers(element, "axisangle", (4,), place)) is not None:
            return Rotation.from_rotvec(unit(turn[:3], "axisangle", place) * self.angle(turn[3])).as_matrix()
        if (axes := numbers(element, "xyaxes", (6,), place)) is not None:
            first = unit(axes[:3], "xyaxes", place)
            second = unit(axes[3:] - first * (first @ axes[3:]), "xyaxes", place)
            return np.stack([first, second, np.cross(first, second)], axis=1)
        if (axis := numbers(element, "zaxis", (3,), place)) is not None:
            return turn_from_z(unit(axis, "zaxis", place))
        if (euler := numbers(element, "euler", (3,), place)) is not None:
            order = (
                self.euler.upper() if self.euler.islower() else self.euler.lower()
            )  # scipy's letters are the other way
            return Rotation.from_euler(order, [self.angle(each) for each in euler]).as_matrix()
        return np.eye(3)


def turn_from_z(axis: Float[np.ndarray, " 3"]) -> Float[np.ndarray, "3 3"]:
    """Return the smallest rotation that brings z to an axis of length 1."""
    from scipy.spatial.transform import Rotation  # imported late: it is slow to import

    cross = np.array([-axis[1], axis[0], 0.0])
    length = np.linalg.norm(cross)
    if length < 1e-12:
        return np.eye(3) if axis[2] > 0 else np.diag([1.0, -1.0, -1.0])
    return Rotation.from_rotvec(cross / length * np.arctan2(length, axis[2])).as_matrix()


def _include(element: Element, folder: Path, known: set[Path]) -> None:
    """Put the elements of included files in the place of their <include>, in all that is below an element."""
    for number, child in reversed(list(enumerate(element))):
        if child.tag != "include":
            _include(child, folder, known)
            continue
        name = child.get("file", "")
        path = _inside(folder, name)
        if path in known or len(known) >= _MOST_INCLUDES:
            raise CharacterError(f"it includes {quote(name)} more than once, or more than {_MOST_INCLUDES} files")
        known.add(path)
        try:
            included = read_xml(path)
        except OSError:
            raise CharacterError(f"it includes {quote(name)}, which is not there") from None
        except CharacterError as error:
            raise CharacterError(f"{quote(name)}, which it includes: {error}") from None
        _include(included, folder, known)
        element[number : number + 1] = list(included)


def _inside(folder: Path, name: str) -> Path:
    """Return the path of an included file. Raise `CharacterError` for one outside the model's folder."""
    try:
        path, home = (folder / name).resolve(), folder.resolve()
    except (OSError, ValueError, RuntimeError):
        raise CharacterError(f"it includes {quote(name)}, which is not a valid path") from None
    if not name or not path.is_relative_to(home):
        raise CharacterError(f"it includes {quote(name)}, which is not in the model's folder: put it there")
    return path


def _add_defaults(classes: dict[str, dict[str, dict[str, str]]], element: Element, name: str, above: str) -> None:
    """Add the class of a <default> and those in it, each with the attributes of the class above it."""
    own = {tag: dict(classes[above][tag]) for tag in _WITH_DEFAULTS} if name != above else classes[name]
    for child in element:
        if child.tag in _WITH_DEFAULTS:
            own[child.tag] |= child.attrib
    classes[name] = own
    for child in nested(element, "default"):
        _add_defaults(classes, child, child.get("class", _MAIN), name)


def nested(element: Element, *tags: str) -> Iterator[Element]:
    """Iterate over the elements directly below one that have one of these tags."""
    return (child for child in element if child.tag in tags)
