"""What is drawn of a body: a surface carried by SMPL's 24 joints, be it a mannequin or the user's SMPL mesh.

Knows which joint moves which vertex and which body part colours which face. Knows no time and no colour.
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

    `vertices` [vertices, 3] metres, in SMPL's rest axes (x left, y up, z forward); `faces` [faces, 3] vertex indexes,
    counter-clockwise seen from outside; `weights` [vertices, 24], rows sum to 1; `parts` [faces], the body part (index
    in the order of `BodyPart`) whose colour a face bears.
    """

    vertices: np.ndarray
    faces: np.ndarray
    weights: np.ndarray
    parts: np.ndarray
    skeleton: Skeleton
    """The joints within: their rest positions are where `vertices` are."""

    @classmethod
    def of_body(cls, body: Body) -> Skin:
        """The skin of an SMPL, SMPL-H or SMPL-X body, without the bulges that depend on the pose.

        Fingers, jaw and eyes move with the hand or head that bears them. A face belongs to the body part that weighs
        most on its corners.
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
        """How the motion turns and places this body's 24 joints in the world."""
        rotations = global_rotations(motion.rotations.double(), PARENTS)
        return rotations.cpu().numpy(), self.skeleton.pose(motion.rotations, motion.translation).double().cpu().numpy()

    def posed(self, motion: Motion) -> np.ndarray:
        """Vertices [frames, vertices, 3] in the world."""
        rotations, joints = self.bones(motion)
        rest = self.skeleton.rest.double().numpy()
        offsets = joints - np.einsum("fjab,jb->fja", rotations, rest)
        turned = np.einsum("vj,fjab->fvab", self.weights, rotations)
        return np.einsum("fvab,vb->fva", turned, self.vertices) + np.einsum("vj,fja->fva", self.weights, offsets)

    def only(self, part: BodyPart) -> Skin:
        """The piece that bears one part's colour, with vertices of its own."""
        faces = self.faces[self.parts == PARTS.index(part)]
        used, renumbered = np.unique(faces, return_inverse=True)
        parts = np.full(len(faces), PARTS.index(part))
        return Skin(self.vertices[used], renumbered.reshape(-1, 3), self.weights[used], parts, self.skeleton)


def _carriers(parents: Sequence[int]) -> list[int]:
    """For each bone of a body, the one of our 24 joints that carries it."""
    hands = {JOINTS.index(f"{side}_wrist"): JOINTS.index(f"{side}_hand") for side in ("left", "right")}
    carriers: list[int] = []
    for bone, parent in enumerate(parents):
        carriers.append(bone if bone < NUM_ROTATIONS else hands.get(carriers[parent], carriers[parent]))
    return carriers
