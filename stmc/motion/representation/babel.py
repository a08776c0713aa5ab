"""The 135 features per frame of models trained on BABEL: motions to features and back.

See Athanasiou et al. (2022) and FlowMDM, section 4.1. `layout.BABEL_LAYOUT` defines the order of the features. They are
not normalised.
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
    """Motion ⇄ features in the world's axes, after rotating the whole motion to begin in one direction.

    Per frame, in metres and *per frame* (not per second), z up:

    - `root_height`: z of the pelvis. Published features have SMPL's translation here, which is lower by the height of
      the pelvis in the rest pose (some centimetres; see `Skeleton.smpl_translation`);
    - `root_velocity`: horizontal step of the pelvis from the previous frame; zero in the first;
    - `rotations`: 22 local rotations, each as the first two rows of its matrix; the root's includes its heading.

    The rotation angle of the motion is the z component of the axis-angle vector of the first root rotation, plus a
    quarter turn. This is only approximately the heading; therefore the features of one motion seen from two sides may
    differ by a rotation about the vertical. Published models were trained on these features.
    """

    layout: ClassVar[Layout] = BABEL_LAYOUT

    @property
    def skeleton(self) -> Skeleton:
        """The bundled skeleton: the features have no bones of their own."""
        return Skeleton.default()

    def encode(self, motion: Motion) -> Float[Tensor, "frames features"]:
        """Compute the features of every frame, in the motion's dtype."""
        return self.differentiate(*_rotate(motion.rotations, motion.translation, -_first_angle(motion.rotations)))

    def decode(
        self,
        features: Float[Tensor, "frames features"],
        fps: float | int,
        skeleton: Skeleton | None = None,
        heading: float | int = 0.0,
    ) -> Motion:
        """Decode any finite features to a motion that starts above the origin with `heading`.

        Args:
            features: Features, [frames, 135].
            fps: Frames per second.
            skeleton: Skeleton to pose; None uses the bundled one.
            heading: Initial heading in radians.

        Raises:
            ValueError: If the width is not 135.
        """
        rotations, translation = self.integrate(features)
        rotations, translation = _rotate(rotations, translation, heading - heading_of(rotations[0, 0]))
        return Motion.posed(rotations, translation, fps, self.skeleton if skeleton is None else skeleton)

    def differentiate(
        self, rotations: Float[Tensor, "frames 22 3 3"], translation: Float[Tensor, "frames 3"]
    ) -> Float[Tensor, "frames 135"]:
        """Compute the features of a motion without rotating it first."""
        steps = translation[:, :2].diff(dim=0, prepend=translation[:1, :2])
        rows = rearrange(matrix_to_rows(rotations), "frames joints six -> frames (joints six)")
        fields = {"root_height": translation[:, 2:], "root_velocity": steps, "rotations": rows}
        return torch.cat([fields[field.name] for field in self.layout.fields], dim=-1)

    def integrate(
        self, features: Float[Tensor, "frames features"]
    ) -> tuple[Float[Tensor, "frames 22 3 3"], Float[Tensor, "frames 3"]]:
        """Invert `differentiate`: compute rotations and pelvis positions, starting above the origin."""
        if features.shape[-1] != self.width:
            raise ValueError(f"features have {features.shape[-1]} columns; this representation needs {self.width}")
        path = features[:, self.layout["root_velocity"]].cumsum(dim=0)
        translation = torch.cat([path - path[:1], features[:, self.layout["root_height"]]], dim=-1)
        rows = rearrange(features[:, self.layout["rotations"]], "frames (joints six) -> frames joints six", six=6)
        return rows_to_matrix(rows), translation


def _first_angle(rotations: Float[Tensor, "frames 22 3 3"]) -> Float[Tensor, ""]:
    return matrix_to_axis_angle(rotations[0, 0])[2] + math.pi / 2


def _rotate(
    rotations: Float[Tensor, "frames 22 3 3"], translation: Float[Tensor, "frames 3"], angle: Float[Tensor, ""]
) -> tuple[Float[Tensor, "frames 22 3 3"], Float[Tensor, "frames 3"]]:
    """Rotate a motion about the vertical through the origin."""
    turn = rotation_z(angle)
    return torch.cat([(turn @ rotations[:, 0])[:, None], rotations[:, 1:]], dim=1), translation @ turn.mT
