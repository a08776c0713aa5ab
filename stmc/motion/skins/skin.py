"""The surface of a body, carried by SMPL's 24 joints: a mannequin or the user's SMPL mesh.

Defines the joints that move each vertex and the body part that colours each face. Independent of time and colours.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float

from stmc.motion.body import JOINTS, NUM_ROTATIONS, PARENTS, BodyPart
from stmc.motion.body_model import Body, Skeleton
from stmc.motion.geometry import global_rotations
from stmc.motion.motion import Motion

PARTS = tuple(BodyPart)
_OWNERS = np.array([next(i for i, part in enumerate(PARTS) if name in part.joints) for name in JOINTS])


@dataclass(frozen=True)
class Skin:
    """A surface in the rest pose and the joints that carry it (linear blend skinning).

    Args:
        vertices: Vertices [vertices, 3] in metres, in SMPL's rest axes (x left, y up, z forward).
        faces: Vertex indices [faces, 3], counter-clockwise seen from outside.
        weights: Skinning weights [vertices, 24]; rows sum to 1.
        parts: Body part of each face [faces], an index in the order of `BodyPart`, which determines its colour.
        skeleton: Joints, whose rest positions belong to `vertices`.
    """

    vertices: np.ndarray
    faces: np.ndarray
    weights: np.ndarray
    parts: np.ndarray
    skeleton: Skeleton
    """The joints, whose rest positions belong to `vertices`."""

    @classmethod
    def of_body(cls, body: Body) -> Skin:
        """Create the skin of an SMPL, SMPL-H or SMPL-X body, without pose-dependent deformations.

        Fingers, jaw and eyes move with the hand or head that carries them. A face belongs to the body part with the
        largest weight at its corners.
        """
        rest = body.skeleton.rest
        upright = torch.eye(3, dtype=rest.dtype).expand(1, NUM_ROTATIONS, 3, 3)
        carriers = np.eye(len(JOINTS))[_carriers(body.parents.tolist())]
        weights, faces = body.lbs_weights.double().numpy() @ carriers, body.faces.numpy()
        mass = weights[faces].sum(axis=1) @ np.eye(len(PARTS))[_OWNERS]
        vertices = body.vertices(upright, rest[:1])[0].double().numpy()
        return cls(vertices, faces, weights, mass.argmax(axis=1), body.skeleton)

    def bones(
        self, motion: Motion
    ) -> tuple[Float[np.ndarray, "frames joints 3 3"], Float[np.ndarray, "frames joints 3"]]:
        """Compute the world rotations and positions of this body's 24 joints in a motion."""
        rotations = global_rotations(motion.rotations.double(), PARENTS)
        return rotations.cpu().numpy(), self.skeleton.pose(motion.rotations, motion.translation).double().cpu().numpy()

    def posed(self, motion: Motion) -> np.ndarray:
        """Compute vertices [frames, vertices, 3] in the world."""
        rotations, joints = self.bones(motion)
        rest = self.skeleton.rest.double().numpy()
        offsets = joints - np.einsum("fjab,jb->fja", rotations, rest)
        blended = np.einsum("vj,fjab->fvab", self.weights, rotations)
        return np.einsum("fvab,vb->fva", blended, self.vertices) + np.einsum("vj,fja->fva", self.weights, offsets)


def _carriers(parents: Sequence[int]) -> list[int]:
    """Return, for each bone of a body, the index of the SMPL joint that carries it."""
    hands = {JOINTS.index(f"{side}_wrist"): JOINTS.index(f"{side}_hand") for side in ("left", "right")}
    carriers: list[int] = []
    for bone, parent in enumerate(parents):
        carriers.append(bone if bone < NUM_ROTATIONS else hands.get(carriers[parent], carriers[parent]))
    return carriers
