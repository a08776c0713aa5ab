"""Users' characters, and motions on them: reads glTF, VRM and BVH, and writes the same files with an animation.

Depends on files and rigs; the kinematics are in `motion.retargeting`.
"""

from stmc.formats.characters.characters import Character, CharacterMotion, read_character, retarget
from stmc.formats.characters.gltf_file import CharacterError

__all__ = ["Character", "CharacterError", "CharacterMotion", "read_character", "retarget"]
