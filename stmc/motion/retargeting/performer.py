"""A moving body, as the source or the target of retargeting.

Knows rotations, positions and soles. Rest poses stand upright on the floor at 0, z up, facing -y.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from stmc.motion.retargeting.rig import LIMBS, SIDES, limb_length

_TOES = 0.12
"""The distance from ankle to toes of a rig without toes, as a share of the leg's length."""


@dataclass(frozen=True, eq=False)
class Performer:
    """Nodes over time; `joints` maps joints of SMPL to nodes."""

    turns: Float[Tensor, "frames nodes 3 3"]
    """Each node's turn from its rest pose, in the world's axes."""
    places: Float[Tensor, "frames nodes 3"]
    rest: Float[Tensor, "nodes 3"]
    joints: Mapping[str, int]

    def turn(self, joint: str) -> Float[Tensor, "frames 3 3"]:
        """Return the turns of a joint of ours from its rest pose."""
        return self.turns[:, self.joints[joint]]

    def at(self, joint: str) -> Float[Tensor, "frames 3"]:
        """Return the positions of a joint of ours."""
        return self.places[:, self.joints[joint]]

    def resting(self, joint: str) -> Float[Tensor, " 3"]:
        """Return the rest position of a joint of ours."""
        return self.rest[self.joints[joint]]

    def length(self, limb: tuple[str, ...]) -> float:
        """Return the mean length of both legs or arms along their bones, at rest."""
        return limb_length(self.resting, limb)

    @property
    def ankles(self) -> float:
        """The mean height of the ankles above the soles."""
        return sum(float(self.resting(f"{side}_ankle")[2]) for side in SIDES) / 2

    def resting_sole(self, side: str) -> Float[Tensor, "2 3"]:
        """Return heel and toes at rest: the points on the floor below the ankle and the toe joint."""
        ankle = self.resting(f"{side}_ankle")
        if f"{side}_foot" in self.joints:
            toes = self.resting(f"{side}_foot")
        else:
            toes = ankle - ankle.new_tensor([0.0, _TOES * self.length(LIMBS[0]), 0.0])
        return torch.stack([ankle, toes]) * ankle.new_tensor([1.0, 1.0, 0.0])

    def soles(self) -> Float[Tensor, "frames 2 2 3"]:
        """Return the positions of heel and toes of the left and the right foot."""
        feet = []
        for side in SIDES:
            arms = self.resting_sole(side) - self.resting(f"{side}_ankle")
            turn = self.turn(f"{side}_ankle")
            feet.append(self.at(f"{side}_ankle")[:, None] + torch.stack([turn @ arm for arm in arms], dim=1))
        return torch.stack(feet, dim=1)
