"""Motions from BVH files of this library, and from other files whose joints have common names.

Depends on common joint names and on the length of human legs. A BVH file states neither its unit nor the meaning of its
rest pose: the unit is the one in which the legs have human length, and y is up.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from einops import einsum
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import normalize

from stmc.formats.axes import Z_UP_TO_Y_UP
from stmc.formats.bvh_parser import Bvh, BvhError, parse_bvh
from stmc.io.bounds import check_metres
from stmc.io.untrusted import read_text, truncate
from stmc.motion.body import JOINTS, NUM_ROTATIONS, PARENTS
from stmc.motion.body_model import Skeleton
from stmc.motion.geometry import global_rotations, shortest_arc
from stmc.motion.inverse_kinematics import joints_to_rotations
from stmc.motion.motion import Motion

MOST_BYTES = 2**26
"""Size limit of a file: more than an hour of 22 joints at 20 frames per second."""

LEGS = (0.5, 1.3)
"""Least and greatest distance in metres from hip to ankle along a person's bones, from a child to a giant."""

UNITS = (1.0, 0.01, 0.001, 0.0254, 0.0254 / 0.45)
"""Units of files in metres: metre, centimetre, millimetre, inch, CMU's unit. The first with human legs is chosen."""

_SHORTEST = 1e-3
"""Least length in metres of a bone with a direction."""

_STRAIGHT = 0.8
"""Least cosine between the bones of two similar rest poses."""


@dataclass(frozen=True)
class _Names:
    """The names of SMPL's joints in one kind of skeleton, in lower case, without `_` and without a prefix before `:`.

    Bars separate alternatives, the best first. `spine` names pelvis, spine1 to 3, neck and head; `limbs` names collar,
    shoulder, elbow, wrist, hip, knee, ankle and foot, and `sides` holds templates for left and right.
    """

    sides: tuple[str, str]
    spine: str
    limbs: str

    def choices(self) -> dict[str, list[str]]:
        """Return the possible names of every joint, in SMPL's order."""
        names = dict(zip(_SPINE, self.spine.split(), strict=True))
        for side, template in zip(("left", "right"), self.sides, strict=True):
            for joint, words in zip(_LIMBS, self.limbs.split(), strict=True):
                names[f"{side}_{joint}"] = "|".join(template.format(word) for word in words.split("|"))
        return {joint: names[joint].split("|") for joint in JOINTS[:NUM_ROTATIONS]}


_SPINE = ("pelvis", "spine1", "spine2", "spine3", "neck", "head")
_LIMBS = ("collar", "shoulder", "elbow", "wrist", "hip", "knee", "ankle", "foot")
_BETWEEN = "spine2"
"""The only joint that a skeleton may lack; it is placed between its neighbours."""

_SMPLS = 2
"""Number of the first entries of `_KNOWN` that are SMPL's names."""

_SMPL = "collar shoulder elbow wrist hip knee ankle foot"
_TOES = "toebase|toe|toes"
_KNOWN = (
    _Names(("left{}", "right{}"), "pelvis spine1 spine2 spine3 neck head", _SMPL),
    _Names(("l{}", "r{}"), "pelvis spine1 spine2 spine3 neck head", _SMPL),
    _Names(  # Mixamo's, MotionBuilder's and what follows them; CMU's forearms have two bones, the second is "hand"
        ("left{}", "right{}"),
        "hips spine spine1 spine3|spine2|spine1 neck head",
        f"shoulder arm forearm fingerbase|hand upleg|upperleg leg|lowerleg foot {_TOES}",
    ),
    _Names(
        ("left{}", "right{}"),
        "hips chest chest2 chest4|chest3|chest2 neck head",
        f"collar shoulder elbow wrist hip knee ankle {_TOES}",
    ),
    _Names(  # Bandai's
        ("{}l", "{}r"),
        "hips spine chest chest neck head",
        "shoulder upperarm lowerarm hand upperleg lowerleg foot toes",
    ),
    _Names(  # CMU's own
        ("l{}", "r{}"),
        "root|hips upperback thorax thorax lowerneck head",
        "clavicle humerus radius hand femur tibia foot toes",
    ),
)


def load_bvh(path: Path, skeleton: Skeleton) -> Motion:
    """Read the motion of a BVH file (float32) on the file's own bones, in metres, z up.

    Files with SMPL's joints and rest pose keep their rotations. In other files, arms and legs turn `skeleton`'s bones
    to the directions of the file's (`joints_to_rotations`). The other joints turn as in the file from its rest pose if
    that is upright and looks along z, or else like arms and legs. `skeleton` also provides the hands. Raises
    `ValueError` with the file's name: for text that is not BVH, missing joints, legs without human length in any of
    `UNITS`, a rest pose that is not upright with bones of zero length, and files over `MOST_BYTES`.
    """
    try:
        return _motion(parse_bvh(read_text(path, MOST_BYTES)), skeleton)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None


def _motion(bvh: Bvh, skeleton: Skeleton) -> Motion:
    index = _mapped(bvh.names)
    body = Skeleton(skeleton.offsets.double().cpu())
    rest = _between(_rest(bvh)[None], index, body)[0]
    turned, places = bvh.world()
    up = torch.from_numpy(Z_UP_TO_Y_UP.T).contiguous()
    unit, own = _unit(rest), _is_own(bvh, index) and _alike(rest, body.rest, [*_UPRIGHT, *_ARMS])
    if unit is None and not own:
        raise BvhError(f"the legs are {_leg(rest):g} long: in metres, centimetres or inches that is no person's")
    joints = _between(places, index, body) @ up.T * (unit or 1.0)
    turned = up @ turned
    check_metres("joints", float(joints.abs().max()))
    hands = body.offsets[NUM_ROTATIONS:].clone()
    if own:
        world = turned[:, [index[joint] for joint in JOINTS[:NUM_ROTATIONS]]]
        for number, wrist in enumerate(("left_wrist", "right_wrist")):
            hands[number] = torch.tensor(bvh.ends.get(index[wrist], hands[number].tolist())).double() * (unit or 1.0)
    else:
        world = global_rotations(joints_to_rotations(joints, body), PARENTS[:NUM_ROTATIONS])
        if _alike(rest, body.rest, _UPRIGHT):
            world = _turned_from_rest(world, turned, index, rest, body.rest)
        elif not (_lengths(joints[0]) > _SHORTEST).all():
            raise BvhError("its rest pose is not upright, and has bones without length: it is not known how it turns")
    wrists = list(PARENTS[NUM_ROTATIONS:])
    reached = joints[:, wrists] + einsum(world[:, wrists], hands, "frames hands i j, hands j -> frames hands i")
    local = torch.cat([world[:, :1], world[:, list(PARENTS[1:NUM_ROTATIONS])].mT @ world[:, 1:]], dim=1)
    joints = torch.cat([joints, reached], dim=1)
    return Motion(local, joints[:, 0], joints, bvh.fps).to(dtype=torch.float32)


def _mapped(names: Sequence[str]) -> dict[str, int]:
    """Map SMPL's joints to the file's, without a joint that coincides with another one.

    Raises `BvhError` with the missing joints of the best kind of skeleton.
    """
    places: dict[str, int] = {}
    for number, name in enumerate(names):
        places.setdefault(_plain(name), number)
    lacking: list[list[str]] = []
    for known in _KNOWN:
        found = {
            joint: next((places[name] for name in choices if name in places), None)
            for joint, choices in known.choices().items()
        }
        if found[_BETWEEN] in (found["spine1"], found["spine3"]):
            found[_BETWEEN] = None
        twice = found["spine3"] is not None and found["spine3"] == found["spine1"]
        missing = [joint for joint, place in found.items() if joint != _BETWEEN and place is None]
        missing += ["spine3"] * twice
        if not missing:
            return {joint: place for joint, place in found.items() if place is not None}
        lacking.append(missing)
    least = min(lacking, key=len)
    has = truncate(", ".join(names[:30]), 200)
    raise BvhError(f"no joints are known for {', '.join(least)}; the file's joints are {has}")


def _plain(name: str) -> str:
    """Convert a name to lower case, without namespaces ("mixamorig:") and separators."""
    name = name.rpartition(":")[2]
    return re.sub(r"[\W_]", "", re.sub(r"^(mixamorig|character)\d*_", "", name.lower()))


def _rest(bvh: Bvh) -> Float[Tensor, "_ 3"]:
    """Compute the positions of the joints without rotations, in the file's axes and unit."""
    places: list[Tensor] = []
    for position, parent in zip(bvh.positions[0], bvh.parents, strict=True):
        places.append(position if parent < 0 else places[parent] + position)
    return torch.stack(places)


def _between(places: Float[Tensor, "frames _ 3"], index: Mapping[str, int], body: Skeleton) -> Tensor:
    """Select the first 22 joints [frames, 22, 3]; a missing one is placed between its neighbours as in `body`."""
    joints = places[:, [index.get(joint, index["spine1"]) for joint in JOINTS[:NUM_ROTATIONS]]]
    if _BETWEEN not in index:
        first, second, third = (JOINTS.index(joint) for joint in ("spine1", _BETWEEN, "spine3"))
        below, above = body.offsets[second].norm(), body.offsets[third].norm()
        joints[:, second] = torch.lerp(joints[:, first], joints[:, third], below / (below + above))
    return joints


def _is_own(bvh: Bvh, index: Mapping[str, int]) -> bool:
    """Tell whether the file has all of SMPL's joints, by name and in SMPL's tree."""
    names = [known.choices() for known in _KNOWN[:_SMPLS]]
    for joint, parent in zip(JOINTS[:NUM_ROTATIONS], PARENTS, strict=False):
        place = index.get(joint)
        if place is None or not any(_plain(bvh.names[place]) in choices[joint] for choices in names):
            return False
        if parent >= 0 and bvh.parents[place] != index[JOINTS[parent]]:
            return False
    return True


_UPRIGHT = (
    ("pelvis", "head"),
    ("right_hip", "left_hip"),
    ("left_hip", "left_ankle"),
    ("right_hip", "right_ankle"),
)
_LIMB = ("shoulder", "elbow", "hip", "knee")
_ARMS = (("left_shoulder", "left_wrist"), ("right_shoulder", "right_wrist"))


def _alike(rest: Tensor, ours: Tensor, bones: Sequence[tuple[str, str]]) -> bool:
    """Tell whether lines between joints have the same directions in both rest poses."""
    return all(float(_direction(rest, *bone) @ _direction(ours, *bone)) > _STRAIGHT for bone in bones)


def _direction(rest: Tensor, start: str, end: str) -> Float[Tensor, " 3"]:
    return normalize(rest[JOINTS.index(end)] - rest[JOINTS.index(start)], dim=0)


def _turned_from_rest(
    world: Float[Tensor, "frames 22 3 3"], turned: Tensor, index: Mapping[str, int], rest: Tensor, ours: Tensor
) -> Float[Tensor, "frames 22 3 3"]:
    """Replace world rotations, except those of arms and legs, by the file's rotations from its rest pose.

    These contain turns that joint positions do not show: of heads and hands, and of chests with bones of zero length,
    as in CMU's files. Feet are flat in both rest poses, whatever the slopes of their bones; hands compensate for the
    spread of the arms in the file's rest pose.
    """
    world = world.clone()
    for number, joint in enumerate(JOINTS[:NUM_ROTATIONS]):
        if joint.endswith(_LIMB):
            continue
        world[:, number] = turned[:, index.get(joint, index["spine1"])]
        if joint.endswith("wrist"):
            forearm = joint.replace("wrist", "elbow"), joint
            world[:, number] @= shortest_arc(_direction(ours, *forearm), _direction(rest, *forearm))
    return world


def _lengths(joints: Float[Tensor, "22 3"]) -> Float[Tensor, " 21"]:
    return (joints[1:] - joints[list(PARENTS[1:NUM_ROTATIONS])]).norm(dim=-1)


def _leg(rest: Tensor) -> float:
    """Measure the distance from hip to ankle along the bones."""
    hip, knee, ankle = (rest[JOINTS.index(f"left_{joint}")] for joint in ("hip", "knee", "ankle"))
    return float((knee - hip).norm() + (ankle - knee).norm())


def _unit(rest: Tensor) -> float | None:
    """Return the file's unit in metres, or None if the legs have human length in no unit."""
    leg = _leg(rest)
    return next((unit for unit in UNITS if LEGS[0] <= leg * unit <= LEGS[1]), None)
