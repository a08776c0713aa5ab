"""The 205 features: parity with the published ones, their symmetries, and the way back."""

import dataclasses
import math

import pytest
import torch
from conftest import checked, golden, golden_sets
from helpers.motions import walk
from hypothesis import given, settings
from hypothesis import strategies as st
from torch.testing import assert_close

from stmc.motion.body import JOINTS, BodyPart
from stmc.motion.body_model import Skeleton
from stmc.motion.geometry import axis_angle_to_matrix, rotation_z, wrap
from stmc.motion.motion import Motion
from stmc.motion.representation import HUMANML3D_LAYOUT, SMPL_LAYOUT, Field, Layout, SmplRepresentation

REPRESENTATION = SmplRepresentation()
GOLDEN = pytest.mark.parametrize("folder", golden_sets("stmc"))


def moved(motion, turn, shift):
    rotation = rotation_z(torch.tensor(turn, dtype=motion.joints.dtype))
    shift = torch.tensor([*shift, 0.0], dtype=motion.joints.dtype)
    rotations = torch.cat([(rotation @ motion.rotations[:, 0])[:, None], motion.rotations[:, 1:]], dim=1)
    return Motion(rotations, motion.translation @ rotation.mT + shift, motion.joints @ rotation.mT + shift, motion.fps)


def test_fields_follow_each_other_by_name():
    layout = Layout((Field("height", 1), Field("turns", 6, ("head", "neck"))))
    assert (layout["height"], layout["turns"], layout.width) == (slice(0, 1), slice(1, 13), 13)
    assert layout.columns[BodyPart.LEGS] == (0,)
    assert layout.columns[BodyPart.HEAD] == tuple(range(1, 13))
    assert layout.columns[BodyPart.SPINE] == ()


def test_the_smpl_layout_has_the_slices_of_the_paper():
    starts = {name: field.start for name, field in SMPL_LAYOUT.slices.items()}
    assert starts == {"root_height": 0, "root_velocity": 1, "yaw_velocity": 3, "rotations": 4, "positions": 136}
    assert (SMPL_LAYOUT.width, HUMANML3D_LAYOUT.width) == (205, 263)


@pytest.mark.parametrize("layout", [SMPL_LAYOUT, HUMANML3D_LAYOUT])
def test_every_column_belongs_to_one_body_part(layout):
    owned = [column for columns in layout.columns.values() for column in columns]
    assert sorted(owned) == list(range(layout.width))
    assert list(layout.columns) == list(BodyPart)


def test_a_layout_names_what_is_wrong_with_it():
    with pytest.raises(ValueError, match="'turns' has unknown joints \\['tail'\\]; choose from pelvis, "):
        Field("turns", 6, ("tail",))
    with pytest.raises(ValueError, match="'turns' names a joint twice"):
        Field("turns", 6, ("head", "head"))
    with pytest.raises(ValueError, match="'turns' is empty"):
        Field("turns", 0)
    with pytest.raises(ValueError, match="share a name: a, a"):
        Layout((Field("a", 1), Field("a", 2)))
    with pytest.raises(KeyError, match="no field 'speed'; choose from root_height, "):
        SMPL_LAYOUT["speed"]


@given(frames=st.integers(1, 40), seed=st.integers(0, 1000), heading=st.floats(-3, 3))
@settings(max_examples=40)
def test_features_turn_back_into_the_motion_up_to_place_and_heading(frames, seed, heading):
    motion = walk(frames, seed=seed)
    back = REPRESENTATION.decode(REPRESENTATION.encode(motion), motion.fps, heading=heading)
    floor = motion.joints[..., 2].min()
    turn = heading - float(motion.heading[0])
    expected = moved(motion, turn, (0.0, 0.0))
    shift = expected.translation[0] * torch.tensor([1.0, 1.0, 0.0]) + torch.tensor([0.0, 0.0, floor])
    assert_close(back.joints, expected.joints - shift, atol=1e-9, rtol=0)
    assert_close(back.translation, expected.translation - shift, atol=1e-9, rtol=0)
    assert_close(back.rotations, expected.rotations, atol=1e-9, rtol=0)
    assert_close(wrap(back.heading[:1] - heading), torch.zeros(1, dtype=torch.float64), atol=1e-9, rtol=0)


@given(turn=st.floats(-7, 7), x=st.floats(-100, 100), y=st.floats(-100, 100), seed=st.integers(0, 100))
@settings(max_examples=40)
def test_features_do_not_depend_on_place_and_heading(turn, x, y, seed):
    motion = walk(9, seed=seed)
    features = REPRESENTATION.encode(moved(motion, turn, (x, y)))
    assert_close(features, REPRESENTATION.encode(motion), atol=1e-9, rtol=0)


def test_single_precision_far_from_the_origin_costs_a_tenth_of_a_millimetre():
    motion = walk(30)
    far = moved(motion, 1.0, (40.0, -40.0)).to(dtype=torch.float32)
    assert_close(REPRESENTATION.encode(far).double(), REPRESENTATION.encode(motion), atol=1e-4, rtol=0)


def test_the_height_is_above_the_lowest_joint_of_the_whole_motion():
    motion = walk(10)
    height = REPRESENTATION.encode(motion)[:, SMPL_LAYOUT["root_height"]][:, 0]
    assert_close(height, motion.joints[:, 0, 2] - motion.joints[..., 2].min())


def test_walking_ahead_is_velocity_along_minus_y_of_the_heading_frame():
    motion = walk(5)
    steps = 0.05 * torch.arange(5, dtype=torch.float64)[:, None] * motion.facing[:1]
    still = torch.eye(3, dtype=torch.float64).repeat(5, 22, 1, 1)
    still[:, 0] = motion.rotations[0, 0]
    features = REPRESENTATION.encode(Motion.posed(still, steps, 20.0, Skeleton.default()))
    assert_close(features[:, SMPL_LAYOUT["root_velocity"]], torch.tensor([[0.0, -0.05]]).double().expand(5, 2))
    assert_close(features[:, SMPL_LAYOUT["yaw_velocity"]], torch.zeros(5, 1, dtype=torch.float64))


def test_turns_through_the_half_turn_are_small_steps():
    angles = torch.linspace(3.0, 3.6, 7, dtype=torch.float64)
    rotations = torch.eye(3, dtype=torch.float64).repeat(7, 22, 1, 1)
    rotations[:, 0] = rotation_z(angles)
    motion = Motion.posed(rotations, torch.zeros(7, 3, dtype=torch.float64), 20.0, Skeleton.default())
    turns = REPRESENTATION.encode(motion)[:, SMPL_LAYOUT["yaw_velocity"]]
    assert_close(turns, torch.full((7, 1), 0.1, dtype=torch.float64))


def test_with_a_skeleton_joints_follow_from_the_rotations():
    skeleton, motion = Skeleton.default(), walk(8)
    features = REPRESENTATION.encode(motion)
    features[:, SMPL_LAYOUT["positions"]] *= 1.2
    stretched = REPRESENTATION.decode(features, 20.0)
    posed = REPRESENTATION.decode(features, 20.0, skeleton)
    shin = [JOINTS.index(name) for name in ("left_knee", "left_ankle")]
    length = skeleton.offsets[shin[1]].norm().double()
    assert_close(posed.joints[:, shin].diff(dim=1).norm(dim=-1)[:, 0], length.expand(8))
    assert_close(stretched.joints[:, shin].diff(dim=1).norm(dim=-1)[:, 0], 1.2 * length.expand(8))
    assert_close(posed.rotations, stretched.rotations)


def test_many_sequences_are_integrated_as_each_alone():
    features = torch.stack([REPRESENTATION.encode(walk(12, seed=seed)) for seed in range(3)])
    headings = torch.tensor([0.0, 1.0, -2.0], dtype=torch.float64)
    batch = REPRESENTATION.integrate(features, headings)
    for index in range(3):
        alone = REPRESENTATION.decode(features[index], 20.0, heading=float(headings[index]))
        for value, expected in zip(batch, (alone.rotations, alone.translation, alone.joints), strict=True):
            assert_close(value[index], expected)


def test_any_finite_features_decode_to_a_motion():
    generator = torch.Generator().manual_seed(0)
    features = 3 * torch.randn(50, 205, generator=generator)
    features[10] = 0
    assert REPRESENTATION.decode(features, 20.0).frames == 50


def test_features_of_another_width_are_an_error():
    with pytest.raises(ValueError, match="have 263 columns; this representation needs 205"):
        REPRESENTATION.decode(torch.zeros(4, 263), 20.0)


def test_the_representation_shows_its_width_and_columns():
    assert REPRESENTATION.width == 205
    assert REPRESENTATION.columns is SMPL_LAYOUT.columns


def tensors(folder, name="smplrifke.npz"):
    return {name: torch.from_numpy(value) for name, value in golden(folder, name).items() if value.ndim}


def rotations_of(poses):
    return axis_angle_to_matrix(poses.reshape(-1, 22, 3))


def kinds(data):
    return [name.removesuffix("_feats") for name in data if name.endswith("_feats") and not name.startswith("net")]


def features_agree_with_the_published_ones(folder):
    data = tensors(folder)
    assert kinds(data)
    for kind in kinds(data):
        joints = data[f"{kind}_joints"]
        motion = Motion(rotations_of(data[f"{kind}_poses"]), joints[:, 0], joints, 20.0)
        assert_close(REPRESENTATION.encode(motion), data[f"{kind}_feats"], atol=1e-10, rtol=0)
        single = REPRESENTATION.encode(motion.to(dtype=torch.float32))
        assert_close(single.double(), data[f"{kind}_feats"], atol=1e-5, rtol=0)


def the_way_back_agrees_with_the_published_one(folder, suffix, heading):
    data = tensors(folder)
    for kind in kinds(data):
        motion = REPRESENTATION.decode(data[f"{kind}_feats"], 20.0, heading=heading)
        assert_matches(motion, data, f"{kind}_inv_{suffix}", 1e-10)


def noisy_features_of_a_network_decode_as_published(folder, suffix, dtype, limit):
    data = tensors(folder)
    motion = REPRESENTATION.decode(data["net_feats"].to(dtype), 20.0, heading=math.pi)
    assert_matches(motion, data, f"net_inv_api_{suffix}", limit)


def assert_matches(motion, data, prefix, limit):
    limit_of_positions = min(limit, 1e-6)
    assert_close(motion.joints, data[f"{prefix}_joints"], atol=limit_of_positions, rtol=0)
    assert_close(motion.translation, data[f"{prefix}_trans"], atol=limit_of_positions, rtol=0)
    assert_close(motion.rotations, rotations_of(data[f"{prefix}_poses"]), atol=limit, rtol=0)


def body_parts_own_the_published_columns(folder):
    tables = golden(folder, "body_part_indexes.json")
    assert list(JOINTS) == tables["joint_names_24"]
    for name, layout in (("smplrifke", SMPL_LAYOUT), ("guoh3dfeats", HUMANML3D_LAYOUT)):
        assert {part.value: list(columns) for part, columns in layout.columns.items()} == {
            part: sorted(columns) for part, columns in tables[name].items()
        }


@pytest.mark.golden
@GOLDEN
def test_features_there_and_back_are_the_published_ones(folder, subtests):
    checked(
        subtests,
        [
            features_agree_with_the_published_ones,
            (the_way_back_agrees_with_the_published_one, "a0", 0.0),
            (the_way_back_agrees_with_the_published_one, "api", math.pi),
            (noisy_features_of_a_network_decode_as_published, "f32", torch.float32, 5e-4),
            (noisy_features_of_a_network_decode_as_published, "f64", torch.float64, 1e-10),
            body_parts_own_the_published_columns,
        ],
        folder,
    )


@pytest.mark.golden
@GOLDEN
def test_the_published_translation_is_the_pelvis_so_reposing_with_it_shifts_the_body_r9(folder):
    data = tensors(folder)
    skeleton = Skeleton(data["rest_offsets"])
    joints = data["walk_joints"]
    motion = Motion(rotations_of(data["walk_poses"]), joints[:, 0], joints, 20.0)
    posed = dataclasses.replace(motion, joints=skeleton.pose(motion.rotations, motion.translation))
    assert_close(posed.joints, joints)
    assert_close(skeleton.smpl_translation(motion.translation), data["walk_trans"])
    shift = data["walk_inv_a0_trans"] - skeleton.smpl_translation(data["walk_inv_a0_joints"][:, 0])
    assert_close(shift, data["rest_offsets"][0].expand_as(shift))


def test_foot_steps_are_the_ways_of_the_decoded_feet_seen_from_the_heading():
    representation, skeleton = SmplRepresentation(), Skeleton.default()
    noise = torch.randn(30, 205, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    features = representation.encode(walk(30)) + 0.05 * noise  # as of a network: no two fields agree
    motion = representation.decode(features, 20, skeleton)
    feet = motion.joints[:, [JOINTS.index("left_foot"), JOINTS.index("right_foot")]].diff(dim=0)
    seen = (feet @ rotation_z(motion.heading[:-1])).flatten(1)
    torch.testing.assert_close(representation.foot_velocities(features, skeleton), seen, atol=1e-5, rtol=0)


def test_a_turn_that_goes_on_past_half_a_turn_is_the_short_way_round():
    """Turns of 2 and 3 radians go on with 4, which is 4 - 2 pi: no turn of a frame is longer than half of one."""
    rotations = torch.eye(3).repeat(3, 22, 1, 1)
    rotations[:, 0] = rotation_z(torch.tensor([0.0, 2.0, 5.0]))
    motion = Motion.posed(rotations, torch.zeros(3, 3), 20, Skeleton.default())
    turns = REPRESENTATION.encode(motion)[:, SMPL_LAYOUT["yaw_velocity"]].flatten()
    assert_close(turns, torch.tensor([2.0, 3.0, 4.0 - 2 * math.pi]), atol=1e-5, rtol=0)
