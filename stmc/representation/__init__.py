"""Motions as feature vectors with named layouts."""

from stmc.representation.humanml3d import HumanML3DRepresentation
from stmc.representation.layout import HUMANML3D_LAYOUT, SMPL_LAYOUT, Field, Layout
from stmc.representation.protocol import Representation
from stmc.representation.smpl import SmplRepresentation

__all__ = [
    "HUMANML3D_LAYOUT",
    "SMPL_LAYOUT",
    "Field",
    "HumanML3DRepresentation",
    "Layout",
    "Representation",
    "SmplRepresentation",
]
