"""Identify the joints of a robot with those of SMPL: by the names of hinges and links, else by the robot's shape."""

from __future__ import annotations

import numpy as np

from stmc.formats.characters.joint_names import robot_words
from stmc.formats.characters.joint_shapes import joints_by_shape
from stmc.formats.characters.robot_pieces import Pieces
from stmc.motion.retargeting.rig import SIDES, ancestors

_WORDS = {
    "collar": "clavicle collar",
    "shoulder": "shoulder sho sh shx shy shz upperarm uarm humerus",
    "elbow": "elbow el elx ely elz elb elbj forearm lowerarm larm radius",
    "wrist": "wrist wri wrx wry wrz hand palm gripper",
    "hip": "hip hpx hpy hpz thigh upperleg uleg femur",
    "knee": "knee kny shin calf lowerleg lleg tibia",
    "ankle": "ankle ank akx aky foot sole",
    "foot": "toes toe ball",
}
_NEEDED = ("hip", "knee", "ankle", "shoulder", "elbow")
_HEADS = ("head", "neck")
_GRIPPER = 0.6
"""The length of a hand up to the hinge of its gripper, as a share of the forearm."""
_WRIST = 0.05
"""The distance of a hinge that turns the hand from the elbow that its axis meets, as a share of the robot's size."""


def identify_joints(pieces: Pieces) -> tuple[str, dict[str, int]]:
    """Map joints of SMPL to nodes of a robot; also return, for messages, what identified them."""
    joints = _by_name(pieces)
    if all(f"{side}_{joint}" in joints for side in SIDES for joint in _NEEDED):
        return "the joints' names", joints
    return "the robot's shape", _by_shape(pieces)


def _by_name(pieces: Pieces) -> dict[str, int]:
    """Map joints to the last node that bears their name. Names of hinges take precedence over names of links."""
    hinged = [number for number, hinge in enumerate(pieces.hinges) if hinge is not None]
    links = [pieces.link(node).name for node in range(len(pieces.names))]
    known: dict[tuple[str | None, str], int] = {}
    for names, nodes in ((pieces.names, hinged), (links, range(len(links)))):
        named: dict[tuple[str | None, str], int] = {}
        for node in nodes:
            side, words = robot_words(names[node])
            named |= {(side, word): node for word in words}
            named |= {(None, word): node for word in words if word in _HEADS}
        known = named | known
    joints = {
        f"{side}_{joint}": next((known[side, word] for word in words.split() if (side, word) in known), None)
        for side in SIDES
        for joint, words in _WORDS.items()
    }
    joints["head"] = next((known[None, word] for word in _HEADS if (None, word) in known), None)
    return {joint: node for joint, node in joints.items() if node is not None}


def _by_shape(pieces: Pieces) -> dict[str, int]:
    """Map joints to nodes by the shape of the tree whose vertices are groups of adjacent hinges."""
    if not pieces.joints:
        return {}
    roots = [ancestors(pieces.parents, joint[0])[-1] for joint in pieces.joints]
    root = max(set(roots), key=roots.count)
    chosen = [joint for joint, top in zip(pieces.joints, roots, strict=True) if top == root]
    chosen = [part for joint in chosen if not _is_gripper(pieces, joint) for part in _apart(pieces, joint)]
    numbers = {node: number for number, joint in enumerate(chosen, start=1) for node in joint}
    parents = [-1, *(numbers.get(pieces.above(joint[0]), 0) for joint in chosen)]
    places = np.stack([pieces.places[root], *(pieces.centre(joint) for joint in chosen)])
    upright = places[:, [1, 2, 0]]  # robots look along x with z up; shapes are looked at along z with y up
    found = joints_by_shape(parents, upright, list(range(len(parents))))
    return {joint: chosen[number - 1][-1] if number else root for joint, number in found.items()}


def _is_gripper(pieces: Pieces, joint: tuple[int, ...]) -> bool:
    """Return whether a joint is a gripper: a single hinge at the end of a limb, close to a joint of several hinges."""
    above = pieces.joint(pieces.above(joint[0])) if pieces.above(joint[0]) >= 0 else ()
    ends = not any(pieces.above(other[0]) == joint[-1] for other in pieces.joints)
    if len(joint) > 1 or len(above) < 2 or not ends or pieces.above(above[0]) < 0:
        return False
    before = pieces.centre(pieces.joint(pieces.above(above[0])))
    place = pieces.centre(above)
    return bool(np.linalg.norm(pieces.centre(joint) - place) < _GRIPPER * np.linalg.norm(place - before))


def _apart(pieces: Pieces, joint: tuple[int, ...]) -> list[tuple[int, ...]]:
    """Split off the last hinge of a joint if the joint ends a limb and that hinge is far from the others."""
    ends = not any(pieces.above(other[0]) == joint[-1] for other in pieces.joints)
    away = np.linalg.norm(pieces.places[joint[-1]] - pieces.centre(joint))
    if len(joint) < 2 or not ends or away < _WRIST * np.ptp(pieces.places, axis=0).max():
        return [joint]
    return [joint[:-1], joint[-1:]]
