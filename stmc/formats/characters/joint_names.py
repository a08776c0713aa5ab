"""Identify joints by their names: Mixamo, Unreal, Unity, VRM, Rigify, MakeHuman, Daz, Biped, CMU, SMPL and the like.

A name is split into words, side and number. There are two tables of words: a "shoulder" is a collar bone in rigs
whose upper arms are called arms, and an upper arm in rigs whose collar bones are called collars.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence

from stmc.motion.retargeting.rig import LIMBS, SIDES

_NOISE = {
    "mixamorig", "bip", "biped", "valve", "valvebiped", "def", "org", "jnt", "joint", "bone", "character", "armature",
    "rig", "skeleton", "cc", "j", "b", "c", "skel",
}  # fmt: skip
"""Prefixes and suffixes without information about the joint."""
_SIDES = {"left": "left", "l": "left", "right": "right", "r": "right"}

_AXES = {
    "pitch", "roll", "yaw", "x", "y", "z", "rx", "ry", "rz", "p", "s", "sag", "lat", "link", "frame", "body", "joint",
    "jnt", "flexion", "extension", "abduction", "adduction", "rotation",
}  # fmt: skip
"""Words of robots' names that say the axis of a hinge, or nothing."""

_BY_BONES = {
    "collar": "clavicle collar shoulder01 shoulder",
    "shoulder": "upperarm upperarm01 uparm arm humerus shldr shldrbend",
    "elbow": "forearm forearmbend lowerarm lowerarm01 radius elbow",
    "wrist": "hand wrist",
    "hip": "thigh thighbend upleg upperleg upperleg01 femur",
    "knee": "calf shin lowerleg lowerleg01 leg tibia",
    "ankle": "foot ankle",
    "foot": "ball toebase toe0 toe toes toe11",
}
_BY_JOINTS = {
    "collar": "collar clavicle",
    "shoulder": "shoulder",
    "elbow": "elbow",
    "wrist": "wrist",
    "hip": "hip",
    "knee": "knee",
    "ankle": "ankle",
    "foot": "foot toebase toe toes ball",
}
_TABLES = tuple({joint: words.split() for joint, words in table.items()} for table in (_BY_JOINTS, _BY_BONES))
_WORDS = {word for table in _TABLES for words in table.values() for word in words}

VRM_BONES: Mapping[str, str] = {
    "hips": "pelvis",
    "head": "head",
    **{
        f"{side}{bone}": f"{side}_{joint}"
        for side in SIDES
        for bone, joint in (
            ("UpperLeg", "hip"), ("LowerLeg", "knee"), ("Foot", "ankle"), ("Toes", "foot"), ("Shoulder", "collar"),
            ("UpperArm", "shoulder"), ("LowerArm", "elbow"), ("Hand", "wrist"),
        )
    },
}  # fmt: skip
"""VRM's humanoid bones that are joints of ours; spine and neck follow from the tree."""


def joints_by_name(names: Sequence[str], nodes: Iterable[int]) -> dict[str, int]:
    """Map joints of SMPL to those of the `nodes` that bear their names.

    The mapping is empty unless the names identify all joints of both arms and both legs.
    """
    places: dict[tuple[str | None, str], int] = {}
    for node in nodes:
        places.setdefault(taken_apart(names[node]), node)
    for table in _TABLES:
        found = {
            f"{side}_{joint}": next((places[side, word] for word in words if (side, word) in places), None)
            for side in SIDES
            for joint, words in table.items()
        }
        if all(found[f"{side}_{joint}"] is not None for side in SIDES for limb in LIMBS for joint in limb):
            joints = {joint: node for joint, node in found.items() if node is not None}
            middle = {"head": ("head",), "pelvis": ("pelvis", "hips", "hip")}
            for joint, words in middle.items():
                single = next((places[None, word] for word in words if (None, word) in places), None)
                joints |= {} if single is None else {joint: single}
            return joints
    return {}


def taken_apart(name: str) -> tuple[str | None, str]:
    """Split the name of a joint into a side ("left", "right" or None) and its words, joined in lower case.

    "mixamorig:LeftUpLeg" is ("left", "upleg"), "DEF-upper_arm.L" is ("left", "upperarm"), "lhumerus" is
    ("left", "humerus"), "Bip01 R Toe0" is ("right", "toe0").
    """
    name = re.split(r"[:|]", name[:200])[-1]
    words = [word.lower() for word in re.findall(r"[A-Z]?[a-z]+|[A-Z]+(?![a-z])|\d+", name)]
    while words and (words[0] in _NOISE or words[0].isdigit()):
        words = words[1:]
        if words[:1] == ["base"]:  # CC_Base_
            words = words[1:]
    while len(words) > 1 and words[-1] in _NOISE:
        words = words[:-1]
    side = next((_SIDES[word] for word in words if word in _SIDES), None)
    word = "".join(word for word in words if word not in _SIDES)
    if side is None:
        side, word = _glued(word)
    return side, word


def _glued(word: str) -> tuple[str | None, str]:
    """Split a side off the beginning or the end of a word if the rest names the joint of a limb."""
    for start, side in _SIDES.items():
        if word.startswith(start) and word[len(start) :] in _WORDS:
            return side, word[len(start) :]
        if word.endswith(f"{start}") and word[: -len(start)] in _WORDS:
            return side, word[: -len(start)]
    return None, word


def robot_words(name: str) -> tuple[str | None, tuple[str, ...]]:
    """Split the name of a robot's joint or link into a side and its words, joined with and without "leg" or "arm".

    "left_hip_yaw_joint" is ("left", ("hip",)), "RLEG_HIP_R" is ("right", ("hip", "leghip")), "LKneePitch" is
    ("left", ("knee",)), "lfemurrx" is ("left", ("femur",)).
    """
    words = [word.lower() for word in re.findall(r"[A-Z]?[a-z]+|[A-Z]+(?![a-z])", name[:200])]
    side, kept = None, []
    for word in words:
        before = re.sub(r"(?<=[a-z]{3})r[xyz]$", "", word)
        found, rest = (_SIDES[before], "") if before in _SIDES else _glued_limb(before)
        side = side or found
        if rest and rest not in _AXES:
            kept.append(rest)
    short = [word for word in kept if word not in ("leg", "arm")]
    return side, tuple(dict.fromkeys("".join(each) for each in (short, kept) if each))


def _glued_limb(word: str) -> tuple[str | None, str]:
    """Split a word into the side that it begins with and the name of a limb or joint."""
    if word[:1] in _SIDES and word[1:] in (*_WORDS, "leg", "arm"):
        return _SIDES[word[0]], word[1:]
    return None, word
