"""Characters of users: reading their files, retargeting motions onto them, and writing them with an animation.

Holds the table of formats, and the order in which joints are identified: VRM's map, names, shape, the user's map.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import yaml
from jaxtyping import Float

from stmc.formats.bvh_parser import parse_bvh
from stmc.formats.characters.bvh_rig import BvhRig
from stmc.formats.characters.gltf_file import CharacterError, read_gltf
from stmc.formats.characters.gltf_rig import GltfRig
from stmc.formats.characters.joint_names import joints_by_name
from stmc.formats.characters.joint_shapes import joints_by_shape
from stmc.formats.characters.mjcf import read_mjcf
from stmc.formats.characters.robot_joints import identify_joints
from stmc.formats.characters.robot_pieces import Pieces
from stmc.formats.characters.robot_rig import RobotRig, rig_robot
from stmc.formats.characters.upright import Standing, stand
from stmc.formats.characters.urdf import read_urdf
from stmc.io.files import write_whole
from stmc.io.untrusted import quote, read_text, truncate
from stmc.motion.motion import Motion
from stmc.motion.retargeting import Rig, RigMotion, transfer
from stmc.motion.retargeting.rig import MAPPED

_MOST_BVH, _MOST_MAP = 2**26, 2**16
"""Bytes of a BVH file, and of a joint map."""
_Corrections = Mapping[str, str | None]


@dataclass(frozen=True, eq=False)
class Character:
    """A character that was read from a file by `read_character`: its rig, and its nodes for writing.

    Examples:
        >>> [motion] = stmc.load().generate("walk # 0 # 1", steps=1)
        >>> stmc.write(motion, "hero.glb")
        >>> hero = stmc.read_character("hero.glb")
        >>> hero.found_by, hero.joint_map["left_knee"]
        ("the joints' names", 'left_knee')
    """

    rig: Rig
    """Joints at rest."""
    found_by: str
    """How the joints were identified."""
    body: GltfRig | BvhRig | RobotRig
    """Nodes in the coordinate system of the file."""
    standing: Standing
    """Rotation and floor height that convert the coordinate system of the file to ours."""

    @property
    def joint_map(self) -> dict[str, str]:
        """The file's name of each of our joints, in the form of a `joint_map` YAML.

        Examples:
            >>> [motion] = stmc.load().generate("walk # 0 # 1", steps=1)
            >>> stmc.write(motion, "hero.bvh")
            >>> stmc.read_character("hero.bvh").joint_map["head"]
            'head'
        """
        return {joint: self.rig.names[self.rig.joints[joint]] for joint in MAPPED if joint in self.rig.joints}

    @property
    def formats(self) -> tuple[str, ...]:
        """File suffixes that the character can be written as, its own first.

        Examples:
            >>> [motion] = stmc.load().generate("walk # 0 # 1", steps=1)
            >>> stmc.write(motion, "hero.bvh")
            >>> stmc.read_character("hero.bvh").formats
            ('.bvh', '.vrma')
        """
        return self.body.formats


@dataclass(frozen=True, eq=False)
class CharacterMotion:
    """A motion of a character; the result of `retarget`.

    Examples:
        >>> [motion] = stmc.load().generate("walk # 0 # 1", steps=1)
        >>> stmc.write(motion, "hero.glb")
        >>> stmc.retarget(motion, "hero.glb").write("hero_walks.glb")
    """

    character: Character
    motion: RigMotion
    """Joints over time, in the unit of the character."""

    def write(self, path: str | Path) -> None:
        """Write the character with its motion, in the format of `path`'s suffix.

        `.glb`, and `.vrm` for a VRM file, are the character's file with an additional animation, which comes first;
        meshes, materials, textures and nodes are unchanged. `.vrma` is VRM Animation. `.bvh` is the character's own
        skeleton, in its unit. `.csv` of a robot is MuJoCo's `qpos`, or the joints of a URDF, in each frame. An existing
        file is replaced once the new one is complete.

        Raises:
            ValueError: For another suffix.

        Examples:
            >>> [motion] = stmc.load().generate("walk # 0 # 1", steps=1)
            >>> stmc.write(motion, "hero.glb")
            >>> stmc.retarget(motion, "hero.glb").write("hero_walks.vrma")
        """
        path = Path(path)
        if path.suffix.lower() not in self.character.formats:
            choices = ", ".join(self.character.formats)
            raise CharacterError(f"{path}: cannot write {path.suffix!r} of this character; choose from {choices}")
        content = self.content(path.suffix.lower())
        write_whole(path, lambda temporary: temporary.write_bytes(content))

    def content(self, suffix: str) -> bytes:
        """Return the bytes of a file with this suffix, one of `character.formats`.

        Examples:
            >>> [motion] = stmc.load().generate("walk # 0 # 1", steps=1)
            >>> stmc.write(motion, "hero.glb")
            >>> stmc.retarget(motion, "hero.glb").content(".glb")[:4]
            b'glTF'
        """
        return self.character.body.content(suffix, self.motion, self.character.standing)


def read_character(path: str | Path, joint_map: str | Path | Mapping[str, str | None] | None = None) -> Character:
    """Read the character of a `.glb`, `.gltf` or `.vrm` file, the skeleton of a `.bvh`, or a robot's `.xml` or `.urdf`.

    Joints are identified by VRM's humanoid map, by their names (Mixamo, Unreal, Unity, Rigify, MakeHuman, Daz, Biped,
    CMU, SMPL), or by the shape of the rig. The rest pose must be upright, a T-pose or an A-pose. The trunk may have any
    number of joints. A robot is a humanoid in MJCF or URDF, without its meshes; it may lack head and hands.

    Args:
        path: The file.
        joint_map: Corrections, as a YAML file or a mapping from our joint names to those of the file, such as
            `left_knee: Shin.L`. null means that the character has no such joint.

    Raises:
        ValueError: With a sentence that names the file and the problem: no skin, no bones, a missing joint, several
            skeletons, nodes in a cycle, numbers that are not finite, data in other files, compressed or too large
            meshes.

    Examples:
        >>> [motion] = stmc.load().generate("walk # 0 # 1", steps=1)
        >>> stmc.write(motion, "hero.glb")
        >>> len(stmc.read_character("hero.glb").joint_map)
        18
    """
    path = Path(path)
    read = _READERS.get(path.suffix.lower())
    if read is None:
        choices = ", ".join(_READERS)
        raise CharacterError(f"{path}: cannot read a character from a {path.suffix!r} file; choose from {choices}")
    corrections = _read_map(Path(joint_map)) if isinstance(joint_map, (str, Path)) else joint_map or {}
    try:
        return read(path, corrections)
    except ValueError as error:
        raise CharacterError(f"{path}: {error}") from None


def character_of_joints(
    names: Sequence[str],
    parents: Sequence[int],
    places: Float[np.ndarray, "nodes 3"],
    joint_map: Mapping[str, str | None] | None = None,
) -> Character:
    """Make the character of a skeleton that is in no file.

    Raises `ValueError` as `read_character`.

    Args:
        names: Name of each joint.
        parents: Parent of each joint, -1 for roots; parents stand before their children.
        places: Positions of the joints at rest, y up, in any unit.
        joint_map: As in `read_character`.

    Examples:
        >>> rest = stmc.motion.body_model.Skeleton.default().rest.double().numpy()
        >>> body = stmc.motion.body
        >>> hero = stmc.formats.characters.character_of_joints(body.JOINTS, body.PARENTS, rest)
        >>> hero.found_by, hero.joint_map["left_knee"]
        ("the joints' names", 'left_knee')
    """
    body = BvhRig(tuple(names), tuple(parents), places)
    return _character(body, list(range(len(names))), {}, joint_map or {}, y_up=False)


def retarget(motion: Motion, character: Character | str | Path, fps: float | int | None = None) -> CharacterMotion:
    """Transfer a motion to a character.

    Arms and legs point in the directions of the motion, independent of the rest pose and the roll of bones. Rotations
    of the trunk are spread over the character's own spine. Translations scale with the length of the legs. Standing
    feet keep their contacts. Hands near the head or near each other keep their relative positions, in arm lengths.
    Joints without a counterpart keep the rest pose. The hinges of a robot follow this by least squares, within their
    limits of angle and speed.

    Args:
        motion: Motion to transfer.
        character: Character, or its file.
        fps: Frame rate of the result. None means 50 for a robot, and that of the motion for another character.

    Raises:
        ValueError: As `read_character`.

    Examples:
        >>> [motion] = stmc.load().generate("walk # 0 # 1", steps=1)
        >>> stmc.write(motion, "hero.glb")
        >>> walking = stmc.retarget(motion, "hero.glb")
        >>> walking.motion.places.shape[0]
        20
    """
    character = character if isinstance(character, Character) else read_character(character)
    fps = character.body.fps if fps is None else fps
    return CharacterMotion(character, transfer(motion if fps is None else motion.resampled(fps), character.rig))


def _from_gltf(path: Path, corrections: _Corrections) -> Character:
    body = GltfRig.of(read_gltf(path))
    return _character(body, sorted(body.joints), body.humanoid(), corrections, y_up=True)


def _from_bvh(path: Path, corrections: _Corrections) -> Character:
    body = BvhRig.of(parse_bvh(read_text(path, _MOST_BVH)))
    return _character(body, list(range(len(body.names))), {}, corrections, y_up=False)


def _from_robot(path: Path, corrections: _Corrections) -> Character:
    pieces = Pieces.of(read_urdf(path) if path.suffix.lower() == ".urdf" else read_mjcf(path))
    found_by, joints = identify_joints(pieces)
    if corrections:
        found_by, joints = f"{found_by}, corrected by the joint map", _corrected(joints, pieces.names, corrections)
    body, rig, standing = rig_robot(pieces, joints)
    return Character(rig, found_by, body, standing)


_READERS: dict[str, Callable[[Path, _Corrections], Character]] = {
    ".glb": _from_gltf,
    ".gltf": _from_gltf,
    ".vrm": _from_gltf,
    ".bvh": _from_bvh,
    ".xml": _from_robot,
    ".urdf": _from_robot,
}


def _character(
    body: GltfRig | BvhRig, nodes: list[int], humanoid: dict[str, int], corrections: _Corrections, y_up: bool
) -> Character:
    found_by, joints = "VRM's humanoid map", humanoid
    if not joints:
        found_by, joints = "the joints' names", joints_by_name(body.names, nodes)
    shape = {} if joints and "head" in joints else joints_by_shape(body.parents, body.places, nodes)
    if not joints:
        found_by, joints = "the rig's shape", shape
    if "head" in shape:
        joints.setdefault("head", shape["head"])
    if corrections:
        found_by, joints = f"{found_by}, corrected by the joint map", _corrected(joints, body.names, corrections)
    rig, standing = stand(body.names, body.parents, body.places, joints, y_up)
    return Character(rig, found_by, body, standing)


def _corrected(joints: Mapping[str, int], names: tuple[str, ...], corrections: _Corrections) -> dict[str, int]:
    corrected = dict(joints)
    for joint, name in corrections.items():
        if joint not in MAPPED:
            raise CharacterError(f"joint map: {quote(joint)} is not a joint of SMPL; choose from {', '.join(MAPPED)}")
        if name is None:
            corrected.pop(joint, None)
        elif name in names:
            corrected[joint] = names.index(name)
        else:
            has = truncate(", ".join(names), 200)
            raise CharacterError(f"joint map: {joint} is {quote(name)}, but the file's joints are {has}")
    return corrected


def _read_map(path: Path) -> dict[str, str | None]:
    try:
        content = yaml.safe_load(read_text(path, _MOST_MAP))
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        raise CharacterError(f"{path}: {truncate(str(error), 200)}") from None
    strings = (str, type(None))
    if not isinstance(content, dict) or not all(isinstance(each, strings) for row in content.items() for each in row):
        raise CharacterError(f"{path}: a joint map has lines such as 'left_knee: Shin.L'")
    return content
