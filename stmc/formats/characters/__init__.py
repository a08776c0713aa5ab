"""Users' characters and robots, and motions on them: glTF, VRM and BVH files, MuJoCo's models and URDF.

Depends on files and rigs; the kinematics are in `motion.retargeting`.
"""

from stmc.formats.characters.character_poses import stage_poses
from stmc.formats.characters.characters import (
    Character,
    CharacterMotion,
    character_of_joints,
    read_character,
    retarget,
)
from stmc.formats.characters.gltf_file import CharacterError
from stmc.formats.characters.rest_skeletons import RestSkeleton, SkeletonKeys, skeleton_keys

__all__ = [
    "Character",
    "CharacterError",
    "CharacterMotion",
    "RestSkeleton",
    "SkeletonKeys",
    "character_of_joints",
    "read_character",
    "retarget",
    "skeleton_keys",
    "stage_poses",
]
