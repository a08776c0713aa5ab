"""CMU's motion capture database: its recordings, in all common formats, on SMPL's joints.

Supports the official layout (`SS/SS.asf`, `SS/SS_TT.amc`) and the conversions to BVH for MotionBuilder and for Daz, and
retargets their bones to SMPL's. Independent of actions: see `cmu_clips`. Source: mocap.cs.cmu.edu, free for all uses,
not to be resold. "The data used in this project was obtained from mocap.cs.cmu.edu. The database was created with
funding from NSF EIA-0196217."
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from einops import einsum
from jaxtyping import Float
from scipy.ndimage import median_filter
from torch import Tensor
from torch.nn.functional import normalize

from stmc.data.sources.archives import read_texts
from stmc.data.sources.cmu.asf import parse_amc, parse_asf
from stmc.formats.bvh_parser import Bvh, parse_bvh
from stmc.io.untrusted import UnreadableError, truncate
from stmc.motion.body import JOINTS, NUM_ROTATIONS, PARENTS
from stmc.motion.body_model import Skeleton
from stmc.motion.geometry import axis_angle_to_matrix, global_rotations, matrix_to_axis_angle, shortest_arc
from stmc.motion.inverse_kinematics import joints_to_rotations
from stmc.motion.motion import Motion

_MIDLINE = ("pelvis", "spine1", "spine3", "neck", "head")
_SIDED = ("collar", "shoulder", "elbow", "wrist", "hip", "knee", "ankle")


def _joints(midline: str, left: str, right: str) -> dict[str, str]:
    """Map SMPL's joints to the source's, from names in the order of `_MIDLINE` and `_SIDED`."""
    sides = {"left": left.split(), "right": right.split()}
    pairs = {f"{side}_{joint}": name for side in sides for joint, name in zip(_SIDED, sides[side], strict=True)}
    return dict(zip(_MIDLINE, midline.split(), strict=True)) | pairs


FORMATS: tuple[Mapping[str, str], ...] = (
    _joints(
        "root upperback thorax lowerneck head",
        "lclavicle lhumerus lradius lhand lfemur ltibia lfoot",
        "rclavicle rhumerus rradius rhand rfemur rtibia rfoot",
    ),
    _joints(
        "Hips Spine Spine1 Neck Head",
        "LeftShoulder LeftArm LeftForeArm LeftFingerBase LeftUpLeg LeftLeg LeftFoot",
        "RightShoulder RightArm RightForeArm RightFingerBase RightUpLeg RightLeg RightFoot",
    ),
    _joints(
        "Hips Chest Chest2 lowerneck Head",
        "LeftCollar LeftShoulder LeftElbow lhand LeftHip LeftKnee LeftAnkle",
        "RightCollar RightShoulder RightElbow rhand RightHip RightKnee RightAnkle",
    ),
    _joints(
        "hip abdomen chest neck head",
        "lCollar lShldr lForeArm lHand lThigh lShin lFoot",
        "rCollar rShldr rForeArm rHand rThigh rShin rFoot",
    ),
)
"""SMPL's joint → the source's, for the native format, MotionBuilder's in two spellings, and Daz's. SMPL's spine2 moves
with spine1, its feet with the ankles. The hand begins at the end of the forearm's second half (`lwrist`, `LeftHand`).
"""

DAZ = FORMATS[3]

DAMAGED = 9
"""Number of frames after the T-pose that Daz's conversion bent towards the first real frame."""
RATE, SLOW_RATE, SLOW = 120, 60, frozenset({"60", "61", "salsa"})
"""Frames per second, which AMC does not contain; the BVH files of the `SLOW` subjects' salsa contain a wrong value."""
LENT = {"13": "14"}
ANYBODY = "16"
"""Subject whose skeleton replaces a missing one."""
MOST_SKELETONS, LONGEST_SKELETON = 1000, 2**20
"""Maximum number of skeletons, and of characters of each; the database has 112 of some 10,000. Longer files are not
skeletons."""

CONTACT = 0.03
"""The floor is at this quantile of the height of the lower toe; deeper toes are noise."""
SPIKE, SPIKE_FRAMES = 90.0, 15
"""A rotation of more than this many degrees in one frame, and back within this many frames, is an artefact."""
LONGEST_LEAP = 0.6
"""Maximum distance in metres that a pelvis moves within a twentieth of a second; beyond it a recording is damaged."""
LIMBS = tuple(f"{side}_{joint}" for side in ("left", "right") for joint in ("shoulder", "elbow", "hip", "knee"))


class CmuError(ValueError):
    """A recording that cannot be used; the message gives the reason."""


@dataclass(frozen=True)
class Source:
    """The file of a recording: its `name`, such as "14_06", its text, and the text of its separate skeleton, if any."""

    name: str
    text: str
    skeleton: str | None = None


def read_sources(source: Path) -> Iterator[Source | tuple[str, str]]:
    """Yield every recording below a folder or in an archive, or the name and the reason of an unreadable one.

    One is in memory at a time: the whole database has several gigabytes. Raises as `read_texts`, and `ValueError` if
    there are no recordings or more than `MOST_SKELETONS`.
    """
    source, seen = Path(source), set()
    skeletons = _read_skeletons(source)
    for path, text in read_texts(source, (".amc", ".bvh")):
        name = path.stem
        if isinstance(text, UnreadableError):
            yield name, str(text)
        elif name in seen:
            yield f"{name} ({truncate(str(path))})", "a second recording of this name"
        elif path.suffix == ".bvh":
            yield Source(name, text)
        elif subject := _skeleton_of(name, skeletons):
            yield Source(name, text, skeletons[subject])
        else:
            yield name, "no skeleton: neither its subject's .asf nor a known substitute is there"
        seen.add(name)
    if not seen:
        raise ValueError(f"{source} contains no .amc or .bvh file")


def _read_skeletons(source: Path) -> dict[str, str]:
    """Read the texts of all readable skeletons, by subject."""
    skeletons: dict[str, str] = {}
    for path, text in read_texts(source, (".asf",)):
        if isinstance(text, str) and len(text) <= LONGEST_SKELETON:
            skeletons[path.stem] = text
        if len(skeletons) > MOST_SKELETONS:
            raise ValueError(f"{source} holds more than {MOST_SKELETONS:,} .asf files, the limit")
    return skeletons


def _skeleton_of(name: str, skeletons: Mapping[str, str]) -> str | None:
    subject = name.partition("_")[0]
    choices = (subject, LENT.get(subject, ANYBODY), ANYBODY)
    return next((choice for choice in choices if choice in skeletons), None)


def read(source: Source, skeleton: Skeleton, fps: float | int) -> Motion:
    """Read a recording at `fps`. Raises `CmuError`, `BvhError` or `AcclaimError` if it cannot be used.

    Args:
        source: File of the recording.
        skeleton: Skeleton to retarget to.
        fps: Frame rate of the motion.
    """
    rate = SLOW_RATE if source.name.partition("_")[0] in SLOW else RATE
    if source.skeleton is None:
        return retarget(replace(parse_bvh(source.text), fps=rate), skeleton, fps)
    return retarget(parse_amc(source.text, parse_asf(source.skeleton), rate), skeleton, fps)


def retarget(recording: Bvh, skeleton: Skeleton, fps: float | int) -> Motion:
    """Retarget a recording to `skeleton` at `fps`: metres, z up, feet on the floor.

    Trunk, collars, hands and feet rotate as the source's bones do from their rest pose, which has flat feet and arms
    straight to the sides, like SMPL's. Limbs also compensate for the spread of the source's rest pose; their twists
    then follow from the joints, as for any motion of joints. The path is scaled by the lengths of the legs.

    Args:
        recording: The recording.
        skeleton: Skeleton to retarget to.
        fps: Frame rate of the motion.
    """
    names = _format(recording)
    recording = _without_t_pose(recording, names)
    rotations, positions = recording.world()
    index = {joint: recording.names.index(name) for joint, name in names.items()}
    rest = _rest(recording, index)
    up = torch.tensor([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]], dtype=torch.float64)  # y up → z up
    world = _world(up @ rotations, index, rest, skeleton)
    source_leg = sum(float((rest[f"left_{lower}"] - rest[f"left_{upper}"]).norm()) for upper, lower in _LEG)
    if not source_leg > 0:
        raise CmuError("the skeleton's legs have no length")
    target_leg = sum(float(skeleton.offsets[JOINTS.index(f"left_{lower}")].norm()) for _, lower in _LEG)
    hips = (positions[:, index["left_hip"]] + positions[:, index["right_hip"]]) / 2
    steady = torch.from_numpy(median_filter(hips.numpy(), (5, 1), mode="nearest"))
    above = skeleton.offsets[[JOINTS.index("left_hip"), JOINTS.index("right_hip")]].double().mean(dim=0)
    pelvis = steady @ up.T * (target_leg / source_leg) - einsum(world[:, 0], above, "frames i j, j -> frames i")
    raw = Motion.posed(_local(world), pelvis, recording.fps, skeleton).resampled(fps)
    return _place_on_floor(_repair(raw, skeleton), skeleton)


_LEG = (("hip", "knee"), ("knee", "ankle"))
_NEXT = {"hip": "knee", "knee": "ankle", "shoulder": "elbow", "elbow": "wrist"}
"""Ends of the bones of a limb."""


def _format(recording: Bvh) -> Mapping[str, str]:
    for names in FORMATS:
        if set(names.values()) <= set(recording.names):
            return names
    joints = truncate(", ".join(recording.names[:6]))
    raise CmuError(f"unknown skeleton with joints {joints}, …; supported are the native one, MotionBuilder's and Daz's")


def _without_t_pose(recording: Bvh, names: Mapping[str, str]) -> Bvh:
    """Remove the first frame of a conversion, in which neither elbows nor knees are bent at all, as in no real pose."""
    hinges = [recording.names.index(names[joint]) for joint in LIMBS if joint.endswith(("elbow", "knee"))]
    bent = (recording.rotations[0, hinges] - torch.eye(3, dtype=torch.float64)).abs().max() > 1e-6
    first = 0 if bent else 1 + DAMAGED * (names is DAZ)
    if len(recording.rotations) <= first + 1:
        raise CmuError(f"{len(recording.rotations)} frames are too few")
    return replace(recording, positions=recording.positions[first:], rotations=recording.rotations[first:])


def _rest(recording: Bvh, index: Mapping[str, int]) -> dict[str, Tensor]:
    """Return the position of each joint while no bone is rotated, in the source's axes and unit."""
    positions: list[Tensor] = []
    for joint, parent in enumerate(recording.parents):
        offset = recording.positions[0, joint]
        positions.append(offset if parent < 0 else positions[parent] + offset)
    return {joint: positions[row] for joint, row in index.items()}


def _world(
    rotations: Float[Tensor, "frames _ 3 3"], index: Mapping[str, int], rest: Mapping[str, Tensor], skeleton: Skeleton
) -> Float[Tensor, "frames 22 3 3"]:
    """Compute world rotations of SMPL's joints."""
    target_rest, columns = skeleton.rest.double(), []
    for joint in JOINTS[:NUM_ROTATIONS]:
        source = {"spine2": "spine1", "left_foot": "left_ankle", "right_foot": "right_ankle"}.get(joint, joint)
        rotation = rotations[:, index[source]]
        side, _, kind = joint.partition("_")
        if kind in _NEXT:
            lower = f"{side}_{_NEXT[kind]}"
            target = normalize(target_rest[JOINTS.index(lower)] - target_rest[JOINTS.index(joint)], dim=0)
            rotation = rotation @ shortest_arc(target, normalize(rest[lower] - rest[joint], dim=0))
        columns.append(rotation)
    return torch.stack(columns, dim=1)


def _local(world: Float[Tensor, "frames 22 3 3"]) -> Float[Tensor, "frames 22 3 3"]:
    return torch.cat([world[:, :1], world[:, list(PARENTS[1:NUM_ROTATIONS])].mT @ world[:, 1:]], dim=1)


def _repair(raw: Motion, skeleton: Skeleton) -> Motion:
    """Remove spikes, and distribute the twist of limbs as `joints_to_rotations` does."""
    world = remove_spikes(global_rotations(raw.rotations, PARENTS[:NUM_ROTATIONS]))
    repaired = Motion.posed(_local(world), raw.translation, raw.fps, skeleton)
    hinged = global_rotations(joints_to_rotations(repaired.joints, skeleton), PARENTS[:NUM_ROTATIONS])
    limbs = [JOINTS.index(limb) for limb in LIMBS]
    world = world.index_copy(1, torch.tensor(limbs), hinged[:, limbs])
    return Motion.posed(_local(world), raw.translation, raw.fps, skeleton)


def remove_spikes(world: Float[Tensor, "frames joints 3 3"]) -> Float[Tensor, "frames joints 3 3"]:
    """Interpolate the rotations of bones that flip away and back (see `SPIKE`)."""
    world = world.clone()
    for joint in range(world.shape[1]):
        jumps = (_degrees(world[:-1, joint], world[1:, joint]) > SPIKE).nonzero()[:, 0].tolist()
        while jumps:
            before = jumps.pop(0)
            for after in (jump + 1 for jump in jumps if jump - before <= SPIKE_FRAMES):
                if _degrees(world[before, joint], world[after, joint]) < SPIKE:
                    arc = matrix_to_axis_angle(world[before, joint].mT @ world[after, joint])
                    weight = torch.linspace(0, 1, after - before + 1, dtype=world.dtype)
                    world[before : after + 1, joint] = world[before, joint] @ axis_angle_to_matrix(
                        arc * weight[:, None]
                    )
                    jumps = [jump for jump in jumps if jump >= after]
                    break
    return world


def _degrees(start: Tensor, end: Tensor) -> Tensor:
    trace = (start * end).sum(dim=(-2, -1))
    return torch.rad2deg(torch.acos(((trace - 1) / 2).clamp(-1, 1)))


def _place_on_floor(motion: Motion, skeleton: Skeleton) -> Motion:
    leaps = motion.translation.diff(dim=0).norm(dim=-1)
    if len(leaps) and leaps.max() * motion.fps / 20 > LONGEST_LEAP:
        raise CmuError(f"the pelvis leaps {leaps.max():.2f} m from one frame to the next, at {motion.fps:g} fps")
    toes = motion.joints[:, [JOINTS.index("left_foot"), JOINTS.index("right_foot")], 2].amin(dim=1)
    floor = torch.stack([toes.new_zeros(()), toes.new_zeros(()), toes.quantile(CONTACT)])
    return Motion.posed(motion.rotations, motion.translation - floor, motion.fps, skeleton)
