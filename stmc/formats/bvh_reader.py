"""Motions from BVH files: those that `bvh` writes, and other people's whose joints have names that are known here.

Knows how skeletons call their joints and how long a person's legs are. BVH says neither its unit nor its rest pose's
meaning: the unit is the one in which the legs are a person's, and y is up.
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
from stmc.io.untrusted import cut, read_text
from stmc.motion.body import JOINTS, NUM_ROTATIONS, PARENTS
from stmc.motion.body_model import Skeleton
from stmc.motion.geometry import global_rotations, shortest_arc
from stmc.motion.inverse_kinematics import joints_to_rotations
from stmc.motion.motion import Motion

MOST_BYTES = 2**26
"""Of a file: more than an hour of 22 joints at 20 frames per second."""

LEGS = (0.5, 1.3)
"""Metres from hip to ankle along the bones of a person, a child's or a giant's."""

UNITS = (1.0, 0.01, 0.001, 0.0254, 0.0254 / 0.45)
"""Metres of what files count in: metres, centimetres, millimetres, inches, CMU's unit. The first that fits is it."""

_SHORTEST = 1e-3
"""Metres of a bone that has a direction."""

_STRAIGHT = 0.8
"""The least cosine between bones of two rest poses that are alike."""


@dataclass(frozen=True)
class _Names:
    """How one kind of skeleton calls SMPL's joints, in small letters without `_` and what stands before a `:`.

    Alternatives stand between bars, the best first. `spine`: of pelvis, spine1 to 3, neck, head. `limbs`: of collar,
    shoulder, elbow, wrist, hip, knee, ankle, foot, with what makes them left or right in `sides`.
    """

    sides: tuple[str, str]
    spine: str
    limbs: str

    def choices(self) -> dict[str, list[str]]:
        """Of every joint, in SMPL's order."""
        names = dict(zip(_SPINE, self.spine.split(), strict=True))
        for side, template in zip(("left", "right"), self.sides, strict=True):
            for joint, words in zip(_LIMBS, self.limbs.split(), strict=True):
                names[f"{side}_{joint}"] = "|".join(template.format(word) for word in words.split("|"))
        return {joint: names[joint].split("|") for joint in JOINTS[:NUM_ROTATIONS]}


_SPINE = ("pelvis", "spine1", "spine2", "spine3", "neck", "head")
_LIMBS = ("collar", "shoulder", "elbow", "wrist", "hip", "knee", "ankle", "foot")
_BETWEEN = "spine2"
"""The one joint that a skeleton may lack: it lies between its neighbours."""

_SMPLS = 2
"""How many of the known names are SMPL's own, and stand first."""

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
    """The motion of a BVH file, float32, on the file's own bones: metres, z up.

    Files of our joints, at rest as SMPL, keep their rotations. Of others, arms and legs are `skeleton`'s, turned so
    that its bones point where the file's do (`joints_to_rotations`); all else turns as the file's does from its rest
    pose, where that is upright and looks along z, and elsewhere as arms and legs. `skeleton` also lends hands.
    Raises `ValueError` naming the file: for text that is no BVH, joints that are missing, legs that are nobody's in any
    of `UNITS`, a rest pose that is not upright of bones without length, and files over `MOST_BYTES`.
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
    """Which of the file's joints is which of ours; one that is not told from another of ours is left out.

    Raises `BvhError` naming what the kind of skeleton that fits best lacks.
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
    has = cut(", ".join(names[:30]), 200)
    raise BvhError(f"no joints are known for {', '.join(least)}; the file's joints are {has}")


def _plain(name: str) -> str:
    """The name in small letters, without namespaces ("mixamorig:") and what parts its words."""
    name = name.rpartition(":")[2]
    return re.sub(r"[\W_]", "", re.sub(r"^(mixamorig|character)\d*_", "", name.lower()))


def _rest(bvh: Bvh) -> Float[Tensor, "_ 3"]:
    """Where each joint is while none is turned, in the file's axes and unit."""
    places: list[Tensor] = []
    for position, parent in zip(bvh.positions[0], bvh.parents, strict=True):
        places.append(position if parent < 0 else places[parent] + position)
    return torch.stack(places)


def _between(places: Float[Tensor, "frames _ 3"], index: Mapping[str, int], body: Skeleton) -> Tensor:
    """The first 22 joints [frames, 22, 3], one that the file lacks between its neighbours as `body` has it."""
    joints = places[:, [index.get(joint, index["spine1"]) for joint in JOINTS[:NUM_ROTATIONS]]]
    if _BETWEEN not in index:
        first, second, third = (JOINTS.index(joint) for joint in ("spine1", _BETWEEN, "spine3"))
        below, above = body.offsets[second].norm(), body.offsets[third].norm()
        joints[:, second] = torch.lerp(joints[:, first], joints[:, third], below / (below + above))
    return joints


def _is_own(bvh: Bvh, index: Mapping[str, int]) -> bool:
    """Whether all joints are there by SMPL's names, in SMPL's tree."""
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
    """Whether these lines from joint to joint point where ours do at rest."""
    return all(float(_direction(rest, *bone) @ _direction(ours, *bone)) > _STRAIGHT for bone in bones)


def _direction(rest: Tensor, start: str, end: str) -> Float[Tensor, " 3"]:
    return normalize(rest[JOINTS.index(end)] - rest[JOINTS.index(start)], dim=0)


def _turned_from_rest(
    world: Float[Tensor, "frames 22 3 3"], turned: Tensor, index: Mapping[str, int], rest: Tensor, ours: Tensor
) -> Float[Tensor, "frames 22 3 3"]:
    """World rotations of which all but those of arms and legs are the file's, from its rest pose on.

    They see what joints do not show: where heads and hands turn, and chests whose bones have no length, as CMU's. Feet
    are flat in both rest poses, whatever their bones' slopes; hands make up for how the file's rest pose spreads arms.
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
    """From hip to ankle along the bones."""
    hip, knee, ankle = (rest[JOINTS.index(f"left_{joint}")] for joint in ("hip", "knee", "ankle"))
    return float((knee - hip).norm() + (ankle - knee).norm())


def _unit(rest: Tensor) -> float | None:
    """Metres of the file's unit, None where a person has such legs in none."""
    leg = _leg(rest)
    return next((unit for unit in UNITS if LEGS[0] <= leg * unit <= LEGS[1]), None)
