"""The 135 numbers per frame that models of BABEL are trained on (Athanasiou et al. 2022; FlowMDM, section 4.1): motions
to features and back.

Knows the formulas; where each number stands is `layout.BABEL_LAYOUT`'s to say. Not normalised.
"""

from __future__ import annotations

import math
from typing import ClassVar

import torch
from einops import rearrange
from jaxtyping import Float
from torch import Tensor

from stmc.motion.body_model import Skeleton
from stmc.motion.geometry import heading as heading_of
from stmc.motion.geometry import matrix_to_axis_angle, matrix_to_rows, rotation_z, rows_to_matrix
from stmc.motion.motion import Motion
from stmc.motion.representation.features import Representation
from stmc.motion.representation.layout import BABEL_LAYOUT, Layout


class BabelRepresentation(Representation):
    """Motion ⇄ features in the world's axes, once the whole motion was turned to begin facing one way.

    Per frame, in metres and *per frame* (not per second), z up:

    - `root_height`: z of the pelvis. Published features have SMPL's translation here, which lies lower by the height of
      the rest pose's pelvis (some centimetres; see `Skeleton.smpl_translation`);
    - `root_velocity`: horizontal step of the pelvis from the frame before; zero in the first;
    - `rotations`: 22 local rotations, each the first two rows of its matrix; the root's with its heading.

    What the motion is turned by is taken from the first root rotation's axis-angle vector: its z component, and a
    quarter turn. That is the heading only about; so one motion seen from two sides has features that are a turn about
    the vertical apart. It is what published models were trained on.
    """

    layout: ClassVar[Layout] = BABEL_LAYOUT

    @property
    def skeleton(self) -> Skeleton:
        """The bundled one: the features have no bones of their own."""
        return Skeleton.default()

    def encode(self, motion: Motion) -> Float[Tensor, "frames features"]:
        """Features of every frame, in the motion's dtype."""
        return self.differentiate(*_turned(motion.rotations, motion.translation, -_first_angle(motion.rotations)))

    def decode(
        self,
        features: Float[Tensor, "frames features"],
        fps: float | int,
        skeleton: Skeleton | None = None,
        heading: float | int = 0.0,
    ) -> Motion:
        """The motion that starts above the origin with `heading` radians, posed on `skeleton` (None: the bundled one);
        any finite features give one. Raises `ValueError` for another width than 135."""
        rotations, translation = self.integrate(features)
        rotations, translation = _turned(rotations, translation, heading - heading_of(rotations[0, 0]))
        return Motion.posed(rotations, translation, fps, self.skeleton if skeleton is None else skeleton)

    def differentiate(
        self, rotations: Float[Tensor, "frames 22 3 3"], translation: Float[Tensor, "frames 3"]
    ) -> Float[Tensor, "frames 135"]:
        """Features of a motion as it stands, not turned."""
        steps = translation[:, :2].diff(dim=0, prepend=translation[:1, :2])
        rows = rearrange(matrix_to_rows(rotations), "frames joints six -> frames (joints six)")
        fields = {"root_height": translation[:, 2:], "root_velocity": steps, "rotations": rows}
        return torch.cat([fields[field.name] for field in self.layout.fields], dim=-1)

    def integrate(
        self, features: Float[Tensor, "frames features"]
    ) -> tuple[Float[Tensor, "frames 22 3 3"], Float[Tensor, "frames 3"]]:
        """Rotations and pelvis positions, from above the origin on: the inverse of `differentiate`."""
        if features.shape[-1] != self.width:
            raise ValueError(f"features must have {self.width} columns, not {features.shape[-1]}")
        path = features[:, self.layout["root_velocity"]].cumsum(dim=0)
        translation = torch.cat([path - path[:1], features[:, self.layout["root_height"]]], dim=-1)
        rows = rearrange(features[:, self.layout["rotations"]], "frames (joints six) -> frames joints six", six=6)
        return rows_to_matrix(rows), translation


def _first_angle(rotations: Float[Tensor, "frames 22 3 3"]) -> Float[Tensor, ""]:
    return matrix_to_axis_angle(rotations[0, 0])[2] + math.pi / 2


def _turned(
    rotations: Float[Tensor, "frames 22 3 3"], translation: Float[Tensor, "frames 3"], angle: Float[Tensor, ""]
) -> tuple[Float[Tensor, "frames 22 3 3"], Float[Tensor, "frames 3"]]:
    """About the vertical through the origin."""
    turn = rotation_z(angle)
    return torch.cat([(turn @ rotations[:, 0])[:, None], rotations[:, 1:]], dim=1), translation @ turn.mT
