"""Motions as feature vectors with named layouts."""

from stmc.representation.babel import BabelRepresentation
from stmc.representation.humanml3d import HumanML3DRepresentation
from stmc.representation.layout import BABEL_LAYOUT, HUMANML3D_LAYOUT, SMPL_LAYOUT, Field, Layout
from stmc.representation.protocol import JointsFrom, Representation
from stmc.representation.smpl import SmplRepresentation

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
