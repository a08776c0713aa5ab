"""Robots as characters: a rig with hinges, and tables of the values that pose the robot."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float

from stmc.formats.axes import continued
from stmc.formats.characters.gltf_file import CharacterError
from stmc.formats.characters.robot import Hinge, Robot
from stmc.formats.characters.robot_pieces import Pieces
from stmc.formats.characters.robot_soles import Soles, soles_of
from stmc.formats.characters.robot_tree import RobotTree
from stmc.formats.characters.upright import Standing, upright_turn
from stmc.io.untrusted import quote
from stmc.motion.retargeting import Rig, RigError, RigMotion
from stmc.motion.retargeting.linkage import Linkage
from stmc.motion.retargeting.rig import SIDES, ancestors

FPS = 50
"""Frames per second of a robot's motion unless another rate is chosen: the rate of most walking controllers."""
_FACING = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
"""From our world, in which rest poses face -y, to that of robots, in which they face x."""
_BASE = ("x", "y", "z", "qw", "qx", "qy", "qz")


@dataclass(frozen=True, eq=False)
class RobotRig:
    """A robot whose joints are known."""

    robot: Robot
    names: tuple[str, ...]
    """The nodes of its tree: hinges, links without hinges, and joints of ours that it lacks."""
    base: int
    """The link that its pelvis is, or hangs from."""
    hinges: tuple[Hinge, ...]
    """The hinges of its rig's linkage."""

    formats = (".csv",)
    fps = FPS

    def content(self, suffix: str, motion: RigMotion, standing: Standing) -> bytes:
        """Return a table: a line of names, then for each frame its time and the row of values.

        The row is MuJoCo's `qpos`: the base's place (m) on a floor at 0 and its quaternion w x y z, then the joints
        (rad) in the file's order. What is not driven keeps its value at rest.
        """
        rows, names = self._rows(motion, standing), list(self.robot.columns)
        if self.base not in self.robot.bases:
            names = [f"{self.robot.links[self.base].name}_{axis}" for axis in _BASE] + names
        text = io.BytesIO()
        times = np.arange(len(rows))[:, None] / motion.fps
        header = ",".join(["time", *(_plain(name) for name in names)])
        np.savetxt(
            text, np.concatenate([times, rows], axis=1), "%.6f", ",", header=header, comments="", encoding="utf-8"
        )
        return text.getvalue()

    def _rows(self, motion: RigMotion, standing: Standing) -> Float[np.ndarray, "frames values"]:
        from scipy.spatial.transform import Rotation  # imported late: it is slow to import

        assert motion.curves is not None, "a robot's motion has angles"
        rows = np.tile(self.robot.resting, (len(motion.curves.angles), 1))
        turns = dict(zip(self.hinges, motion.curves.angles.T, strict=True))
        for link in self.robot.links:
            local = [
                (hinge, turns.get(hinge, np.full(len(rows), np.clip(0.0, hinge.lower, hinge.upper))))
                for hinge in link.hinges
            ]
            for hinge, angles in local:
                if hinge.column not in self.robot.balls:
                    rows[:, hinge.column] = hinge.zero + angles
            for column in {hinge.column for hinge in link.hinges} & set(self.robot.balls):
                euler = np.stack([angles for hinge, angles in local if hinge.column == column], axis=1)
                rows[:, column : column + 4] = _continued(Rotation.from_euler("XYZ", euler).as_quat())
        for mimic in self.robot.mimics:
            followed = mimic.ratio * rows[:, mimic.leader] + mimic.offset
            rows[:, mimic.column] = np.clip(followed, mimic.lower, mimic.upper)
        base = self._base(motion, standing)
        first = self.robot.bases.get(self.base)
        if first is None:
            return np.concatenate([base, rows], axis=1)
        rows[:, first : first + 7] = base
        return rows

    def _base(self, motion: RigMotion, standing: Standing) -> Float[np.ndarray, "frames 7"]:
        """Return the base's place and quaternion in a world of robots, with the floor at 0."""
        from scipy.spatial.transform import Rotation  # imported late: it is slow to import

        assert motion.curves is not None
        link, curves = self.robot.links[self.base], motion.curves
        rest = standing.turn @ link.place - np.array([0.0, 0.0, standing.floor])
        places = (curves.turns @ rest + curves.places) @ _FACING.T
        turns = _FACING @ curves.turns @ standing.turn @ link.turn
        return np.concatenate([places, _continued(Rotation.from_matrix(turns).as_quat())], axis=1)


def _continued(quaternions: Float[np.ndarray, "frames 4"]) -> Float[np.ndarray, "frames 4"]:
    """Turn quaternions x y z w into w x y z without changes of sign."""
    return continued(torch.from_numpy(quaternions[:, None, [3, 0, 1, 2]]))[:, 0]


def _plain(name: str) -> str:
    """Return a name as a column's: without commas, quotes and line breaks."""
    return "".join(letter if letter.isprintable() and letter not in ',"' else "_" for letter in name)


def rig_robot(pieces: Pieces, joints: Mapping[str, int]) -> tuple[RobotRig, Rig, Standing]:
    """Return a robot with these joints of ours as a character's body, its rig, and how it stands.

    Raises `CharacterError` if a joint is missing or does not hang where a person's does.
    """
    tree = RobotTree.of(pieces, joints)
    turn = upright_turn(np.stack(tree.places), tree.joints)
    soles = soles_of(tree, turn)
    _add_toes(tree, soles, turn)
    floor = np.array([0.0, 0.0, soles.floor])
    rest = torch.from_numpy(np.stack(tree.places) @ turn.T - floor)
    try:
        rig = Rig.mapped(tree.names, tree.parents, rest, tree.joints)
    except RigError as error:
        raise CharacterError(str(error)) from None
    hinges = _driving(tree, rig)
    linkage = _linkage(tree, hinges, turn, soles)
    nodes = [hinge for hinge in (pieces.hinges[node] for node in hinges) if hinge is not None]
    top = ancestors(pieces.parents, hinges[0])[-1]
    body = RobotRig(pieces.robot, tuple(tree.names), pieces.links[top], tuple(nodes))
    return body, replace(rig, linkage=linkage), Standing(turn, soles.floor)


def _add_toes(tree: RobotTree, soles: Soles, turn: np.ndarray) -> None:
    """Add toes at the front of feet that are in one piece."""
    for side in SIDES:
        ankle = tree.joints[f"{side}_ankle"]
        if tree.joints.get(f"{side}_foot", ankle) == ankle:
            corners = soles.corners[[node == ankle for node in soles.nodes]]
            front = corners[corners[:, 1].argsort()[:2]].mean(axis=0)
            tree.add(f"{side}_foot", ankle, turn.T @ front)


def _driving(tree: RobotTree, rig: Rig) -> list[int]:
    """Return the nodes of the hinges that turn or move the rig's driven nodes, parents first."""
    pieces, found = tree.pieces, set()
    for node in rig.driven:
        turner = tree.turners[node]
        while turner >= 0:
            found.add(turner)
            turner = pieces.above(turner)
    for node in found:
        hinge = pieces.hinges[node]
        if hinge is not None and hinge.mimics:
            raise CharacterError(f"joint {quote(hinge.name)} mimics another, which is not read within limbs and trunk")
    if not found:
        raise CharacterError("no hinge moves its limbs")
    return sorted(found)


def _linkage(tree: RobotTree, nodes: Sequence[int], turn: np.ndarray, soles: Soles) -> Linkage:
    pieces = tree.pieces
    numbers = {node: number for number, node in enumerate(nodes)}
    hinges = [hinge for hinge in (pieces.hinges[node] for node in nodes) if hinge is not None]
    floor = np.array([0.0, 0.0, soles.floor])
    return Linkage(
        tuple(numbers.get(pieces.above(node), -1) for node in nodes),
        np.stack([turn @ hinge.axis for hinge in hinges]),
        np.stack([turn @ hinge.anchor for hinge in hinges]) - floor,
        np.array([hinge.lower for hinge in hinges]),
        np.array([hinge.upper for hinge in hinges]),
        np.array([hinge.speed for hinge in hinges]),
        np.array([numbers.get(node, -1) for node in tree.movers]),
        np.array([numbers.get(node, -1) for node in tree.turners]),
        soles.corners - floor,
        np.array(soles.nodes),
    )
