"""Bodies: a skeleton of 24 joints with adult proportions, and SMPL meshes where the user has the files.

Knows rest poses and how rotations pose them; knows no time. Everything here speaks of pelvis positions, as `Motion`
does; `smpl_translation` is the one place that knows what SMPL adds to them.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from importlib.resources import files

import torch
from jaxtyping import Float
from torch import Tensor

from stmc.body import JOINTS, PARENTS
from stmc.geometry import forward_kinematics


@dataclass(frozen=True, eq=False)
class Skeleton:
    """Bones of 24 joints in `body.JOINTS`' order, in SMPL's rest pose (x left, y up, z forward, metres)."""

    offsets: Float[Tensor, "24 3"]
    """Each joint's rest position relative to its parent; the first row is the rest position of the pelvis."""

    @classmethod
    def default(cls) -> Skeleton:
        """The bundled skeleton, with proportions of the training data (float32, CPU)."""
        table = json.loads((files("stmc") / "assets" / "skeleton.json").read_text("utf-8"))
        return cls(torch.tensor([table[joint] for joint in JOINTS]))

    @property
    def rest(self) -> Float[Tensor, "24 3"]:
        """Joint positions in the rest pose, in SMPL's axes."""
        identity = torch.eye(3, dtype=self.offsets.dtype, device=self.offsets.device).expand(len(JOINTS), 3, 3)
        return self.offsets[0] + forward_kinematics(identity, self.offsets, PARENTS)

    def pose(
        self, rotations: Float[Tensor, "*batch 22 3 3"], translation: Float[Tensor, "*batch 3"]
    ) -> Float[Tensor, "*batch 24 3"]:
        """Joint positions of the body with these local rotations and the pelvis at `translation`."""
        offsets = self.offsets.to(rotations)
        return translation[..., None, :] + forward_kinematics(rotations, offsets, PARENTS)

    def smpl_translation(self, pelvis: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3"]:
        """SMPL's `trans` for pelvis positions: less the rest pelvis, which SMPL adds whatever the rotation."""
        return pelvis - self.offsets[0].to(pelvis)
