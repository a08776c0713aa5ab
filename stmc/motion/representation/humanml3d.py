"""The 263 numbers per frame of HumanML3D (Guo et al. 2022): motions to features and back.

Knows the formulas, on 22 joints in HumanML3D's own axes (y up, at heading zero facing z; `y_up` and `z_up` are the only
way there and back). Where each number stands is `layout.HUMANML3D_LAYOUT`'s to say. Not normalised.

The format is what checkpoints and evaluators were trained on, so its oddities are kept, each named where it is: hips
that enter the smoothed heading with the wrong sign, a first frame that faces ahead whatever it does, turns through the
half turn whose sign is lost.
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
"""A foot joint touches the floor where its squared step to the next frame is less (m², 4.5 cm; at 20 fps)."""
_CONTACTS = tuple(JOINTS.index(name) for name in ("left_ankle", "left_foot", "right_ankle", "right_foot"))
_LEFT_HIP, _RIGHT_HIP, _LEFT_SHOULDER, _RIGHT_SHOULDER = (
    JOINTS.index(name) for name in ("left_hip", "right_hip", "left_shoulder", "right_shoulder")
)
_TURNS_WITH = tuple(0 if "collar" in name else parent for name, parent in zip(JOINTS, PARENTS, strict=True))
"""The joint that each rotation is relative to: arms do not inherit the spine's."""


class HumanML3DRepresentation(Representation):
    """Motion ⇄ features, the same wherever the body stands and wherever it looks. One row less than frames.

    The motion is retargeted to one skeleton, put on the floor and turned so that it starts facing ahead. Then, per
    frame, in metres and *per frame* (not per second), y up, in the smoothed heading frame:

    - `yaw_velocity`: *half* the turn of the heading to the next frame, in radians, to the right positive;
    - `root_velocity`: step of the pelvis to the next frame along x and z, in the next frame's heading frame;
    - `root_height`: of the pelvis above the lowest joint of the whole motion;
    - `positions`: of joints 1 to 21, relative to the point of the floor under the pelvis;
    - `rotations`: of the bones that end in joints 1 to 21, each the first two columns of its matrix;
    - `velocities`: steps of joints 0 to 21 to the next frame;
    - `contacts`: 1 where ankles and feet rest.
    """

    layout: ClassVar[Layout] = HUMANML3D_LAYOUT

    @property
    def skeleton(self) -> Skeleton:
        """That of all HumanML3D motions."""
        return uniform_skeleton()

    def encode(self, motion: Motion) -> Float[Tensor, "frames features"]:
        """Features of all frames but the last, in the motion's dtype. Rotations and hands are not looked at.

        Raises `ValueError` for a motion of one frame, and where a bone has no length.
        """
        return joints_to_features(y_up(motion.joints[:, :NUM_ROTATIONS]))

    def decode(
        self,
        features: Float[Tensor, "frames features"],
        fps: float | int,
        skeleton: Skeleton | None = None,
        heading: float | int = 0.0,
    ) -> Motion:
        """The motion that starts above the origin with `heading` radians; as many frames as rows.

        Joints are the features' own positions, and rotations follow from them (`motion_of_joints`); with a `skeleton`
        they are posed again, so that bones keep its lengths. The heading is that of hips and shoulders together, the
        pelvis alone may look a little aside. Raises `ValueError` for another width than 263, and for no rows.
        """
        turned = _turned(features_to_joints(features), torch.as_tensor(float(heading)).to(features)[None])
        return motion_of_joints(z_up(turned), fps, skeleton)


def uniform_skeleton() -> Skeleton:
    """A body with the bone lengths of all HumanML3D motions, in SMPL's rest pose: what their features are decoded on.

    Hips, spine and collars leave pelvis and chest at HumanML3D's angles; the other bones point as the bundled
    skeleton's, which also gives the hands.
    """
    table, default = _table(), Skeleton.default().offsets
    lengths = torch.cat([_target_offsets(default).norm(dim=-1), default[NUM_ROTATIONS:].norm(dim=-1)])
    directions = default.clone()
    for joint, direction in table["rest_directions"].items():
        directions[JOINTS.index(joint)] = torch.tensor(direction)
    offsets = torch.nn.functional.normalize(directions, dim=-1) * lengths[:, None]
    return Skeleton(torch.cat([default[:1], offsets[1:]]))


def y_up(positions: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3"]:
    """From our axes (z up, heading 0 faces -y) to HumanML3D's (y up, heading 0 faces z)."""
    x, y, z = positions.unbind(dim=-1)
    return torch.stack([x, z, -y], dim=-1)


def z_up(positions: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3"]:
    """The inverse of `y_up`."""
    x, y, z = positions.unbind(dim=-1)
    return torch.stack([x, -z, y], dim=-1)


def uniform(joints: Float[Tensor, "frames 22 3"]) -> Float[Tensor, "frames 22 3"]:
    """The same directions of bones on HumanML3D's skeleton; the pelvis' path is scaled by the length of the right leg.

    As published, the leg is measured in the first frame alone. Raises `ValueError` where a bone has no length.
    """
    lengths = _target_offsets(joints).norm(dim=-1)
    leg = [JOINTS.index("right_knee"), JOINTS.index("right_ankle")]
    own = torch.stack([joints[0, joint] - joints[0, PARENTS[joint]] for joint in leg]).norm(dim=-1).sum()
    bones = _directions(joints) * lengths[:, None]
    places = [joints[:, 0] * (lengths[leg].sum() / own)]
    for joint in range(1, NUM_ROTATIONS):
        places.append(places[PARENTS[joint]] + bones[:, joint])
    return torch.stack(places, dim=1)


def canonical(joints: Float[Tensor, "frames 22 3"]) -> Float[Tensor, "frames 22 3"]:
    """The motion moved and turned: its lowest joint at height 0, its first frame above the origin and facing z."""
    floor = joints[..., 1].min()
    start = torch.stack([joints[0, 0, 0], floor, joints[0, 0, 2]])
    hips, shoulders = _across(joints[:1])
    facing = _facing(hips + shoulders)
    return _turned(joints - start, -torch.atan2(facing[:, 0], facing[:, 2]))


def smoothed_heading(joints: Float[Tensor, "frames 22 3"]) -> Float[Tensor, " frames"]:
    """The angle about y, in radians within [-pi, pi], that the body faces in each frame; 0 faces z.

    As published: hips enter with the opposite sign of the shoulders (their indexes are mixed up), so it is shoulders
    that tell; the direction is smoothed by a Gaussian over time; the first frame's is 0 whatever the body does.
    """
    hips, shoulders = _across(joints)
    facing = _smoothed(_facing(shoulders - hips))
    heading = torch.atan2(facing[:, 0], facing[:, 2])
    return torch.cat([torch.zeros_like(heading[:1]), heading[1:]])


def joints_to_features(joints: Float[Tensor, "frames 22 3"]) -> Float[Tensor, "_ 263"]:
    """Features of all frames but the last, from joint positions with y up, wherever the body stands.

    Raises `ValueError` for less than two frames, and where a bone has no length.
    """
    if len(joints) < 2:
        raise ValueError(
            f"HumanML3D features are made of steps between frames: need 2 frames or more, not {len(joints)}"
        )
    joints = canonical(uniform(joints))
    heading = smoothed_heading(joints)
    steps, under = joints.diff(dim=0), joints[:, :1] * joints.new_tensor([1.0, 0.0, 1.0])
    fields = {
        # through the half turn the quaternions of the published code change sign, and this sine with them
        "yaw_velocity": -torch.asin(torch.sin(heading.diff() / 2))[:, None],
        "root_velocity": _turned(steps[:, :1], -heading[1:])[:, 0, [0, 2]],
        "root_height": joints[:-1, 0, 1:2],
        "positions": _flat(_turned((joints - under)[:-1, 1:], -heading[:-1])),
        "rotations": _flat(
            rearrange(_rotations(joints, heading)[:-1, 1:, :, :2], "... row column -> ... (column row)")
        ),
        "velocities": _flat(_turned(steps, -heading[:-1])),
        "contacts": (steps[:, list(_CONTACTS)].square().sum(dim=-1) < _STILL).to(joints.dtype),
    }
    return torch.cat([fields[field.name] for field in HUMANML3D_LAYOUT.fields], dim=-1)


def features_to_joints(features: Float[Tensor, "*batch frames _"]) -> Float[Tensor, "*batch frames 22 3"]:
    """Joint positions with y up, from the `positions`: the first frame stands above the origin and faces z.

    Raises `ValueError` for another width than 263.
    """
    heading, pelvis = _root(features)
    local = _per_joint(features, "positions", 3)
    under = pelvis * pelvis.new_tensor([1.0, 0.0, 1.0])
    return torch.cat([pelvis[..., None, :], _turned(local, heading) + under[..., None, :]], dim=-2)


def features_to_posed_joints(features: Float[Tensor, "*batch frames _"]) -> Float[Tensor, "*batch frames 22 3"]:
    """Joint positions with y up, from the `rotations`, on HumanML3D's skeleton. Otherwise as `features_to_joints`."""
    heading, pelvis = _root(features)
    local = rows_to_matrix(_per_joint(features, "rotations", 6)).mT  # the format's two columns are the transpose's rows
    offsets = _target_offsets(features)
    turned, places = [_rotation_y(-heading)], [pelvis]
    for joint in range(1, NUM_ROTATIONS):
        turned.append(turned[_TURNS_WITH[joint]] @ local[..., joint - 1, :, :])
        places.append(places[PARENTS[joint]] + turned[joint] @ offsets[joint])
    return torch.stack(places, dim=-2)


def features_to_local_joints(features: Float[Tensor, "*batch frames _"]) -> Float[Tensor, "*batch frames 22 3"]:
    """Joint positions with y up in each frame's own heading frame, which STMC's transition distance compares.

    As published: turns are taken for zero, yet the path of the pelvis is summed up, so it is not the one in the world.
    """
    straight = features.clone()
    straight[..., HUMANML3D_LAYOUT["yaw_velocity"]] = 0
    return features_to_joints(straight)


def _table() -> dict[str, Any]:
    return json.loads((files("stmc") / "assets" / "humanml3d_skeleton.json").read_text("utf-8"))


def _target_offsets(like: Tensor) -> Float[Tensor, "22 3"]:
    """HumanML3D's bones, each along the axis that its rotation starts from (not the bones of a rest pose)."""
    table = _table()["offsets"]
    return torch.tensor([table[joint] for joint in JOINTS[:NUM_ROTATIONS]], dtype=like.dtype, device=like.device)


def _directions(joints: Tensor) -> Float[Tensor, "frames 22 3"]:
    """Unit vectors along the bones that end in each joint; zero for the pelvis."""
    bones = torch.cat(
        [torch.zeros_like(joints[:, :1]), joints[:, 1:] - joints[:, list(PARENTS[1:NUM_ROTATIONS])]], dim=1
    )
    lengths = bones.norm(dim=-1, keepdim=True)
    if (empty := lengths[:, 1:, 0] == 0).any():
        frame, bone = (int(index) for index in empty.nonzero()[0])
        raise ValueError(f"frame {frame}: {JOINTS[bone + 1]} lies on {JOINTS[PARENTS[bone + 1]]}; bones need a length")
    return torch.cat([bones[:, :1], bones[:, 1:] / lengths[:, 1:]], dim=1)


def _across(joints: Tensor) -> tuple[Tensor, Tensor]:
    """From left to right, of the hips and of the shoulders."""
    return joints[:, _RIGHT_HIP] - joints[:, _LEFT_HIP], joints[:, _RIGHT_SHOULDER] - joints[:, _LEFT_SHOULDER]


def _facing(across: Tensor) -> Tensor:
    """Horizontal vectors, shorter where the body lies on its side: up x the unit vector from left to right."""
    x, _, z = torch.nn.functional.normalize(across, dim=-1).unbind(dim=-1)
    return torch.stack([z, torch.zeros_like(x), -x], dim=-1)


def _smoothed(path: Float[Tensor, "frames 3"]) -> Float[Tensor, "frames 3"]:
    """Gaussian filter over time, cut off at four standard deviations; the ends last for ever."""
    reach = torch.arange(-4 * _SMOOTHING, 4 * _SMOOTHING + 1, dtype=path.dtype, device=path.device)
    weights = torch.exp(-0.5 * (reach / _SMOOTHING).square())
    padded = torch.nn.functional.pad(path.T[None], (len(reach) // 2, len(reach) // 2), mode="replicate")
    return (padded[0].unfold(-1, len(reach), 1) @ (weights / weights.sum())).T


def _rotations(joints: Tensor, heading: Tensor) -> Float[Tensor, "frames 22 3 3"]:
    """Of each bone: the shortest arc from its axis to its direction, relative to the bone before; the first is none."""
    axes = torch.nn.functional.normalize(_target_offsets(joints), dim=-1).expand_as(joints)
    arcs = shortest_arc(axes[:, 1:], _directions(joints)[:, 1:])
    turned = torch.cat([_rotation_y(-heading)[:, None], arcs], dim=1)
    return turned[:, list(_TURNS_WITH[:NUM_ROTATIONS])].mT @ turned


def _root(features: Tensor) -> tuple[Float[Tensor, "*batch frames"], Float[Tensor, "*batch frames 3"]]:
    """Heading angles and pelvis positions: what the velocities lead to."""
    if features.shape[-1] != HUMANML3D_LAYOUT.width:
        raise ValueError(f"features must have {HUMANML3D_LAYOUT.width} columns, not {features.shape[-1]}")
    turns = features[..., HUMANML3D_LAYOUT["yaw_velocity"]]
    heading = -2 * torch.nn.functional.pad(turns[..., :-1, 0].cumsum(dim=-1), (1, 0))
    x, z = torch.nn.functional.pad(features[..., :-1, HUMANML3D_LAYOUT["root_velocity"]], (0, 0, 1, 0)).unbind(dim=-1)
    steps = _turned(torch.stack([x, torch.zeros_like(x), z], dim=-1)[..., None, :], heading)[..., 0, :]
    height = features[..., HUMANML3D_LAYOUT["root_height"]]
    path = steps.cumsum(dim=-2)
    return heading, torch.cat([path[..., :1], height, path[..., 2:]], dim=-1)


def _rotation_y(angle: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch 3 3"]:
    cos, sin, zero, one = torch.cos(angle), torch.sin(angle), torch.zeros_like(angle), torch.ones_like(angle)
    rows = [cos, zero, sin, zero, one, zero, -sin, zero, cos]
    return rearrange(torch.stack(rows, dim=-1), "... (row column) -> ... row column", row=3)


def _turned(positions: Float[Tensor, "*batch joints 3"], angle: Float[Tensor, "*frames"]) -> Tensor:
    """Positions [... frames, joints, 3] turned about y by the angle of each frame."""
    return positions @ _rotation_y(angle).mT


def _per_joint(features: Tensor, name: str, width: int) -> Tensor:
    values = features[..., HUMANML3D_LAYOUT[name]]
    return rearrange(values, "... (joints width) -> ... joints width", width=width)


def _flat(values: Tensor) -> Tensor:
    return rearrange(values, "frames joints width -> frames (joints width)")
