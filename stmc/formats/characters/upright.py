"""Convert characters from the axes of their files to those of rigs: z up, floor at 0, facing -y.

Up, front and floor follow from the rest positions of joints.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float

from stmc.formats.characters.gltf_file import CharacterError
from stmc.motion.retargeting.rig import NEEDED, Rig, RigError

_UPRIGHT = 0.8
"""Minimum cosine between an axis of the file and the vectors from the ankles to the hips and to the head."""
_SNAP = np.radians(20)
"""Maximum yaw from a quarter turn that is treated as asymmetry of the rest pose rather than as a rotation."""
_SOLE, _ANKLE = 0.2, 0.3
"""Maximum heights of toes and ankles, as fractions of the leg, at which the floor is the ground of the file."""
_BELOW = 0.02
"""Maximum depth of a toe below the ground of the file, as a fraction of the leg."""
_HEEL = 0.09
"""Default height of an ankle above the sole, as a fraction of the leg."""


@dataclass(frozen=True, eq=False)
class Standing:
    """Transform from the coordinates of the file to those of the rig: a rotation, then a shift to the floor."""

    turn: Float[np.ndarray, "3 3"]
    floor: float
    """Height of the floor after the rotation, in the unit of the file."""


def stand(
    names: Sequence[str],
    parents: Sequence[int],
    places: Float[np.ndarray, "nodes 3"],
    joints: Mapping[str, int],
    y_up: bool,
) -> tuple[Rig, Standing]:
    """Build a standing rig from joints at rest, and return it with the transform from the file.

    Args:
        names: Names of all nodes.
        parents: Parent of each node.
        places: Rest positions of the nodes.
        joints: Node of each joint.
        y_up: Whether the file must stand along y.

    Raises:
        CharacterError: If a joint is missing, or if the rest pose does not stand upright along an axis of the file, or,
            with `y_up`, along y.
    """
    missing = [joint for joint in NEEDED if joint not in joints]
    if missing:
        raise CharacterError(f"no joint was found for {', '.join(missing)}; name them in a joint map")
    turn = upright_turn(places, joints)
    if y_up and not (turn[2] == [0.0, 1.0, 0.0]).all():
        raise CharacterError("it does not stand along the y axis, which is up in glTF: turn it and apply the rotation")
    rest = places @ turn.T
    try:
        rig = Rig.mapped(names, parents, torch.from_numpy(rest), joints)
        floor = _floor(rig)
        lowered = torch.from_numpy(rest - np.array([0.0, 0.0, floor]))
        return Rig.mapped(names, parents, lowered, joints), Standing(turn, floor)
    except RigError as error:
        raise CharacterError(str(error)) from None


def upright_turn(places: Float[np.ndarray, "nodes 3"], joints: Mapping[str, int]) -> Float[np.ndarray, "3 3"]:
    """Return the turn from the file's axes to a rig's. Raise `CharacterError` unless the rest pose stands upright."""
    ankles, hips = ((places[joints[f"left_{end}"]] + places[joints[f"right_{end}"]]) / 2 for end in ("ankle", "hip"))
    rise, legs = places[joints["head"]] - ankles, hips - ankles
    axis = int(np.abs(rise).argmax())
    up = np.eye(3)[axis] * np.sign(rise[axis])
    if not all(way @ up > _UPRIGHT * np.linalg.norm(way) for way in (rise, legs)):
        raise CharacterError("its rest pose does not stand upright: pose it as a T or an A and make that the rest pose")
    left = sum(places[joints[f"left_{each}"]] - places[joints[f"right_{each}"]] for each in ("hip", "shoulder"))
    left = left - up * (left @ up)
    if not np.linalg.norm(left) > 1e-3 * np.linalg.norm(rise):
        raise CharacterError("its left and right hips and shoulders are at the same places")
    left = left / np.linalg.norm(left)
    nearest = np.eye(3)[int(np.abs(left).argmax())] * np.sign(left[int(np.abs(left).argmax())])
    if left @ nearest > np.cos(_SNAP):
        left = nearest
    return np.stack([left, np.cross(up, left), up])


def _floor(rig: Rig) -> float:
    """Return the height of the floor: the ground of the file if the feet are near it, else below the lower foot."""
    leg = rig.length(("hip", "knee", "ankle"))
    toes = [float(rig.at(joint)[2]) for joint in ("left_foot", "right_foot") if joint in rig.joints]
    if toes:
        return 0.0 if -_BELOW * leg <= min(toes) <= _SOLE * leg else min(toes)
    ankle = min(float(rig.at(f"{side}_ankle")[2]) for side in ("left", "right"))
    return 0.0 if 0 < ankle <= _ANKLE * leg else ankle - _HEEL * leg
