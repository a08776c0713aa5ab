"""Motions from BVH files: our own come back, and other people's are where their joints are."""

import re

import numpy as np
import pytest
import torch
from helpers import bandai_files
from helpers.acclaim_files import Actor, moving
from helpers.motions import walking
from scipy.spatial.transform import Rotation

from stmc.data.sources.cmu import catalogue as cmu
from stmc.formats import bvh_reader, read, write
from stmc.motion.body import JOINTS, NUM_ROTATIONS, PARENTS
from stmc.motion.body_model import Skeleton
from stmc.motion.geometry import axis_angle_to_matrix, global_rotations
from stmc.motion.motion import Motion

MIXAMO = [
    "Hips", "LeftUpLeg", "RightUpLeg", "Spine", "LeftLeg", "RightLeg", "Spine1", "LeftFoot", "RightFoot", "Spine2",
    "LeftToeBase", "RightToeBase", "Neck", "LeftShoulder", "RightShoulder", "Head", "LeftArm", "RightArm",
    "LeftForeArm", "RightForeArm", "LeftHand", "RightHand",
]  # fmt: skip
SMPL_SHORT = [
    "Pelvis", "L_Hip", "R_Hip", "Spine1", "L_Knee", "R_Knee", "Spine2", "L_Ankle", "R_Ankle", "Spine3", "L_Foot",
    "R_Foot", "Neck", "L_Collar", "R_Collar", "Head", "L_Shoulder", "R_Shoulder", "L_Elbow", "R_Elbow", "L_Wrist",
    "R_Wrist",
]  # fmt: skip


def tumbling(skeleton: Skeleton, frames: int = 20) -> Motion:
    """Any pose at all: every joint turns through large angles."""
    generator = torch.Generator().manual_seed(3)
    turns = 2 * torch.randn(frames, NUM_ROTATIONS, 3, generator=generator, dtype=torch.float64)
    pelvis = torch.randn(frames, 3, generator=generator, dtype=torch.float64)
    return Motion.posed(axis_angle_to_matrix(turns), pelvis, 29.97, skeleton)


def written(motion: Motion, folder) -> str:
    write(motion, folder / "ours.bvh")
    return (folder / "ours.bvh").read_text()


def named(text: str, names) -> str:
    """The file with other names, in the order of `JOINTS`."""
    for ours, theirs in zip(JOINTS, names, strict=False):
        text = re.sub(rf"(ROOT|JOINT) {ours}\n", rf"\1 {theirs}\n", text)
    return text


def scaled(text: str, scale: float) -> str:
    """The file with all its lengths in another unit."""

    def offset(found):
        return "OFFSET " + " ".join(f"{scale * float(word):.8f}" for word in found[1].split())

    head, frames = re.sub(r"OFFSET (.*)", offset, text).split("Frame Time: ")
    time, *rows = frames.splitlines()
    moved = [[float(word) for word in row.split()] for row in rows]
    lines = [" ".join(f"{value:.8f}" for value in [*(scale * np.array(row[:3])), *row[3:]]) for row in moved]
    return f"{head}Frame Time: {time}\n" + "\n".join(lines) + "\n"


def read_text(text: str, folder, skeleton: Skeleton | None = None) -> Motion:
    (folder / "theirs.bvh").write_text(text)
    return read(folder / "theirs.bvh", skeleton)


def world(motion: Motion) -> torch.Tensor:
    return global_rotations(motion.rotations.double(), PARENTS[:NUM_ROTATIONS])


def degrees(one: torch.Tensor, other: torch.Tensor) -> float:
    turn = Rotation.from_matrix((one.double().mT @ other.double()).reshape(-1, 3, 3).numpy())
    return float(np.degrees(turn.magnitude()).max())


@pytest.mark.parametrize("size", [0.3, 1.0, 1.4])
def test_what_was_written_comes_back_whoever_s_body_it_is(size, tmp_path):
    motion = tumbling(Skeleton(size * Skeleton.default().offsets.double()))
    written(motion, tmp_path)
    back = read(tmp_path / "ours.bvh")
    assert back.fps == 29.97 and back.joints.dtype == torch.float32
    assert np.radians(degrees(back.rotations, motion.rotations)) < 1e-4
    assert (back.joints - motion.joints).abs().max() < 1e-4
    assert (back.translation - motion.translation).abs().max() < 1e-4


@pytest.mark.parametrize("unit", [1.0, 0.01, 0.001, 0.0254, 0.0254 / 0.45])
def test_the_unit_is_the_one_in_which_the_legs_are_a_person_s(unit, tmp_path):
    motion = walking(seconds=0.5)
    back = read_text(scaled(named(written(motion, tmp_path), MIXAMO), 1 / unit), tmp_path)
    assert (back.joints[:, :NUM_ROTATIONS] - motion.joints[:, :NUM_ROTATIONS]).abs().max() < 1e-4


@pytest.mark.parametrize("scale", [3.0, 1e-3, 0.0])
def test_legs_of_nobody_are_refused(scale, tmp_path):
    text = scaled(named(written(walking(seconds=0.2), tmp_path), MIXAMO), scale)
    with pytest.raises(ValueError, match=r"theirs\.bvh: the legs are .* long"):
        read_text(text, tmp_path)


@pytest.mark.parametrize(
    "names", [[f"mixamorig:{name}" for name in MIXAMO], MIXAMO, SMPL_SHORT, [name.upper() for name in JOINTS]]
)
def test_other_names_of_the_same_joints_are_known(names, tmp_path):
    motion = tumbling(Skeleton.default())
    back = read_text(named(written(motion, tmp_path), names), tmp_path)
    assert (back.joints[:, :NUM_ROTATIONS] - motion.joints[:, :NUM_ROTATIONS]).abs().max() < 1e-4


def test_heads_and_hands_of_others_turn_as_the_file_s_do(tmp_path):
    motion = tumbling(Skeleton.default())
    back = read_text(named(written(motion, tmp_path), MIXAMO), tmp_path)
    seen = [JOINTS.index(joint) for joint in ("pelvis", "spine3", "head", "left_wrist", "right_wrist")]
    assert degrees(world(back)[:, seen], world(motion)[:, seen]) < 0.1
    assert (back.joints - motion.joints).abs().max() < 1e-4


def test_a_file_that_lacks_a_spine_joint_has_it_between_its_neighbours(tmp_path):
    motion = bandai_files.tumbling()
    back = read_text(bandai_files.bvh_text(motion), tmp_path)
    assert (back.joints[:, :NUM_ROTATIONS] - motion.joints[:, :NUM_ROTATIONS]).abs().max() < 2e-3
    there = [place for place, joint in enumerate(JOINTS[:NUM_ROTATIONS]) if joint != "spine2"]
    assert (back.joints[:, there] - motion.joints[:, there]).abs().max() < 1e-4


def test_the_motion_of_cmu_s_conversion_is_that_of_its_joints(tmp_path):
    names = {**cmu.FORMATS[1], "left_foot": "LeftToeBase", "right_foot": "RightToeBase"}
    turns, path = moving(12)
    actor = Actor({**names}, turns, path)
    for side in ("left_", "right_"):
        actor.parents[f"{side}foot"] = f"{side}ankle"
        actor.offsets[f"{side}collar"] = np.zeros(3)  # as in the real files, where chests' bones have no length
        actor.offsets[f"{side}foot"] = Skeleton.default().offsets[JOINTS.index(f"{side}foot")].numpy() / actor.unit
    actor.offsets["neck"] = np.zeros(3)
    back = read_text(actor.bvh(), tmp_path)
    assert back.fps == 120
    up = torch.tensor([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]], dtype=torch.float64)
    assert (back.translation - path @ up.T * (0.0254 / 0.45 / actor.unit)).abs().max() < 1e-4
    trunk = [JOINTS.index(joint) for joint in ("pelvis", "spine1", "spine3", "neck", "head", "left_collar")]
    assert degrees(world(back)[:, trunk], up @ turns[:, trunk]) < 0.1


def test_a_turned_rest_pose_is_not_taken_for_ours(tmp_path):
    """Heads are read off joints where the file's rest pose looks elsewhere than along z."""
    motion = walking(seconds=0.2)
    turn = axis_angle_to_matrix(torch.tensor([0.0, 1.6, 0.0], dtype=torch.float64))
    turned = torch.cat([motion.rotations[:, :1] @ turn.T, turn @ motion.rotations[:, 1:] @ turn.T], dim=1)
    body = Skeleton(Skeleton.default().offsets.double() @ turn.T)
    text = named(written(Motion.posed(turned, motion.translation, 20, body), tmp_path), MIXAMO)
    back = read_text(text, tmp_path)
    seen = [JOINTS.index(joint) for joint in ("pelvis", "spine3", "neck")]
    assert degrees(world(back)[:, seen], world(motion)[:, seen]) < 1
    assert degrees(world(back)[:, JOINTS.index("head")], world(motion)[:, JOINTS.index("head")]) < 30


def test_a_rest_pose_that_lies_and_lacks_bones_is_refused(tmp_path):
    offsets = Skeleton.default().offsets.double().clone()
    offsets[JOINTS.index("neck")] = 0
    lying = axis_angle_to_matrix(torch.tensor([1.6, 0.0, 0.0], dtype=torch.float64))
    motion = walking(seconds=0.2)
    motion = Motion.posed(motion.rotations, motion.translation, 20, Skeleton(offsets @ lying.T))
    with pytest.raises(ValueError, match="not upright, and has bones without length"):
        read_text(named(written(motion, tmp_path), MIXAMO), tmp_path)


@pytest.mark.parametrize(
    ("old", "new", "named_as_missing"),
    [
        ("LeftArm", "Tentacle", "no joints are known for left_shoulder; the file's joints are Hips"),
        ("Toe", "Wheel", "no joints are known for left_foot, right_foot"),
        ("Spine", "Tail", "no joints are known for spine1, spine3"),
    ],
)
def test_joints_that_cannot_be_mapped_are_named(old, new, named_as_missing, tmp_path):
    text = named(written(walking(seconds=0.2), tmp_path), MIXAMO)
    with pytest.raises(ValueError, match=re.escape(named_as_missing)) as error:
        read_text(text.replace(old, new), tmp_path)
    assert "theirs.bvh" in str(error.value) and len(str(error.value)) < 500


def test_one_bone_for_the_whole_back_is_too_few(tmp_path):
    text = named(written(walking(seconds=0.2), tmp_path), MIXAMO)
    with pytest.raises(ValueError, match="no joints are known for spine3"):
        read_text(re.sub(r"JOINT Spine[12]", "JOINT Belly", text), tmp_path)


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (b"", "no MOTION section"),
        (b"\xff\xfe\x00HIERARCHY", "not UTF-8"),
        (
            b"HIERARCHY\n"
            + b"ROOT a\n{\nOFFSET 0 0 0\n" * 900
            + b"}\n" * 900
            + b"MOTION\nFrames: 1\nFrame Time: 0.1\n",
            "joints",
        ),
        (b"ROOT a\n{\n" * 500_000 + b"\nMOTION\n", "more than 4,194,304, the limit"),
        (b" " * 2000, "larger than"),
    ],
    ids=["empty", "binary", "deep", "long", "large"],
)
def test_what_is_no_motion_is_refused_by_name(content, said, tmp_path, monkeypatch):
    if said == "larger than":
        monkeypatch.setattr(bvh_reader, "MOST_BYTES", 1000)
    (tmp_path / "theirs.bvh").write_bytes(content)
    with pytest.raises(ValueError, match=re.escape(said)) as error:
        read(tmp_path / "theirs.bvh")
    assert "theirs.bvh" in str(error.value) and len(str(error.value)) < 500
