"""Users' characters and robots, and motions on them: glTF, VRM and BVH files, MuJoCo's models and URDF.

Depends on files and rigs; the kinematics are in `motion.retargeting`.
"""

from stmc.formats.characters.characters import Character, CharacterMotion, read_character, retarget
from stmc.formats.characters.gltf_file import CharacterError

__all__ = ["Character", "CharacterError", "CharacterMotion", "read_character", "retarget"]
