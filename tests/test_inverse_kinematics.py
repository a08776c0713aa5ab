"""Rotations from joints: they reproduce the joints, bend where bodies bend, and do not jump."""

import itertools

import pytest
import torch
from conftest import data_file
from helpers.bandai_files import about, posed, skeleton
from helpers.motions import walk, walking
from hypothesis import given, settings
from hypothesis import strategies as st
from torch.testing import assert_close

import stmc
from stmc.data.sources.bandai import recordings as bandai
from stmc.formats.bvh_parser import parse_bvh
from stmc.motion.body import JOINTS, PARENTS
from stmc.motion.body_model import Skeleton
from stmc.motion.geometry import axis_angle_to_matrix, global_rotations, matrix_to_axis_angle
from stmc.motion.inverse_kinematics import joints_to_rotations, motion_of_joints
from stmc.motion.motion import Motion
from stmc.motion.representation import HumanML3DRepresentation
from stmc.motion.representation.humanml3d import uniform_skeleton

HINGES = ("left_knee", "right_knee", "left_elbow", "right_elbow")


def degrees(first, second):
    return torch.rad2deg(matrix_to_axis_angle(first.mT @ second).norm(dim=-1))


def world(motion):
    return global_rotations(motion.rotations, PARENTS)


def errors(motion, rotations, joint):
    """Degrees between the orientations of one joint in the world."""
    index = JOINTS.index(joint)
    return degrees(world(motion)[:, index], global_rotations(rotations, PARENTS)[:, index])


def steps(rotations):
    """Degrees that each joint turns from frame to frame, relative to its parent."""
    return degrees(rotations[:-1], rotations[1:])


def poses(frames, seed, size):
    """Unrelated poses of the bundled skeleton, in any orientation."""
    generator = torch.Generator().manual_seed(seed)
    turns = size * torch.randn(frames, 22, 3, generator=generator, dtype=torch.float64)
    turns[:, 0] *= 3 / size
    places = torch.randn(frames, 3, generator=generator, dtype=torch.float64)
    return Motion.posed(axis_angle_to_matrix(turns), places, 20.0, skeleton())


# Positions ----------------------------------------------------------------------------------------------------------


@given(seed=st.integers(0, 1000), size=st.floats(0.1, 1.5), joints=st.sampled_from([22, 24]), frames=st.integers(1, 6))
@settings(max_examples=30)
def test_any_pose_of_the_same_proportions_is_reproduced(seed, size, joints, frames):
    motion = poses(frames, seed, size)
    rotations = joints_to_rotations(motion.joints[:, :joints], skeleton())
    assert_close(
        skeleton().pose(rotations, motion.translation)[:, :joints], motion.joints[:, :joints], atol=1e-6, rtol=0
    )


def test_in_single_precision_too():
    motion = poses(50, 0, 0.7).to(dtype=torch.float32)
    back = motion_of_joints(motion.joints, 20.0, Skeleton.default())
    assert_close(back.joints, motion.joints, atol=1e-4, rtol=0)


def test_without_a_skeleton_joints_stay_where_they_are_and_hands_go_on_from_the_forearms():
    motion = walking()
    back = motion_of_joints(motion.joints[:, :22], motion.fps)
    assert torch.equal(back.joints[:, :22], motion.joints[:, :22])
    assert back.fps == motion.fps
    for side in ("left", "right"):
        elbow, wrist, hand = (JOINTS.index(f"{side}_{name}") for name in ("elbow", "wrist", "hand"))
        fore, rest = back.joints[:, wrist] - back.joints[:, elbow], back.joints[:, hand] - back.joints[:, wrist]
        assert_close(rest, 0.08 * fore / fore.norm(dim=-1, keepdim=True), atol=1e-6, rtol=0)


def test_hands_that_are_given_turn_the_wrists():
    bent = posed({"left_wrist": about("z", torch.full((4,), 0.6, dtype=torch.float64))}, torch.zeros(4, 3).double())
    wrist = JOINTS.index("left_wrist")
    for joints, angle in ((bent.joints, 0.6), (bent.joints[:, :22], 0.0)):
        turned = matrix_to_axis_angle(motion_of_joints(joints, 30.0).rotations[:, wrist])
        assert_close(turned.norm(dim=-1), torch.full((4,), angle).double(), atol=1e-6, rtol=0)


def test_another_body_keeps_the_directions_and_stands_on_the_same_floor():
    motion, other = walking(), uniform_skeleton()
    giant = Skeleton(1.5 * other.offsets)
    back, big = (motion_of_joints(motion.joints, motion.fps, body) for body in (other, giant))
    floor = motion.joints[..., 2].min()
    assert_close(big.translation[:, 2] - floor, 1.5 * (back.translation[:, 2] - floor), atol=1e-5, rtol=0)
    assert_close(big.translation[:, :2], 1.5 * back.translation[:, :2], atol=1e-5, rtol=0)
    for joint in (*HINGES, "left_ankle", "right_wrist", "head", "left_foot"):
        index = JOINTS.index(joint)
        before, after = (m.joints[:, index] - m.joints[:, PARENTS[index]] for m in (motion, back))
        assert_close(
            after / after.norm(dim=-1, keepdim=True), before / before.norm(dim=-1, keepdim=True), atol=1e-6, rtol=0
        )
    assert back.joints[..., 2].min() == pytest.approx(float(motion.joints[..., 2].min()), abs=0.02)


def test_a_motion_is_written_as_npz_and_bvh_with_the_bones_it_moves(tmp_path):
    motion = stmc.motion_of_joints(walking().joints[:, :22], 20.0)
    stmc.write(motion, tmp_path / "motion.npz")
    stmc.write(motion, tmp_path / "motion.bvh")
    back = stmc.read(tmp_path / "motion.npz")
    assert_close(back.joints.double(), motion.joints, atol=1e-5, rtol=0)
    assert "JOINT left_knee" in (tmp_path / "motion.bvh").read_text()


# Rotations ----------------------------------------------------------------------------------------------------------


def test_pelvis_and_chest_look_where_hips_spine_collars_and_neck_say():
    motion = poses(20, 3, 0.4)
    rotations = joints_to_rotations(motion.joints, skeleton())
    for joint in ("pelvis", "spine3"):
        assert errors(motion, rotations, joint).max() < 1e-4


def test_a_turned_chest_turns_the_spine_step_by_step():
    angle = torch.full((3,), 0.9, dtype=torch.float64)
    motion = posed({"spine3": about("y", angle)}, torch.zeros(3, 3).double())
    rotations = joints_to_rotations(motion.joints, skeleton())
    for joint in ("spine1", "spine2", "spine3"):
        turned = matrix_to_axis_angle(rotations[:, JOINTS.index(joint)]).norm(dim=-1)
        assert_close(turned, angle / 3, atol=0.02, rtol=0)


@pytest.mark.parametrize(("lower", "upper", "axis", "sign"), [
    ("left_knee", "left_hip", "x", 1), ("right_knee", "right_hip", "x", 1),
    ("left_elbow", "left_shoulder", "y", -1), ("right_elbow", "right_shoulder", "y", 1),
])  # fmt: skip
def test_a_bent_limb_shows_its_twist(lower, upper, axis, sign):
    frames = 40
    angle = sign * (1.2 + 0.4 * torch.sin(torch.arange(frames, dtype=torch.float64) / 5))
    along = "y" if "knee" in lower else "x"
    twist = about(along, torch.full((frames,), 0.5, dtype=torch.float64))
    motion = posed({lower: about(axis, angle), upper: twist}, torch.zeros(frames, 3).double())
    rotations = joints_to_rotations(motion.joints, skeleton())
    for joint in (upper, lower):
        assert errors(motion, rotations, joint).max() < 1.5


def test_feet_show_the_twist_of_straight_legs():
    frames = 30
    twist = about("y", torch.full((frames,), 0.5, dtype=torch.float64))
    motion = posed({"left_hip": twist}, torch.zeros(frames, 3).double())
    rotations = joints_to_rotations(motion.joints, skeleton())
    assert errors(motion, rotations, "left_hip").max() < 6


def test_a_limb_that_is_straight_for_a_while_keeps_the_twist_of_before_and_after():
    frames = 40
    bend = torch.full((frames,), -1.2, dtype=torch.float64)
    bend[15:25] = 0
    twist = about("x", torch.full((frames,), 0.8, dtype=torch.float64))
    motion = posed({"left_elbow": about("y", bend), "left_shoulder": twist}, torch.zeros(frames, 3).double())
    rotations = joints_to_rotations(motion.joints, skeleton())
    assert errors(motion, rotations, "left_shoulder").max() < 10


@pytest.mark.parametrize("noise", [0.0, 0.002])
def test_straight_arms_that_swing_do_not_flip(noise):
    time = torch.linspace(0, 6.28, 80, dtype=torch.float64)
    swing = about("z", torch.sin(time) * 1.3) + about("y", -1.2 * torch.cos(time))
    motion = posed(
        {"left_shoulder": swing, "left_elbow": about("y", 0.02 * torch.sin(9 * time))}, torch.zeros(80, 3).double()
    )
    shaken = noise * torch.randn(motion.joints.shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    shaken[:, [JOINTS.index(name) for name in JOINTS if "elbow" not in name and "wrist" not in name]] = 0
    rotations = joints_to_rotations(motion.joints + shaken, skeleton())
    shoulder = JOINTS.index("left_shoulder")
    assert steps(rotations)[:, shoulder].max() < steps(motion.rotations)[:, shoulder].max() + 5


def test_a_walk_keeps_its_pace_in_every_joint():
    motion = walking()
    rotations = joints_to_rotations(motion.joints[:, :22], skeleton())
    assert (steps(rotations).amax(dim=0) < steps(motion.rotations).amax(dim=0) + 2).all()
    for joint in ("pelvis", "left_hip", "right_hip", "left_knee", "spine3", "left_collar", "left_ankle"):
        assert errors(motion, rotations, joint).max() < 0.5, joint


# Limits -------------------------------------------------------------------------------------------------------------


def test_joints_of_another_body_are_an_error():
    with pytest.raises(ValueError, match="22 or 24, 3\\], not \\(3, 21, 3\\)"):
        motion_of_joints(torch.zeros(3, 21, 3), 20.0)
    with pytest.raises(ValueError, match="not \\(0, 22, 3\\)"):
        motion_of_joints(torch.zeros(0, 22, 3), 20.0)


def test_a_bone_without_length_turns_with_the_one_before():
    motion = walk(5)
    joints = motion.joints.clone()
    joints[:, JOINTS.index("head")] = joints[:, JOINTS.index("neck")]
    rotations = joints_to_rotations(joints, Skeleton.default())
    neck = rotations[:, JOINTS.index("neck")]
    assert_close(neck, torch.eye(3).double().expand_as(neck))


# Real motion --------------------------------------------------------------------------------------------------------


@pytest.mark.data
def test_real_clips_come_back_through_the_263_features_with_their_joints_and_their_calm():
    archive = data_file("bandai/Bandai-Namco-Research-Motiondataset.tar.xz")
    representation, body = HumanML3DRepresentation(), skeleton()
    for _, text in itertools.islice(bandai.read_sources(archive), 0, 60, 12):
        motion = bandai.retarget(parse_bvh(text), Skeleton.default()).to(dtype=torch.float64)
        motion = motion.trimmed(0, min(motion.frames, 200)).resampled(20.0)
        direct = motion_of_joints(motion.joints[:, :22], 20.0, body)
        assert (direct.joints - motion.joints)[:, :22].norm(dim=-1).mean() < 0.005
        decoded = representation.decode(representation.encode(motion), 20.0)
        own = Skeleton.measured(decoded.rotations, decoded.joints, body.offsets[0])
        again = own.pose(decoded.rotations, decoded.translation)
        assert (again - decoded.joints).norm(dim=-1).max() < 0.005
        assert steps(decoded.rotations).max() < steps(motion.rotations).max() + 15
