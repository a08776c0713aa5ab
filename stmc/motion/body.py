"""The human body as names: joints, their tree, left and right, and the five body parts that own them.

Uses SMPL's joint order; `body_model` holds positions and `representation` features.
"""

from __future__ import annotations

from enum import StrEnum

from stmc.io.untrusted import quote

JOINTS: tuple[str, ...] = (
    "pelvis", "left_hip", "right_hip", "spine1", "left_knee", "right_knee", "spine2", "left_ankle", "right_ankle",
    "spine3", "left_foot", "right_foot", "neck", "left_collar", "right_collar", "head", "left_shoulder",
    "right_shoulder", "left_elbow", "right_elbow", "left_wrist", "right_wrist", "left_hand", "right_hand",
)  # fmt: skip
"""SMPL's 24 joints in SMPL's order."""

PARENTS: tuple[int, ...] = (-1, 0, 0, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 9, 9, 12, 13, 14, 16, 17, 18, 19, 20, 21)
"""Index of each joint's parent; -1 for the root. A parent always precedes its children."""
NUM_ROTATIONS = 22
"""Number of joints with their own rotation, the first 22; the two hands follow the wrists."""


def _other_side(name: str) -> str:
    swap = {"left": "right", "right": "left"}
    side, _, rest = name.partition("_")
    return f"{swap[side]}_{rest}" if side in swap else name


MIRROR: tuple[int, ...] = tuple(JOINTS.index(_other_side(name)) for name in JOINTS)
"""Index of each joint's left-right counterpart (itself on the midline)."""


_SYNONYMS: dict[str, str] = {
    "torso": "spine",
    "neck": "head",
    "left hand": "left arm",
    "right hand": "right arm",
    "left leg": "legs",
    "right leg": "legs",
}
"""Other names of parts that timelines may use, as in the published code, and the parts that they stand for."""


class BodyPart(StrEnum):
    """One of the five parts that a prompt may claim (STMC, section 3.3). Together they own every joint exactly once.

    Examples:
        >>> [str(part) for part in stmc.BodyPart]
        ['left arm', 'right arm', 'legs', 'head', 'spine']
        >>> stmc.BodyPart.HEAD.joints
        ('neck', 'head')
    """

    LEFT_ARM = "left arm"
    RIGHT_ARM = "right arm"
    LEGS = "legs"
    HEAD = "head"
    SPINE = "spine"

    @property
    def joints(self) -> tuple[str, ...]:
        """Names of the joints that this part owns, in SMPL's order. The pelvis belongs to the legs."""
        return tuple(name for name in JOINTS if _owner(name) is self)

    @classmethod
    def parse(cls, text: str) -> BodyPart:
        """Return the part with a name, in any case, with spaces, `_` or `-`.

        Names of smaller parts, such as "neck" or "left hand", stand for the part that contains them; "torso" stands for
        the spine. Raises `ValueError` with the legal names otherwise.

        Examples:
            >>> stmc.BodyPart.parse("Left_Hand")
            <BodyPart.LEFT_ARM: 'left arm'>
        """
        if not isinstance(text, str):
            raise ValueError(f"a body part must be a text, not {quote(text)}; choose from {', '.join(cls)}")
        name = " ".join(text.lower().replace("_", " ").replace("-", " ").split())
        name = _SYNONYMS.get(name, name)
        if name not in set(cls):
            raise ValueError(f"unknown body part {quote(text)}; choose from {', '.join(cls)}")
        return cls(name)


def _owner(joint: str) -> BodyPart:
    side, _, rest = joint.partition("_")
    if rest in ("collar", "shoulder", "elbow", "wrist", "hand"):
        return BodyPart(f"{side} arm")
    if joint in ("neck", "head"):
        return BodyPart.HEAD
    return BodyPart.SPINE if joint.startswith("spine") else BodyPart.LEGS
