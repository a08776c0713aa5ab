"""Skeletons that a program has in memory: their joints at rest, and motions of them as keys.

Depends on characters and rigs; independent of files. Keys are turns from the rest pose in the skeleton's own axes, so
that roll and axes of the program's bones do not matter.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np
import torch
from jaxtyping import Float

from stmc.formats.axes import Z_UP_TO_Y_UP, continued
from stmc.formats.characters.characters import Character, CharacterMotion, character_of_joints
from stmc.formats.characters.gltf_file import MOST_JOINTS, MOST_METRES, CharacterError
from stmc.io.untrusted import quote
from stmc.motion.geometry import matrix_to_quaternion

Up = Literal["y", "z"]
"""The axis of a skeleton that points up; axes are right-handed."""

_TO_Y_UP: Mapping[Up, Float[np.ndarray, "3 3"]] = {"y": np.eye(3), "z": Z_UP_TO_Y_UP}


class RestJoint(NamedTuple):
    """A joint at rest: its name, its parent's (None: a root), and its position, in any unit."""

    name: str
    parent: str | None
    place: Sequence[float]


@dataclass(frozen=True)
class RestSkeleton:
    """Joints at rest, in any order.

    Raises `CharacterError` for no or too many joints, for two of one name, an unknown parent, a cycle, and positions
    that are not finite or too far from the origin.
    """

    joints: tuple[RestJoint, ...]
    up: Up = "y"

    def __post_init__(self) -> None:
        if not 0 < len(self.joints) <= MOST_JOINTS:
            raise CharacterError(f"a skeleton of {len(self.joints):,} joints; it must have 1 to {MOST_JOINTS:,}")
        names = set()
        for joint in self.joints:
            if joint.name in names:
                raise CharacterError(f"two joints are called {quote(joint.name)}")
            names.add(joint.name)
            if len(joint.place) != 3 or not all(abs(value) <= MOST_METRES for value in joint.place):
                raise CharacterError(
                    f"the place of {quote(joint.name)} is {quote(list(joint.place))}: three numbers up to "
                    f"{MOST_METRES:g} needed"
                )
        for joint in self.joints:
            if joint.parent is not None and joint.parent not in names:
                raise CharacterError(f"the parent of {quote(joint.name)} is {quote(joint.parent)}, which is no joint")

    def character(self, joint_map: Mapping[str, str | None] | None = None) -> Character:
        """Return the skeleton as a character. Raises `CharacterError` if it is not a person's.

        Args:
            joint_map: As in `read_character`.
        """
        joints = self._parents_first()
        indices = {joint.name: index for index, joint in enumerate(joints)}
        parents = [-1 if joint.parent is None else indices[joint.parent] for joint in joints]
        places = np.array([joint.place for joint in joints], dtype=float) @ _TO_Y_UP[self.up].T
        return character_of_joints([joint.name for joint in joints], parents, places, joint_map)

    def _parents_first(self) -> list[RestJoint]:
        children: dict[str | None, list[RestJoint]] = {}
        for joint in self.joints:
            children.setdefault(joint.parent, []).append(joint)
        ordered = list(children.get(None, []))
        for joint in ordered:  # grows while it is read
            ordered += children.get(joint.name, [])
        if len(ordered) < len(self.joints):
            raise CharacterError("its joints form a cycle")
        return ordered


@dataclass(frozen=True, eq=False)
class SkeletonKeys:
    """A motion of a skeleton, in its own axes and unit."""

    travelling: str
    """Name of the joint that travels."""
    places: Float[np.ndarray, "frames 3"]
    """Its positions."""
    turns: Mapping[str, Float[np.ndarray, "frames 4"]]
    """Of each joint that moves: its turns from the rest pose, as quaternions w x y z, along the skeleton's axes. The
    others follow the joints above them."""


def skeleton_keys(moved: CharacterMotion, up: Up) -> SkeletonKeys:
    """Return the keys of a motion of a character that `RestSkeleton.character` has made.

    Args:
        moved: Motion of the character.
        up: Axis of the skeleton that points up.
    """
    motion, rig = moved.motion, moved.motion.rig
    turn = moved.character.standing.turn @ _TO_Y_UP[up]  # from the skeleton's axes to the rig's
    turned = torch.from_numpy(turn.T @ motion.turns.numpy() @ turn)
    quaternions = continued(matrix_to_quaternion(turned))
    turns = {rig.names[node]: quaternions[:, place] for place, node in enumerate(rig.driven)}
    return SkeletonKeys(rig.names[rig.joints["pelvis"]], motion.places[:, rig.place("pelvis")].numpy() @ turn, turns)
