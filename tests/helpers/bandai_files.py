"""Clips as the Bandai data set's files have them, written from motions: the way back from what `bandai` reads."""

import warnings

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from stmc.data.sources.bandai.recordings import SOURCE_JOINTS, rest_rotations
from stmc.motion.body import JOINTS, NUM_ROTATIONS, PARENTS
from stmc.motion.body_model import Skeleton
from stmc.motion.geometry import axis_angle_to_matrix, global_rotations, rotation_z
from stmc.motion.motion import Motion

TREE = {"joint_Root": None, "Hips": "joint_Root", "Spine": "Hips", "Chest": "Spine", "Neck": "Chest", "Head": "Neck"}
for _limb in (("Chest", "Shoulder", "UpperArm", "LowerArm", "Hand"), ("Hips", "UpperLeg", "LowerLeg", "Foot", "Toes")):
    for _side in ("L", "R"):
        _chain = [_limb[0], *(f"{name}_{_side}" for name in _limb[1:])]
        TREE |= dict(zip(_chain[1:], _chain, strict=False))
"""The dataset's joints and their parents, in its files' order: the tree's, depth first."""

CHANNELS = "CHANNELS 6 Xposition Yposition Zposition Zrotation Xrotation Yrotation"
UP = torch.tensor([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]], dtype=torch.float64)
"""From the files' axes (y up) to ours (z up)."""


def skeleton() -> Skeleton:
    """The bundled proportions in float64."""
    return Skeleton(Skeleton.default().offsets.double())


def about(axis: str, angle: torch.Tensor) -> torch.Tensor:
    """Axis-angle vectors [frames, 3] about one of SMPL's axes (x left, y up, z forward)."""
    return angle[:, None] * torch.eye(3, dtype=torch.float64)["xyz".index(axis)]


def posed(axis_angle: dict[str, torch.Tensor], pelvis: torch.Tensor, heading: torch.Tensor | None = None) -> Motion:
    """A motion at 30 fps, upright and in a T-pose but for these joints' rotations [frames, 3]; the root's own comes
    from `heading`."""
    turns = torch.zeros(len(pelvis), NUM_ROTATIONS, 3, dtype=torch.float64)
    for name, values in axis_angle.items():
        turns[:, JOINTS.index(name)] = values
    rotations = axis_angle_to_matrix(turns)
    heading = torch.zeros(len(pelvis), dtype=torch.float64) if heading is None else heading
    rotations[:, 0] = rotation_z(heading) @ UP @ rotations[:, 0]
    return Motion.posed(rotations, pelvis, 30.0, skeleton())


def tumbling(frames: int = 20, seed: int = 0) -> Motion:
    """Any pose at all, anywhere; only spine2, which the dataset does not have, is at rest."""
    generator = torch.Generator().manual_seed(seed)
    axis_angle = 2 * torch.randn(frames, NUM_ROTATIONS, 3, generator=generator, dtype=torch.float64)
    axis_angle[:, JOINTS.index("spine2")] = 0
    pelvis = torch.randn(frames, 3, generator=generator, dtype=torch.float64)
    return Motion.posed(axis_angle_to_matrix(axis_angle), pelvis, 30.0, skeleton())


def standing(frames: int = 20, height: float = 1.0) -> Motion:
    """A T-pose that stays where it is."""
    return posed({}, torch.tensor([[0.3, -0.2, height]], dtype=torch.float64).repeat(frames, 1))


def bvh_text(motion: Motion) -> str:
    """The clip that moves as `motion` does: centimetres, y up, every joint with positions of its own."""
    source = {name: JOINTS.index(joint) for joint, name in SOURCE_JOINTS.items()}
    world = global_rotations(motion.rotations, PARENTS)
    frames = motion.frames
    rotations = {"joint_Root": torch.eye(3, dtype=torch.float64).expand(frames, 3, 3)}
    positions = {"joint_Root": torch.zeros(frames, 3, dtype=torch.float64)}
    columns = []
    for name, parent in TREE.items():
        if parent is not None:
            rotations[name] = UP.T @ world[:, source[name]] @ rest_rotations([name])[0]
            positions[name] = 100 * motion.joints[:, source[name]] @ UP
        above = rotations[parent].mT if parent else torch.eye(3, dtype=torch.float64)
        place = positions[name] - (positions[parent] if parent else 0)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # a T-pose's axes lock gimbals: one of many triples of angles is as good
            angles = Rotation.from_matrix((above @ rotations[name]).numpy()).as_euler("ZXY", degrees=True)
        columns.append(np.concatenate([(above @ place[..., None])[..., 0].numpy(), angles], axis=1))
    rows = "\n".join(" ".join(f"{value:.6f}" for value in row) for row in np.concatenate(columns, axis=1))
    return f"HIERARCHY\n{_hierarchy('joint_Root', 'ROOT')}MOTION\nFrames: {frames}\nFrame Time: 0.0333333\n{rows}\n"


def _hierarchy(name: str, kind: str) -> str:
    below = [_hierarchy(child, "JOINT") for child, parent in TREE.items() if parent == name]
    end = "End Site\n{\nOFFSET 0 0 0\n}\n"
    return f"{kind} {name}\n{{\nOFFSET 0 0 0\n{CHANNELS}\n{''.join(below) or end}}}\n"
