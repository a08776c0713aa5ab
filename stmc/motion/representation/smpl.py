"""The 205 features per frame of MDM-SMPL (STMC, section 3.4 and appendix D): motions to features and back.

`layout.SMPL_LAYOUT` defines the order of the features. They are not normalised.
"""

from __future__ import annotations

from typing import ClassVar

import torch
from einops import rearrange
from jaxtyping import Float
from torch import Tensor

from stmc.motion.body import JOINTS, PARENTS, BodyPart
from stmc.motion.body_model import Skeleton
from stmc.motion.geometry import forward_kinematics, matrix_to_rows, rotation_z, rows_to_matrix, wrap
from stmc.motion.geometry import heading as heading_of
from stmc.motion.motion import Motion, Posable
from stmc.motion.representation.features import Representation
from stmc.motion.representation.layout import SMPL_LAYOUT, Layout

_LEGS = [JOINTS.index(joint) for joint in BodyPart.LEGS.joints]
_LEG_PARENTS = [-1, *(_LEGS.index(PARENTS[joint]) for joint in _LEGS[1:])]
_ARMS = [JOINTS.index(name) for name in ("pelvis", "spine1", "spine2", "spine3")] + [
    JOINTS.index(f"{side}_{name}") for name in ("collar", "shoulder", "elbow", "wrist") for side in ("left", "right")
]
_ARM_PARENTS = [-1, *(_ARMS.index(PARENTS[joint]) for joint in _ARMS[1:])]


class SmplRepresentation(Representation):
    """Motion ⇄ features that do not depend on the body's position and heading.

    Per frame, in metres, radians and *per frame* (not per second), z up:

    - `root_height`: height of the pelvis above the lowest joint of the whole motion;
    - `root_velocity`: horizontal step of the pelvis to the next frame, in this frame's heading frame;
    - `yaw_velocity`: turn of the heading to the next frame;
    - `rotations`: 22 local rotations, each as the first two rows of its matrix; the root's excludes the heading;
    - `positions`: positions of joints 1 to 23 relative to the pelvis, in the heading frame.
    """

    layout: ClassVar[Layout] = SMPL_LAYOUT

    @property
    def skeleton(self) -> Skeleton:
        """The default skeleton."""
        return Skeleton.default()

    def encode(self, motion: Motion) -> Float[Tensor, "frames features"]:
        """Compute the features of `motion`, in its dtype.

        The last frame has no next frame: its velocities extrapolate the two before linearly (constant for two frames,
        zero for one).
        """
        root, pelvis = motion.rotations[:, 0], motion.joints[:, 0]
        yaw = heading_of(root)
        to_heading = rotation_z(-yaw)
        steps = pelvis[:, :2].diff(dim=0)
        velocity = to_heading[:, :2, :2] @ _extrapolate(steps)[..., None]
        turn = wrap(_extrapolate(wrap(yaw.diff(dim=0))))
        rotations = torch.cat([(to_heading @ root)[:, None], motion.rotations[:, 1:]], dim=1)
        positions = (motion.joints[:, 1:] - pelvis[:, None]) @ to_heading.mT
        fields = {
            "root_height": (pelvis[:, 2] - motion.joints[..., 2].min())[:, None],
            "root_velocity": velocity[..., 0],
            "yaw_velocity": turn[:, None],
            "rotations": rearrange(matrix_to_rows(rotations), "frames joints width -> frames (joints width)"),
            "positions": rearrange(positions, "frames joints width -> frames (joints width)"),
        }
        return torch.cat([fields[field.name] for field in self.layout.fields], dim=-1)

    def decode(
        self,
        features: Float[Tensor, "frames features"],
        fps: float | int,
        skeleton: Posable | None = None,
        heading: float | int = 0.0,
    ) -> Motion:
        """Decode any finite features to a motion that starts above the origin with `heading`.

        Args:
            features: Features, [frames, 205].
            fps: Frames per second.
            skeleton: Skeleton to pose, so that bones keep their lengths (for exports and viewers); None uses the joint
                positions of the features.
            heading: Initial heading in radians.

        Raises:
            ValueError: If the width is not 205.
        """
        rotations, translation, joints = self.integrate(features, heading)
        if skeleton is not None:
            return Motion.posed(rotations, translation, fps, skeleton)
        return Motion(rotations, translation, joints, fps)

    def integrate(
        self, features: Float[Tensor, "*batch frames features"], heading: float | int | Float[Tensor, "*batch"] = 0.0
    ) -> tuple[
        Float[Tensor, "*batch frames 22 3 3"], Float[Tensor, "*batch frames 3"], Float[Tensor, "*batch frames 24 3"]
    ]:
        """Compute rotations, pelvis positions and joints of one or many feature sequences, for `decode`.

        The heading of the predicted root rotation is replaced by the integrated heading, as published. Padded frames
        follow the valid ones and do not influence them.
        """
        if features.shape[-1] != self.width:
            raise ValueError(f"features have {features.shape[-1]} columns; this representation needs {self.width}")
        first = torch.as_tensor(heading, dtype=features.dtype, device=features.device)
        yaw = first[..., None] + _integrate_steps(features[..., self.layout["yaw_velocity"]])[..., 0]
        from_heading = rotation_z(yaw)
        velocity = features[..., self.layout["root_velocity"], None]
        path = _integrate_steps((from_heading[..., :2, :2] @ velocity)[..., 0])
        translation = torch.cat([path, features[..., self.layout["root_height"]]], dim=-1)

        rows = rearrange(features[..., self.layout["rotations"]], "... (joints width) -> ... joints width", width=6)
        local = rows_to_matrix(rows)
        root = rotation_z(yaw - heading_of(local[..., 0, :, :])) @ local[..., 0, :, :]
        rotations = torch.cat([root[..., None, :, :], local[..., 1:, :, :]], dim=-3)

        local_positions = features[..., self.layout["positions"]]
        relative = rearrange(local_positions, "... (joints width) -> ... joints width", width=3) @ from_heading.mT
        pelvis = translation[..., None, :]
        return rotations, translation, torch.cat([pelvis, pelvis + relative], dim=-2)

    def foot_velocities(
        self, features: Float[Tensor, "*batch frames features"], skeleton: Skeleton
    ) -> Float[Tensor, "*batch _ 6"]:
        """Compute the steps of the left and right toes to the next frame, in metres, from rotations and root velocity.

        They are in the heading frame of the earlier frame, one frame shorter than the features, and differentiable.
        They vanish while a foot stands, as in MDM's foot loss (Tevet et al. 2023, Eq. 4).
        """
        rows = rearrange(features[..., self.layout["rotations"]], "... (joints width) -> ... joints width", width=6)
        local = rows_to_matrix(rows[..., _LEGS[:-2], :])
        root = rotation_z(-heading_of(local[..., 0, :, :])) @ local[..., 0, :, :]
        local = torch.cat([root[..., None, :, :], local[..., 1:, :, :]], dim=-3)
        feet = forward_kinematics(local, skeleton.offsets.to(features)[_LEGS], _LEG_PARENTS)[..., -2:, :]
        height = features[..., None, self.layout["root_height"]]
        feet = torch.cat([feet[..., :2], feet[..., 2:] + height], dim=-1)
        turn = rotation_z(features[..., :-1, self.layout["yaw_velocity"]])
        velocity = features[..., :-1, None, self.layout["root_velocity"]]
        steps = (turn @ feet[..., 1:, :, :, None])[..., 0] - feet[..., :-1, :, :]
        steps = torch.cat([steps[..., :2] + velocity, steps[..., 2:]], dim=-1)
        return rearrange(steps, "... feet width -> ... (feet width)")

    def wrist_velocities(
        self, features: Float[Tensor, "*batch frames features"], skeleton: Skeleton
    ) -> Float[Tensor, "*batch _ 6"]:
        """Compute the steps of the left and right wrists to the next frame, in metres, from rotations alone.

        They are relative to the pelvis in the heading frame of each frame, one frame shorter than the features, and
        differentiable.
        """
        rows = rearrange(features[..., self.layout["rotations"]], "... (joints width) -> ... joints width", width=6)
        local = rows_to_matrix(rows[..., _ARMS[:-2], :])
        wrists = forward_kinematics(local, skeleton.offsets.to(features)[_ARMS], _ARM_PARENTS)[..., -2:, :]
        return rearrange(wrists.diff(dim=-3), "... wrists width -> ... (wrists width)")


def _extrapolate(steps: Float[Tensor, " frames *width"]) -> Float[Tensor, " _ *width"]:
    """Append one value to `steps` by linear extrapolation."""
    if len(steps) == 0:
        return steps.new_zeros(1, *steps.shape[1:])
    last = 2 * steps[-1:] - steps[-2:-1] if len(steps) > 1 else steps
    return torch.cat([steps, last])


def _integrate_steps(steps: Float[Tensor, "*batch frames width"]) -> Float[Tensor, "*batch frames width"]:
    """Integrate steps from zero: sum all steps before each frame."""
    return torch.nn.functional.pad(steps.cumsum(dim=-2)[..., :-1, :], (0, 0, 1, 0))
