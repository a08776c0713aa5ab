"""Motions on bodies that are not ours: rigs with joints of their own names, number, proportions and rest pose.

Knows positions and rotations; knows no file.
"""

from stmc.motion.retargeting.rig import Rig, RigError
from stmc.motion.retargeting.rig_motion import RigMotion, transfer

__all__ = ["Rig", "RigError", "RigMotion", "transfer"]
