"""The tree of a robot's nodes as a person's: joints where several hinges meet, joints that the robot lacks, the pelvis
as the root.

Knows places at rest in the file's axes; knows no motion.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from stmc.formats.characters.gltf_file import CharacterError
from stmc.formats.characters.robot import enclose
from stmc.formats.characters.robot_pieces import Pieces
from stmc.motion.retargeting.rig import LIMBS, NEEDED, SIDES, ancestors

_HEAD = 0.21
"""The height of our head's joint above the shoulders, in lengths of the arm."""
_FOREARM = 0.92
"""The length of our forearm, in lengths of the upper arm."""
_CHAINS = ((*LIMBS[0], "foot"), ("collar", *LIMBS[1]))
_ADDED = ("head", "left_wrist", "right_wrist")
"""Joints that a robot may lack."""


@dataclass(eq=False)
class RobotTree:
    """Nodes that stand where joints of ours are; lists grow as joints are added."""

    pieces: Pieces
    names: list[str]
    parents: list[int]
    places: list[Float[np.ndarray, " 3"]]
    movers: list[int]
    """For each node, the node of the hinge that moves its place; -1: none."""
    turners: list[int]
    """For each node, the node of the hinge that turns it; -1: none."""
    joints: dict[str, int]
    origins: list[int]
    """For each node, that of the robot that it is, or that carries it."""

    @classmethod
    def of(cls, pieces: Pieces, joints: Mapping[str, int]) -> RobotTree:
        """Return the tree whose joints of ours are `joints`, with those that it lacks.

        Raises `CharacterError` if a joint is missing that cannot be added.
        """
        count = range(len(pieces.names))
        tree = cls(
            pieces,
            list(pieces.names),
            list(pieces.parents),
            list(pieces.places),
            [pieces.above(node) for node in count],
            list(pieces.movers),
            dict(joints),
            list(count),
        )
        missing = [joint for joint in NEEDED if joint not in joints and joint not in _ADDED]
        if missing:
            raise CharacterError(f"no joint was found for {', '.join(missing)}; name them in a joint map")
        for side in SIDES:
            if tree.joints.get(f"{side}_foot") == tree.joints[f"{side}_ankle"]:
                del tree.joints[f"{side}_foot"]
        tree._place()
        for side in SIDES:
            tree._end_arm(side)
        tree._crown()
        tree._hang_from_pelvis()
        return tree

    def at(self, joint: str) -> Float[np.ndarray, " 3"]:
        """Return the place of a joint of ours."""
        return self.places[self.joints[joint]]

    def middle(self, joint: str) -> Float[np.ndarray, " 3"]:
        """Return the middle between a left and a right joint."""
        return (self.at(f"left_{joint}") + self.at(f"right_{joint}")) / 2

    def add(self, joint: str, parent: int, place: Float[np.ndarray, " 3"]) -> None:
        """Add a joint of ours that is rigid with a node, and has its name."""
        self.joints[joint] = len(self.names)
        self.names.append(self.names[parent])
        self.parents.append(parent)
        self.places.append(place)
        self.movers.append(self.turners[parent])
        self.turners.append(self.turners[parent])
        self.origins.append(self.origins[parent])

    def _place(self) -> None:
        """Put each joint where its hinges meet."""
        for chain in (("head",), *(tuple(f"{side}_{joint}" for joint in chain) for chain in _CHAINS for side in SIDES)):
            before: list[int] = []
            for joint in chain:
                if joint not in self.joints:
                    continue
                node = self.joints[joint]
                nodes = [each for each in self.pieces.joint(node) if each not in before]
                if nodes:
                    self.places[node] = self.pieces.centre(nodes)
                    self.movers[node] = self.pieces.above(nodes[0])
                before = ancestors(self.parents, node)

    def _end_arm(self, side: str) -> None:
        """Add a wrist at the end of a forearm that ends in none, or in the elbow."""
        elbow = self.joints[f"{side}_elbow"]
        if self.joints.get(f"{side}_wrist", elbow) != elbow:
            return
        link = self.pieces.link(elbow)
        shape = enclose([each for each in (link.shape, link.mass_shape) if each is not None][:1])
        if shape is None:
            raise CharacterError(
                f"no joint was found for {side}_wrist, and its forearm has no mesh: name it in a joint map"
            )
        upper = float(np.linalg.norm(self.places[elbow] - self.at(f"{side}_shoulder")))
        along = shape.mean(axis=0) - self.places[elbow]
        self.add(
            f"{side}_wrist", elbow, self.places[elbow] + along / max(np.linalg.norm(along), 1e-9) * upper * _FOREARM
        )

    def _crown(self) -> None:
        """Add a head to a robot that has none, and raise one that is lower than ours."""
        shoulders = self.middle("shoulder")
        arm = sum(
            float(np.linalg.norm(self.at(f"left_{above}") - self.at(f"left_{below}")))
            for above, below in itertools.pairwise(LIMBS[1])
        )
        rise = shoulders - self.middle("ankle")
        axis = int(np.abs(rise).argmax())
        up = np.eye(3)[axis] * np.sign(rise[axis])
        lines = [ancestors(self.parents, self.joints[f"{side}_shoulder"]) for side in SIDES]
        shared = [node for node in lines[0] if node in lines[1]]
        if not shared:
            raise CharacterError("its arms hang from different roots, so no link is the chest")
        crown = shoulders + up * (_HEAD * arm)
        head = self.joints.get("head", shared[0])
        if head in shared:
            self.add("head", shared[0], crown)
        elif (self.places[head] - crown) @ up < 0:
            below = (self.places[head] - shoulders) @ up < 0
            self.places[head] = crown if below else self.places[head] + up * ((crown - self.places[head]) @ up)

    def _hang_from_pelvis(self) -> None:
        """Turn a tree around in which legs hang from the chest, so that the link that carries the legs is the root."""
        lines = [ancestors(self.parents, self.joints[f"{side}_hip"]) for side in SIDES]
        shared = [node for node in lines[0] if node in lines[1]]
        if not shared or shared[0] in ancestors(self.parents, self.joints["left_shoulder"]):
            return
        self.joints["pelvis"] = shared[0]
        places = [self.places[node] for node in shared]
        for number, (lower, upper) in enumerate(itertools.pairwise(shared)):
            self.parents[upper] = lower
            self.places[upper], self.movers[upper] = places[number], self.turners[upper]
        self.parents[shared[0]] = -1
        self._sort()

    def _sort(self) -> None:
        """Bring parents before their children."""
        order = sorted(range(len(self.names)), key=lambda node: len(ancestors(self.parents, node)))
        new = {node: number for number, node in enumerate(order)} | {-1: -1}
        self.names = [self.names[node] for node in order]
        self.places = [self.places[node] for node in order]
        self.movers = [self.movers[node] for node in order]
        self.turners = [self.turners[node] for node in order]
        self.origins = [self.origins[node] for node in order]
        self.parents = [new[self.parents[node]] for node in order]
        self.joints = {joint: new[node] for joint, node in self.joints.items()}
