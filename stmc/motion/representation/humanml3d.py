"""The 263 features per frame of HumanML3D (Guo et al. 2022): motions to features and back.

The formulas use 22 joints in HumanML3D's own axes (y up, facing z at heading zero); only `y_up` and `z_up` convert
between the axes. `layout.HUMANML3D_LAYOUT` defines the order of the features. They are not normalised.

Checkpoints and evaluators were trained on this format, so its oddities are reproduced and documented in place: hips
enter the smoothed heading with the wrong sign, the first frame always faces ahead, and the sign of turns through the
half turn is lost.
"""

from __future__ import annotations

import json
from importlib.resources import files
from typing import Any, ClassVar

import torch
from einops import rearrange
from jaxtyping import Float
from torch import Tensor

from stmc.motion.body import JOINTS, NUM_ROTATIONS, PARENTS
from stmc.motion.body_model import Skeleton
from stmc.motion.geometry import rows_to_matrix, shortest_arc
from stmc.motion.inverse_kinematics import motion_of_joints
from stmc.motion.motion import Motion
from stmc.motion.representation.features import Representation
from stmc.motion.representation.layout import HUMANML3D_LAYOUT, Layout

_SMOOTHING = 20
"""Standard deviation, in frames, of the Gaussian that smooths the facing direction."""
_STILL = 0.002
"""Squared step to the next frame below which a foot joint touches the floor (m²; 4.5 cm, at 20 fps)."""
_CONTACTS = tuple(JOINTS.index(name) for name in ("left_ankle", "left_foot", "right_ankle", "right_foot"))
_LEFT_HIP, _RIGHT_HIP, _LEFT_SHOULDER, _RIGHT_SHOULDER = (
    JOINTS.index(name) for name in ("left_hip", "right_hip", "left_shoulder", "right_shoulder")
)
_ROTATION_PARENTS = tuple(0 if "collar" in name else parent for name, parent in zip(JOINTS, PARENTS, strict=True))
"""Joint that each rotation is relative to: arms do not inherit the rotation of the spine."""


class HumanML3DRepresentation(Representation):
    """Motion ⇄ features that do not depend on the body's position and heading. One row fewer than frames.

    The motion is retargeted to one skeleton, placed on the floor and rotated so that it starts facing ahead. Then, per
    frame, in metres and *per frame* (not per second), y up, in the smoothed heading frame:

    - `yaw_velocity`: *half* the turn of the heading to the next frame, in radians, positive to the right;
    - `root_velocity`: step of the pelvis to the next frame along x and z, in the next frame's heading frame;
    - `root_height`: height of the pelvis above the lowest joint of the whole motion;
    - `positions`: positions of joints 1 to 21, relative to the point of the floor below the pelvis;
    - `rotations`: rotations of the bones that end in joints 1 to 21, each as the first two columns of its matrix;
    - `velocities`: steps of joints 0 to 21 to the next frame;
    - `contacts`: 1 if ankles and feet rest.
    """

    layout: ClassVar[Layout] = HUMANML3D_LAYOUT

    @property
    def skeleton(self) -> Skeleton:
        """The skeleton of all HumanML3D motions."""
        return uniform_skeleton()

    def encode(self, motion: Motion) -> Float[Tensor, "frames features"]:
        """Compute the features of all frames but the last, in the motion's dtype. Rotations and hands are ignored.

        Raises `ValueError` if the motion has one frame, or a bone has no length.
        """
        return joints_to_features(y_up(motion.joints[:, :NUM_ROTATIONS]))

    def decode(
        self,
        features: Float[Tensor, "frames features"],
        fps: float | int,
        skeleton: Skeleton | None = None,
        heading: float | int = 0.0,
    ) -> Motion:
        """Decode features to a motion that starts above the origin with `heading`; as many frames as rows.

        Rotations follow from the joint positions in the features (`motion_of_joints`). The heading is that of hips and
        shoulders together; the pelvis alone may face slightly aside.

        Args:
            features: Features, [frames, 263].
            fps: Frames per second.
            skeleton: Skeleton to pose, so that bones have its lengths; None keeps the positions of the features.
            heading: Initial heading in radians.

        Raises:
            ValueError: If the width is not 263, or there are no rows.
        """
        rotated = _rotate_y(features_to_joints(features), torch.as_tensor(float(heading)).to(features)[None])
        return motion_of_joints(z_up(rotated), fps, skeleton)


def uniform_skeleton() -> Skeleton:
    """Return a body with the bone lengths of all HumanML3D motions, in SMPL's rest pose, for decoding.

    Hips, spine and collars leave pelvis and chest at HumanML3D's angles; the other bones have the directions of the
    bundled skeleton, which also provides the hands.
    """
    table, default = _table(), Skeleton.default().offsets
    lengths = torch.cat([_target_offsets(default).norm(dim=-1), default[NUM_ROTATIONS:].norm(dim=-1)])
    directions = default.clone()
    for joint, direction in table["rest_directions"].items():
        directions[JOINTS.index(joint)] = torch.tensor(direction)
    offsets = torch.nn.functional.normalize(directions, dim=-1) * lengths[:, None]
    return Skeleton(torch.cat([default[:1], offsets[1:]]))


def y_up(positions: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3"]:
    """Convert from this library's axes (z up, heading 0 faces -y) to HumanML3D's (y up, heading 0 faces z)."""
    x, y, z = positions.unbind(dim=-1)
    return torch.stack([x, z, -y], dim=-1)


def z_up(positions: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3"]:
    """Invert `y_up`."""
    x, y, z = positions.unbind(dim=-1)
    return torch.stack([x, -z, y], dim=-1)


def uniform(joints: Float[Tensor, "frames 22 3"]) -> Float[Tensor, "frames 22 3"]:
    """Retarget joints to HumanML3D's skeleton, with the same bone directions.

    The path of the pelvis is scaled by the length of the right leg, which is measured, as published, in the first frame
    alone. Raises `ValueError` if a bone has no length.
    """
    lengths = _target_offsets(joints).norm(dim=-1)
    leg = [JOINTS.index("right_knee"), JOINTS.index("right_ankle")]
    leg_length = torch.stack([joints[0, joint] - joints[0, PARENTS[joint]] for joint in leg]).norm(dim=-1).sum()
    bones = _directions(joints) * lengths[:, None]
    positions = [joints[:, 0] * (lengths[leg].sum() / leg_length)]
    for joint in range(1, NUM_ROTATIONS):
        positions.append(positions[PARENTS[joint]] + bones[:, joint])
    return torch.stack(positions, dim=1)


def canonical(joints: Float[Tensor, "frames 22 3"]) -> Float[Tensor, "frames 22 3"]:
    """Move and rotate a motion: its lowest joint is at height 0, its first frame above the origin and facing z."""
    floor = joints[..., 1].min()
    start = torch.stack([joints[0, 0, 0], floor, joints[0, 0, 2]])
    hips, shoulders = _across(joints[:1])
    facing = _facing(hips + shoulders)
    return _rotate_y(joints - start, -torch.atan2(facing[:, 0], facing[:, 2]))


def smoothed_heading(joints: Float[Tensor, "frames 22 3"]) -> Float[Tensor, " frames"]:
    """Return the angle about y, in radians within [-pi, pi], that the body faces in each frame; 0 faces z.

    As published: hips enter with the opposite sign of the shoulders (their indices are mixed up), so that the shoulders
    determine the heading; a Gaussian smooths the direction over time; the heading of the first frame is always 0.
    """
    hips, shoulders = _across(joints)
    facing = _smooth(_facing(shoulders - hips))
    heading = torch.atan2(facing[:, 0], facing[:, 2])
    return torch.cat([torch.zeros_like(heading[:1]), heading[1:]])


def joints_to_features(joints: Float[Tensor, "frames 22 3"]) -> Float[Tensor, "_ 263"]:
    """Compute the features of all frames but the last from joint positions with y up, wherever the body stands.

    Raises `ValueError` for fewer than two frames, or if a bone has no length.
    """
    if len(joints) < 2:
        raise ValueError(
            f"HumanML3D features need at least 2 frames, because they contain steps between frames; got {len(joints)}"
        )
    joints = canonical(uniform(joints))
    heading = smoothed_heading(joints)
    steps, under = joints.diff(dim=0), joints[:, :1] * joints.new_tensor([1.0, 0.0, 1.0])
    fields = {
        # at the half turn the quaternions of the published code change sign, and so does this sine
        "yaw_velocity": -torch.asin(torch.sin(heading.diff() / 2))[:, None],
        "root_velocity": _rotate_y(steps[:, :1], -heading[1:])[:, 0, [0, 2]],
        "root_height": joints[:-1, 0, 1:2],
        "positions": _flat(_rotate_y((joints - under)[:-1, 1:], -heading[:-1])),
        "rotations": _flat(
            rearrange(_rotations(joints, heading)[:-1, 1:, :, :2], "... row column -> ... (column row)")
        ),
        "velocities": _flat(_rotate_y(steps, -heading[:-1])),
        "contacts": (steps[:, list(_CONTACTS)].square().sum(dim=-1) < _STILL).to(joints.dtype),
    }
    return torch.cat([fields[field.name] for field in HUMANML3D_LAYOUT.fields], dim=-1)


def features_to_joints(features: Float[Tensor, "*batch frames _"]) -> Float[Tensor, "*batch frames 22 3"]:
    """Compute joint positions with y up from the `positions`; the first frame is above the origin and faces z.

    Raises `ValueError` if the width is not 263.
    """
    heading, pelvis = _root(features)
    local = _per_joint(features, "positions", 3)
    under = pelvis * pelvis.new_tensor([1.0, 0.0, 1.0])
    return torch.cat([pelvis[..., None, :], _rotate_y(local, heading) + under[..., None, :]], dim=-2)


def features_to_posed_joints(features: Float[Tensor, "*batch frames _"]) -> Float[Tensor, "*batch frames 22 3"]:
    """Compute joint positions with y up from the `rotations`, on HumanML3D's skeleton; see `features_to_joints`."""
    heading, pelvis = _root(features)
    # The two columns of the format are the rows of the transpose.
    local = rows_to_matrix(_per_joint(features, "rotations", 6)).mT
    offsets = _target_offsets(features)
    world, positions = [_rotation_y(-heading)], [pelvis]
    for joint in range(1, NUM_ROTATIONS):
        world.append(world[_ROTATION_PARENTS[joint]] @ local[..., joint - 1, :, :])
        positions.append(positions[PARENTS[joint]] + world[joint] @ offsets[joint])
    return torch.stack(positions, dim=-2)


def features_to_local_joints(features: Float[Tensor, "*batch frames _"]) -> Float[Tensor, "*batch frames 22 3"]:
    """Compute joint positions with y up in each frame's own heading frame, for STMC's transition distance.

    As published, turns are set to zero but the path of the pelvis is still summed, so it differs from the path in the
    world.
    """
    straight = features.clone()
    straight[..., HUMANML3D_LAYOUT["yaw_velocity"]] = 0
    return features_to_joints(straight)


def _table() -> dict[str, Any]:
    return json.loads((files("stmc") / "assets" / "humanml3d_skeleton.json").read_text("utf-8"))


def _target_offsets(like: Tensor) -> Float[Tensor, "22 3"]:
    """Return HumanML3D's bones, each along the axis at which its rotation starts (not the bones of a rest pose)."""
    table = _table()["offsets"]
    return torch.tensor([table[joint] for joint in JOINTS[:NUM_ROTATIONS]], dtype=like.dtype, device=like.device)


def _directions(joints: Tensor) -> Float[Tensor, "frames 22 3"]:
    """Return unit vectors along the bones that end in each joint; zero for the pelvis."""
    bones = torch.cat(
        [torch.zeros_like(joints[:, :1]), joints[:, 1:] - joints[:, list(PARENTS[1:NUM_ROTATIONS])]], dim=1
    )
    lengths = bones.norm(dim=-1, keepdim=True)
    if (empty := lengths[:, 1:, 0] == 0).any():
        frame, bone = (int(index) for index in empty.nonzero()[0])
        raise ValueError(
            f"frame {frame}: {JOINTS[bone + 1]} coincides with {JOINTS[PARENTS[bone + 1]]}; bones need a length"
        )
    return torch.cat([bones[:, :1], bones[:, 1:] / lengths[:, 1:]], dim=1)


def _across(joints: Tensor) -> tuple[Tensor, Tensor]:
    """Return the vectors from left to right of the hips and of the shoulders."""
    return joints[:, _RIGHT_HIP] - joints[:, _LEFT_HIP], joints[:, _RIGHT_SHOULDER] - joints[:, _LEFT_SHOULDER]


def _facing(across: Tensor) -> Tensor:
    """Return horizontal vectors, up x the unit vector from left to right; shorter if the body lies on its side."""
    x, _, z = torch.nn.functional.normalize(across, dim=-1).unbind(dim=-1)
    return torch.stack([z, torch.zeros_like(x), -x], dim=-1)


def _smooth(path: Float[Tensor, "frames 3"]) -> Float[Tensor, "frames 3"]:
    """Apply a Gaussian filter over time, truncated at four standard deviations, with replicated ends."""
    window = torch.arange(-4 * _SMOOTHING, 4 * _SMOOTHING + 1, dtype=path.dtype, device=path.device)
    weights = torch.exp(-0.5 * (window / _SMOOTHING).square())
    padded = torch.nn.functional.pad(path.T[None], (len(window) // 2, len(window) // 2), mode="replicate")
    return (padded[0].unfold(-1, len(window), 1) @ (weights / weights.sum())).T


def _rotations(joints: Tensor, heading: Tensor) -> Float[Tensor, "frames 22 3 3"]:
    """Compute the shortest arc from each bone's axis to its direction, relative to the previous bone.

    The first rotation is the identity.
    """
    axes = torch.nn.functional.normalize(_target_offsets(joints), dim=-1).expand_as(joints)
    arcs = shortest_arc(axes[:, 1:], _directions(joints)[:, 1:])
    world = torch.cat([_rotation_y(-heading)[:, None], arcs], dim=1)
    return world[:, list(_ROTATION_PARENTS[:NUM_ROTATIONS])].mT @ world


def _root(features: Tensor) -> tuple[Float[Tensor, "*batch frames"], Float[Tensor, "*batch frames 3"]]:
    """Integrate the velocities to heading angles and pelvis positions."""
    if features.shape[-1] != HUMANML3D_LAYOUT.width:
        raise ValueError(
            f"features have {features.shape[-1]} columns; this representation needs {HUMANML3D_LAYOUT.width}"
        )
    turns = features[..., HUMANML3D_LAYOUT["yaw_velocity"]]
    heading = -2 * torch.nn.functional.pad(turns[..., :-1, 0].cumsum(dim=-1), (1, 0))
    x, z = torch.nn.functional.pad(features[..., :-1, HUMANML3D_LAYOUT["root_velocity"]], (0, 0, 1, 0)).unbind(dim=-1)
    steps = _rotate_y(torch.stack([x, torch.zeros_like(x), z], dim=-1)[..., None, :], heading)[..., 0, :]
    height = features[..., HUMANML3D_LAYOUT["root_height"]]
    path = steps.cumsum(dim=-2)
    return heading, torch.cat([path[..., :1], height, path[..., 2:]], dim=-1)


def _rotation_y(angle: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch 3 3"]:
    cos, sin, zero, one = torch.cos(angle), torch.sin(angle), torch.zeros_like(angle), torch.ones_like(angle)
    rows = [cos, zero, sin, zero, one, zero, -sin, zero, cos]
    return rearrange(torch.stack(rows, dim=-1), "... (row column) -> ... row column", row=3)


def _rotate_y(positions: Float[Tensor, "*batch joints 3"], angle: Float[Tensor, "*frames"]) -> Tensor:
    """Rotate positions [... frames, joints, 3] about y by the angle of each frame."""
    return positions @ _rotation_y(angle).mT


def _per_joint(features: Tensor, name: str, width: int) -> Tensor:
    values = features[..., HUMANML3D_LAYOUT[name]]
    return rearrange(values, "... (joints width) -> ... joints width", width=width)


def _flat(values: Tensor) -> Tensor:
    return rearrange(values, "frames joints width -> frames (joints width)")
