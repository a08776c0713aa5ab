"""Characters that others made, and our motions on them: glTF, VRM and BVH in, the same with an animation out.

Knows files and rigs; the kinematics are `motion.retargeting`'s.
"""

from stmc.formats.characters.characters import Character, CharacterMotion, read_character, retarget
from stmc.formats.characters.gltf_file import CharacterError

__all__ = ["Character", "CharacterError", "CharacterMotion", "read_character", "retarget"]
