"""Rigs: the joints of a character at rest, and which of them is which joint of ours.

Knows trees and rest positions. Rest positions stand upright: z up, the floor at 0, facing -y, the left side towards
+x, in a unit of their own. Rotations are always seen from the rest pose, so that roll and axes of bones do not matter.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import torch
from jaxtyping import Float
from torch import Tensor

from stmc.io.untrusted import quote
from stmc.motion.retargeting.linkage import Linkage

SIDES = ("left", "right")
LIMBS = (("hip", "knee", "ankle"), ("shoulder", "elbow", "wrist"))
"""The joints of a leg and of an arm: where it begins, bends and ends."""
NEEDED = ("head", *(f"{side}_{joint}" for limb in LIMBS for joint in limb for side in SIDES))
"""Joints that every rig has. The pelvis, the spine and the necks follow from the tree."""
OPTIONAL = ("pelvis", *(f"{side}_{joint}" for joint in ("collar", "foot") for side in SIDES))
"""Joints that a rig may have: `foot` is where the toes begin, as in SMPL."""
MAPPED = (*OPTIONAL[:1], *NEEDED, *OPTIONAL[1:])
"""Joints that a joint map may name."""
_SHORTEST = 1e-3
"""The length of a limb's bone, as a share of the leg, below which it has no direction."""


class RigError(ValueError):
    """Joints that are no person's; the message says which joint is missing or wrong."""


@dataclass(frozen=True, eq=False)
class Rig:
    """The joints of a character. `Rig.mapped` finds the trunk of a tree whose limbs are known."""

    names: tuple[str, ...]
    parents: tuple[int, ...]
    """Each node's parent, -1 for a root; parents stand before their children."""
    rest: Float[Tensor, "nodes 3"]
    """The nodes' rest positions: z up, the floor at 0, facing -y."""
    joints: Mapping[str, int]
    """The nodes that are joints of ours, by our names (`body.JOINTS`); without the spine and the necks."""
    spine: tuple[int, ...]
    """The nodes from above the pelvis up to the chest, which carries arms and head."""
    necks: tuple[int, ...]
    """The nodes between chest and head."""
    linkage: Linkage | None = None
    """The hinges of a robot; None if every node turns freely."""

    @classmethod
    def mapped(
        cls, names: Sequence[str], parents: Sequence[int], rest: Float[Tensor, "nodes 3"], joints: Mapping[str, int]
    ) -> Rig:
        """Return the rig whose limbs and head are `joints`.

        The pelvis is the given one if legs and head hang from it, else the lowest node of which that is true. Raises
        `RigError` naming a joint that is missing, has no length, or does not hang where a person's does.
        """
        missing = [joint for joint in NEEDED if joint not in joints]
        if missing:
            raise RigError(f"no joint was found for {', '.join(missing)}; name it in a joint map")
        ends = [joints["head"], *(joints[f"{side}_{joint}"] for joint in ("hip", "shoulder") for side in SIDES)]
        pelvis = _pelvis(parents, joints, ends)
        chest = _common(parents, [joints["head"], joints["left_shoulder"], joints["right_shoulder"]])
        if chest is None or pelvis not in ancestors(parents, chest):
            raise RigError(f"arms and head do not hang from the pelvis, {quote(names[pelvis])}")
        spine = path(parents, pelvis, chest)[1:]
        necks = path(parents, chest, joints["head"])[1:-1]
        limbs = {name: node for name, node in joints.items() if name in (*NEEDED, *OPTIONAL)}
        rig = cls(tuple(names), tuple(parents), rest, limbs | {"pelvis": pelvis}, spine, necks)
        _check(rig)
        return rig

    @cached_property
    def driven(self) -> tuple[int, ...]:
        """The nodes that a motion turns, parents before children; the others keep their rest pose."""
        return tuple(sorted({*self.joints.values(), *self.spine, *self.necks}))

    @cached_property
    def carriers(self) -> tuple[int, ...]:
        """For each of the nodes, the index in `driven` of the last driven node from the root down to it; -1 if none."""
        places = {node: place for place, node in enumerate(self.driven)}
        found: list[int] = []
        for node, parent in enumerate(self.parents):
            found.append(places.get(node, found[parent] if parent >= 0 else -1))
        return tuple(found)

    def place(self, joint: str) -> int:
        """Return the index in `driven` of a joint of ours."""
        return self.driven.index(self.joints[joint])

    def at(self, joint: str) -> Float[Tensor, " 3"]:
        """Return the rest position of a joint of ours."""
        return self.rest[self.joints[joint]]

    def length(self, limb: Sequence[str]) -> float:
        """Return the mean length of both legs or arms along their bones, at rest."""
        return limb_length(self.at, limb)

    @property
    def ankles(self) -> float:
        """The mean height of the ankles above the soles."""
        return sum(float(self.at(f"{side}_ankle")[2]) for side in SIDES) / 2

    def scaled(self, by: float) -> Rig:
        """Return the same rig in another unit."""
        return replace(self, rest=self.rest * by)

    def posed(self, turns: Float[Tensor, "frames driven 3 3"], pelvis: Float[Tensor, "frames 3"]) -> Tensor:
        """Compute the positions [frames, driven, 3] of the driven nodes (forward kinematics).

        `turns` are world rotations from the rest pose, `pelvis` the positions of the pelvis.
        """
        places: list[Tensor] = []
        for node in self.driven:
            above = self.carriers[self.parents[node]] if self.parents[node] >= 0 else -1
            if above < 0:
                places.append(pelvis)
            else:
                bone = self.rest[node] - self.rest[self.driven[above]]
                places.append(places[above] + turns[:, above] @ bone)
        return torch.stack(places, dim=1)


def limb_length(at: Callable[[str], Float[Tensor, " 3"]], limb: Sequence[str]) -> float:
    """Return the mean length of both legs or arms along their bones, of joints that are `at` these places."""
    bones = [
        (at(f"{side}_{below}") - at(f"{side}_{above}")).norm()
        for side in SIDES
        for above, below in itertools.pairwise(limb)
    ]
    return float(torch.stack(bones).sum()) / 2


def ancestors(parents: Sequence[int], node: int) -> list[int]:
    """Return the node, its parent, and so on up to the root."""
    found = [node]
    while parents[found[-1]] >= 0:
        found.append(parents[found[-1]])
    return found


def path(parents: Sequence[int], top: int, node: int) -> tuple[int, ...]:
    """Return the nodes from `top` down to one of those below it, both included."""
    line = ancestors(parents, node)
    return tuple(reversed(line[: line.index(top) + 1]))


def _common(parents: Sequence[int], nodes: Sequence[int]) -> int | None:
    """Return the lowest node that is above all of these, or one of them."""
    shared = set.intersection(*(set(ancestors(parents, node)) for node in nodes))
    return max(shared, default=None)


def _pelvis(parents: Sequence[int], joints: Mapping[str, int], ends: Sequence[int]) -> int:
    common = _common(parents, ends)
    if common is None:
        raise RigError("legs, arms and head hang from different roots, so no joint is the pelvis")
    given = joints.get("pelvis", common)
    below = all(given in ancestors(parents, end) for end in ends)
    return given if below else common


def _check(rig: Rig) -> None:
    """Raise `RigError` unless every limb is a chain of bones with lengths, and no node is two joints."""
    twice: dict[int, str] = {}
    for joint, node in rig.joints.items():
        if node in twice:
            raise RigError(f"{quote(rig.names[node])} cannot be both {twice[node]} and {joint}")
        twice[node] = joint
    bones = [
        (f"{side}_{above}", f"{side}_{below}")
        for side in SIDES
        for limb in LIMBS
        for above, below in itertools.pairwise(limb)
    ]
    toes = [(f"{side}_ankle", f"{side}_foot") for side in SIDES if f"{side}_foot" in rig.joints]
    collars = [(f"{side}_collar", f"{side}_shoulder") for side in SIDES if f"{side}_collar" in rig.joints]
    for above, below in bones + toes + collars:
        if rig.joints[above] not in ancestors(rig.parents, rig.joints[below]):
            lower, upper = (quote(rig.names[rig.joints[joint]]) for joint in (below, above))
            raise RigError(f"{lower} ({below}) does not hang from {upper} ({above})")
    for above, below in bones:
        if not (rig.at(below) - rig.at(above)).norm() > _SHORTEST * rig.length(LIMBS[0]):
            raise RigError(f"{below} is where {above} is: the bone between them has no length")
