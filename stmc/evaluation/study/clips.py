"""Motions as survey pages draw them: moved to a common start, and possibly with stretched limbs.

This module does not know methods; two clips of a pair differ only in their movement.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float

from stmc.formats.glb import Animation
from stmc.motion.body import JOINTS, PARENTS
from stmc.motion.geometry import rotation_z
from stmc.motion.motion import Motion

_GROWTH = {"shoulder": 1.6, "hip": 1.0}
"""Maximum relative growth of the limb below a joint; 1.6 stretches it up to 2.6 times."""
_PERIOD = 2.0
"""Period in seconds of the growing and shrinking of a stretched limb."""


@dataclass(frozen=True, eq=False)
class Clip:
    """A motion that begins at the origin and faces -y, with scales of the limbs below joints."""

    motion: Motion
    scales: Mapping[str, Float[np.ndarray, " frames"]] | None = None

    @classmethod
    def of(cls, motion: Motion) -> Clip:
        """Move a motion to the origin and turn it to face -y first, so that its start does not reveal the method."""
        rotations, translation, joints = (
            each.double().cpu() for each in (motion.rotations, motion.translation, motion.joints)
        )
        origin = translation[0] * torch.tensor([1.0, 1.0, 0.0])
        back = rotation_z(-motion.heading[0].double().cpu())
        turned = torch.cat([back @ rotations[:, :1], rotations[:, 1:]], dim=1)
        return cls(Motion(turned, (translation - origin) @ back.T, (joints - origin) @ back.T, motion.fps))

    @property
    def duration(self) -> float:
        """The time in seconds from the first frame to the last."""
        return (self.motion.frames - 1) / self.motion.fps

    @property
    def joints(self) -> Float[np.ndarray, "frames joints 3"]:
        """The positions at which joints are drawn, in metres, z up."""
        joints = self.motion.joints.double().cpu().numpy()
        return joints if self.scales is None else _enlarge(joints, self.scales)

    @property
    def animation(self) -> Animation:
        """The animation for the file of a figure."""
        return Animation(self.motion, self.scales)

    def stretched(self) -> Clip:
        """Return the clip with arms and legs that grow to twice their size or more and shrink again.

        The height of the lowest joint stays the same.
        """
        time = np.arange(self.motion.frames) / self.motion.fps
        scales = {}
        for joint, growth in _GROWTH.items():
            for side, late in (("left", 0.0), ("right", math.pi)):
                wave = 0.5 - 0.5 * np.cos(2 * math.pi * time / _PERIOD + late)
                scales[f"{side}_{joint}"] = 1 + growth * wave
        joints = self.motion.joints.double().cpu()
        sunk = joints[..., 2].amin(dim=1) - torch.from_numpy(_enlarge(joints.numpy(), scales)[..., 2].min(axis=1))
        shift = torch.stack([torch.zeros_like(sunk), torch.zeros_like(sunk), sunk], dim=-1)
        motion = self.motion
        raised = Motion(motion.rotations, motion.translation + shift, joints + shift[:, None], motion.fps)
        return Clip(raised, scales)


def _enlarge(
    joints: Float[np.ndarray, "frames joints 3"], scales: Mapping[str, Float[np.ndarray, " frames"]]
) -> Float[np.ndarray, "frames joints 3"]:
    """Scale the positions of all descendants of some joints relative to these."""
    result = joints.copy()
    for name, factors in scales.items():
        root = JOINTS.index(name)
        for joint in range(root + 1, len(JOINTS)):
            above = joint
            while above > root:
                above = PARENTS[above]
            if above == root:
                result[:, joint] = joints[:, root] + factors[:, None] * (joints[:, joint] - joints[:, root])
    return result
