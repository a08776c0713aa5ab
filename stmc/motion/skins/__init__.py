"""Surfaces of bodies: a mannequin around any skeleton, or the user's SMPL mesh. Independent of colours and time."""

from stmc.motion.skins.mannequin import build_mannequin, skin_of
from stmc.motion.skins.skin import PARTS, Skin

__all__ = ["PARTS", "Skin", "build_mannequin", "skin_of"]
