"""JSON of skeletons that programs send, and of motions of them.

This module knows JSON values and bounds; it knows no HTTP.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, get_args

from stmc.formats.characters import Character, CharacterError, CharacterMotion, RestSkeleton, skeleton_keys
from stmc.formats.characters.gltf_file import MOST_JOINTS, MOST_METRES
from stmc.formats.characters.rest_skeletons import RestJoint, Up
from stmc.io.untrusted import quote, truncate
from stmc.motion.retargeting.rig import MAPPED
from stmc.viewing.studio.json_schemas import Schema
from stmc.viewing.studio.request_errors import RequestError, take
from stmc.viewing.studio.responses import CharacterJoints, MappedSkeleton, SkeletonMotion

JointMap = dict[str, str | None]
"""Names of a skeleton's joints by the names of ours; None: it has no such joint."""

MOST_KEY_FRAMES = 18_000
"""Maximum number of frames of keys: five minutes at 60 frames per second."""

_DECIMALS = 6
"""Of keys: a millionth of a radian."""

_NUMBER = {"type": "number", "minimum": -MOST_METRES, "maximum": MOST_METRES}

SKELETON: Schema = {
    "type": "object",
    "required": ["joints"],
    "properties": {
        "up": {
            "enum": list(get_args(Up)),
            "default": "y",
            "description": "the axis that points up, of right-handed axes",
        },
        "joints": {
            "type": "array",
            "minItems": 1,
            "maxItems": MOST_JOINTS,
            "items": {
                "type": "object",
                "required": ["name", "parent", "place"],
                "properties": {
                    "name": {"type": "string", "description": "a name that no other joint has"},
                    "parent": {"type": ["string", "null"], "description": "name of the joint above; null: a root"},
                    "place": {
                        "type": "array",
                        "minItems": 3,
                        "maxItems": 3,
                        "items": _NUMBER,
                        "description": "position x, y, z at rest, in any unit",
                    },
                },
            },
        },
    },
}
"""JSON Schema of the objects that `skeleton_of` reads."""

JOINT_MAP: Schema = {
    "type": "object",
    "propertyNames": {"enum": list(MAPPED)},
    "additionalProperties": {"type": ["string", "null"]},
}
"""JSON Schema of the objects that `joint_map_of` reads."""


def skeleton_of(data: Mapping[str, Any]) -> RestSkeleton:
    """Read a skeleton from JSON. Raises `RequestError`."""
    up, listed = take(data, "up", str, "y"), take(data, "joints", list)
    if len(listed) > MOST_JOINTS:
        raise RequestError(422, f"{len(listed):,} joints: {MOST_JOINTS:,} at most")
    if up not in get_args(Up):
        raise RequestError(422, f"skeleton: up={quote(up)}: choose from {', '.join(get_args(Up))}")
    try:
        return RestSkeleton(tuple(_joint(number, each) for number, each in enumerate(listed)), up)
    except CharacterError as error:
        raise RequestError(422, f"skeleton: {error}") from None


def _joint(number: int, data: Any) -> RestJoint:
    try:
        if not isinstance(data, dict):
            raise RequestError(422, "a joint should be an object")
        place = take(data, "place", list)
        if any(isinstance(value, bool) or not isinstance(value, (int, float)) for value in place):
            raise RequestError(422, f"place={quote(place)}: three numbers needed")
        return RestJoint(take(data, "name", str), take(data, "parent", (str, type(None))), place)
    except RequestError as error:
        raise RequestError(422, f"skeleton: joint {number + 1}: {error}") from None


def joint_map_of(data: Mapping[str, Any]) -> JointMap:
    """Read a joint map from JSON. Raises `RequestError`."""
    for joint, name in data.items():
        if name is not None and not isinstance(name, str):
            raise RequestError(422, f"joint_map: {truncate(joint)}={quote(name)}: the name of a joint, or null, needed")
    return dict(data)


def character_of(skeleton: RestSkeleton, joint_map: JointMap) -> Character:
    """Return a skeleton as a character. Raises `RequestError` if it is not a person's."""
    try:
        return skeleton.character(joint_map)
    except CharacterError as error:
        raise RequestError(422, f"skeleton: {error}") from None


def describe_map(character: Character) -> MappedSkeleton:
    """Return the joint map of a character as JSON."""
    return {"joint_map": character.joint_map, "found_by": character.found_by}


def describe_joints(character: Character, corrections: JointMap) -> CharacterJoints:
    """Return the joint map of a character as JSON, with what can be chosen and what was corrected."""
    names = list(dict.fromkeys(character.rig.names))
    return {**describe_map(character), "corrections": corrections, "joints": list(MAPPED), "names": names}


def describe_keys(moved: CharacterMotion, skeleton: RestSkeleton) -> SkeletonMotion:
    """Return a motion of a skeleton as JSON."""
    keys = skeleton_keys(moved, skeleton.up)
    return {
        **describe_map(moved.character),
        "fps": moved.motion.fps,
        "frames": len(keys.places),
        "travelling": keys.travelling,
        "places": keys.places.round(_DECIMALS).tolist(),
        "turns": {name: turns.round(_DECIMALS).tolist() for name, turns in keys.turns.items()},
    }
