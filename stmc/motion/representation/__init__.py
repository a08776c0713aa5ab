"""Motions as feature vectors with named layouts."""

from stmc.motion.representation.babel import BabelRepresentation
from stmc.motion.representation.features import JointsFrom, Representation
from stmc.motion.representation.humanml3d import HumanML3DRepresentation
from stmc.motion.representation.layout import BABEL_LAYOUT, HUMANML3D_LAYOUT, SMPL_LAYOUT, Field, Layout
from stmc.motion.representation.smpl import SmplRepresentation

__all__ = [
    "BABEL_LAYOUT",
    "HUMANML3D_LAYOUT",
    "SMPL_LAYOUT",
    "BabelRepresentation",
    "Field",
    "HumanML3DRepresentation",
    "JointsFrom",
    "Layout",
    "Representation",
    "SmplRepresentation",
]
