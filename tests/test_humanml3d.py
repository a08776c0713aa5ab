"""The 263 features: what each number means, their symmetries, their oddities, the way back, and models of them."""

import dataclasses
import math

import pytest
import torch
from helpers.motions import walk, walking
from helpers.tiny_model import CONFIG, Hashes, tiny
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from test_representation import moved
from torch.testing import assert_close

import stmc
from stmc.denoisers import MdmSmpl
from stmc.diffusion import ddim
from stmc.diffusion.statistics import Statistics
from stmc.motion.body import JOINTS, PARENTS
from stmc.motion.body_model import Skeleton
from stmc.motion.geometry import axis_angle_to_matrix, rotation_z
from stmc.motion.motion import Motion
from stmc.motion.representation import HUMANML3D_LAYOUT, HumanML3DRepresentation, Representation, SmplRepresentation
from stmc.motion.representation.humanml3d import (
    canonical,
    features_to_joints,
    features_to_local_joints,
    features_to_posed_joints,
    joints_to_features,
    smoothed_heading,
    uniform,
    uniform_skeleton,
    y_up,
    z_up,
)
from stmc.timeline import Timeline

REPRESENTATION = HumanML3DRepresentation()


def field(features, name):
    return features[:, HUMANML3D_LAYOUT[name]]


def standing(frames=2):
    """A T-pose with HumanML3D's bones, y up, facing z."""
    return uniform_skeleton().rest[:22].double().repeat(frames, 1, 1)


def turned(joints, angles):
    """Joints with y up, turned about the axis of the world by each frame's angle; to the left is positive."""
    return y_up(z_up(joints) @ rotation_z(torch.as_tensor(angles, dtype=joints.dtype)).mT)


# What the numbers mean ----------------------------------------------------------------------------------------------


def test_both_representations_are_one_kind_of_thing():
    for representation in (REPRESENTATION, SmplRepresentation()):
        assert isinstance(representation, Representation)
        assert representation.columns is representation.layout.columns
    assert REPRESENTATION.width == 263


def test_the_axes_of_humanml3d_have_y_up_and_face_z_and_turn_back():
    ahead, left, up = torch.tensor([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    assert y_up(ahead).tolist() == [0, 0, 1]
    assert y_up(left).tolist() == [1, 0, 0]
    assert y_up(up).tolist() == [0, 1, 0]
    points = torch.randn(5, 3, generator=torch.Generator().manual_seed(0))
    assert torch.equal(z_up(y_up(points)), points)


def test_who_stands_still_has_velocity_zero_and_feet_on_the_floor():
    features = joints_to_features(standing(3))
    for name in ("yaw_velocity", "root_velocity", "velocities"):
        assert_close(field(features, name), torch.zeros_like(field(features, name)), atol=1e-6, rtol=0)
    assert_close(field(features, "contacts"), torch.ones(2, 4).double())
    assert_close(
        field(features, "root_height")[0, 0], -standing()[0, :, 1].min() + standing()[0, 0, 1], atol=1e-5, rtol=0
    )


def test_walking_ahead_is_velocity_along_z_in_the_length_of_the_uniform_leg():
    steps = 0.02 * torch.arange(6)[:, None, None] * torch.tensor([0.0, 0.0, 1.0])
    features = joints_to_features(turned(1.5 * (standing(6) + steps), 0.7))
    assert_close(field(features, "root_velocity"), torch.tensor([[0.0, 0.02]]).double().expand(5, 2), atol=1e-6, rtol=0)
    assert_close(
        field(features, "velocities")[:, -3:], torch.tensor([[0.0, 0.0, 0.02]]).double().expand(5, 3), atol=1e-6, rtol=0
    )


def test_a_foot_touches_the_floor_where_it_moves_less_than_four_and_a_half_centimetres_a_frame():
    for step, contact in ((0.044, 1.0), (0.045, 0.0)):
        steps = step * torch.arange(3)[:, None, None] * torch.tensor([1.0, 0.0, 0.0])
        assert field(joints_to_features(standing(3) + steps), "contacts").unique().tolist() == [contact]


@pytest.mark.parametrize(
    ("moving", "contacts"),
    [
        (["left_ankle", "left_foot"], [0, 0, 1, 1]),
        (["left_foot"], [1, 0, 1, 1]),
        (["right_ankle", "right_foot"], [1, 1, 0, 0]),
        (["right_foot"], [1, 1, 1, 0]),
    ],
)
def test_contacts_are_of_left_ankle_left_foot_right_ankle_and_right_foot(moving, contacts):
    joints = standing(2)
    joints[1, [JOINTS.index(name) for name in moving]] += torch.tensor([0.0, 0.2, 0.2]).double()
    assert field(joints_to_features(joints), "contacts").tolist() == [contacts]


def test_the_yaw_velocity_is_half_the_turn_to_the_right():
    angles = 0.005 * torch.arange(400).double()
    features = joints_to_features(turned(standing(400), angles))
    middle = field(features, "yaw_velocity")[100:250]
    assert_close(middle, torch.full_like(middle, -0.0025), atol=1e-5, rtol=0)


def test_positions_are_above_the_floor_point_under_the_pelvis():
    features = joints_to_features(standing(2) + torch.tensor([3.0, 1.0, -2.0]))
    positions = field(features, "positions").reshape(-1, 21, 3)
    rest = standing(1)[0]
    expected = rest[1:] - torch.tensor([1.0, 0.0, 1.0]) * rest[0]
    expected[:, 1] -= rest[:, 1].min()
    assert_close(positions[0], expected, atol=1e-5, rtol=0)


# Symmetries ---------------------------------------------------------------------------------------------------------


@given(
    turn=st.floats(-3, 3), x=st.floats(-50, 50), y=st.floats(-50, 50), scale=st.floats(0.5, 2), seed=st.integers(0, 9)
)
@settings(max_examples=25)
def test_features_do_not_depend_on_place_heading_and_size(turn, x, y, scale, seed):
    motion = walk(9, seed=seed)
    other = moved(motion, turn, (x, y))
    big = Motion(other.rotations, scale * other.translation, scale * other.joints, motion.fps)
    assert_close(REPRESENTATION.encode(big), REPRESENTATION.encode(motion), atol=1e-7, rtol=0)


@given(frames=st.integers(2, 60), seed=st.integers(0, 1000))
@settings(max_examples=25)
def test_features_lead_back_to_the_retargeted_joints_by_positions_and_by_rotations(frames, seed):
    motion = walk(frames, seed=seed)
    whole = canonical(uniform(y_up(motion.joints[:, :22])))
    assume(bool((smoothed_heading(whole).diff().abs() < math.pi).all()))  # the half turn has its own test below
    expected, features = whole[:-1], REPRESENTATION.encode(motion)
    assert_close(features_to_joints(features), expected, atol=1e-9, rtol=0)
    assert_close(features_to_posed_joints(features), expected, atol=1e-6, rtol=0)


def test_retargeting_keeps_the_directions_of_bones_and_takes_the_lengths_of_humanml3d():
    joints = y_up(walking().joints[:, :22])
    bones = [(joint, PARENTS[joint]) for joint in range(1, 22)]
    before, after = (torch.stack([p[:, a] - p[:, b] for a, b in bones], dim=1) for p in (joints, uniform(joints)))
    lengths = uniform_skeleton().offsets[1:22].norm(dim=-1).double()
    assert_close(after, torch.nn.functional.normalize(before, dim=-1) * lengths[:, None], atol=1e-6, rtol=0)


def test_a_motion_of_humanml3d_s_proportions_is_not_scaled():
    assert_close(uniform(standing())[:, 0], standing()[:, 0], atol=1e-6, rtol=0)


def test_local_joints_look_ahead_in_every_frame():
    features = REPRESENTATION.encode(walking(turn=0.5))
    local = features_to_local_joints(features)
    assert_close(local[:, 1:, 1], features_to_joints(features)[:, 1:, 1])
    under = local[:, :1] * torch.tensor([1.0, 0.0, 1.0])
    assert_close((local - under)[:, 1:].flatten(1), field(features, "positions"), atol=1e-9, rtol=0)
    path = field(features, "root_velocity")[:-1].cumsum(dim=0)
    assert_close(local[1:, 0, [0, 2]], path, atol=1e-9, rtol=0)


def test_many_sequences_are_integrated_as_each_alone():
    features = torch.stack([REPRESENTATION.encode(walk(12, seed=seed)) for seed in range(3)])
    for back in (features_to_joints, features_to_posed_joints, features_to_local_joints):
        assert_close(back(features), torch.stack([back(each) for each in features]))


# Oddities of the format, kept ---------------------------------------------------------------------------------------


def test_the_first_frame_looks_ahead_whatever_the_body_does():
    joints = turned(standing(40), 0.1 * torch.arange(40).double())
    heading = smoothed_heading(canonical(joints))
    assert heading[0] == 0
    assert heading[1] > 0.3


def test_hips_enter_the_heading_with_the_wrong_sign():
    legs = [index for index, name in enumerate(JOINTS[:22]) if any(part in name for part in ("hip", "knee", "ankle"))]
    joints = standing(10)
    joints[:, legs] = turned(joints, 0.4)[:, legs]
    assert smoothed_heading(joints)[5] < -0.05


def test_a_turn_through_the_half_turn_loses_its_sign():
    headings = 2.5 + 0.02 * torch.arange(60).double()
    joints = turned(standing(60), headings - 2.5)
    joints = torch.cat([turned(standing(1), -2.5), joints])
    rates = field(joints_to_features(joints), "yaw_velocity")[1:, 0]
    true = -smoothed_heading(canonical(uniform(joints)))[1:].diff()
    true = torch.atan2(torch.sin(true), torch.cos(true)) / 2
    [crossing] = (rates - true).abs().gt(1e-9).nonzero().flatten().tolist()
    assert_close(rates[crossing], -true[crossing])


# Limits -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("frames", [2, 3])
def test_two_and_three_frames_are_enough(frames):
    joints = turned(standing(frames), 0.3)
    assert_close(features_to_joints(joints_to_features(joints)), canonical(uniform(joints))[:-1], atol=1e-9, rtol=0)


def test_one_frame_is_an_error():
    with pytest.raises(ValueError, match="need at least 2 frames"):
        REPRESENTATION.encode(walk(1))


def test_a_bone_without_length_is_an_error_that_names_it():
    joints = standing(4)
    joints[2, JOINTS.index("left_knee")] = joints[2, JOINTS.index("left_hip")]
    with pytest.raises(ValueError, match="frame 2: left_knee coincides with left_hip"):
        joints_to_features(joints)


@pytest.mark.parametrize("roll", [0.5 * math.pi, math.pi])
def test_bodies_that_lie_on_their_side_or_stand_on_their_head_have_finite_features(roll):
    joints = standing(30) @ axis_angle_to_matrix(torch.tensor([0.0, 0.0, roll]).double()).mT
    features = joints_to_features(joints)
    assert features.isfinite().all()
    assert_close(features_to_posed_joints(features), canonical(uniform(joints))[:-1], atol=1e-6, rtol=0)


@pytest.mark.parametrize("back", [features_to_joints, features_to_posed_joints])
def test_features_of_another_width_are_an_error(back):
    with pytest.raises(ValueError, match="have 205 columns; this representation needs 263"):
        back(torch.zeros(4, 205))


@pytest.mark.parametrize("skeleton", [None, Skeleton.default()])
def test_any_finite_features_decode_to_a_motion(skeleton):
    features = 3 * torch.randn(50, 263, generator=torch.Generator().manual_seed(0))
    features[10] = 0
    assert REPRESENTATION.decode(features, 20.0, skeleton).frames == 50
    assert REPRESENTATION.decode(torch.zeros(1, 263), 20.0, skeleton).frames == 1


# Motions ------------------------------------------------------------------------------------------------------------


def test_a_decoded_motion_moves_as_the_encoded_one():
    motion = walking()
    features = REPRESENTATION.encode(motion)
    back = REPRESENTATION.decode(features, motion.fps)
    assert (back.frames, back.fps) == (motion.frames - 1, motion.fps)
    assert_close(back.joints[:, :22], z_up(features_to_joints(features)))
    assert back.joints[..., 2].min() == pytest.approx(0, abs=1e-6)
    drift = back.heading - motion.heading[:-1]
    assert (drift - drift.mean()).abs().max() < 0.02
    assert abs(float(back.heading[0])) < 0.1


@pytest.mark.parametrize("heading", [0.0, 1.2, -3.0])
def test_a_decoded_motion_starts_above_the_origin_with_the_heading_asked_for(heading):
    features = REPRESENTATION.encode(walking())
    ahead, turned_motion = (REPRESENTATION.decode(features, 20.0, heading=angle) for angle in (0.0, heading))
    assert_close(turned_motion.joints, moved(ahead, heading, (0.0, 0.0)).joints, atol=1e-6, rtol=0)
    assert_close(turned_motion.translation[0, :2], torch.zeros(2).double(), atol=1e-6, rtol=0)


def test_on_its_skeleton_a_decoded_motion_has_the_bones_of_it():
    skeleton = uniform_skeleton()
    features = REPRESENTATION.encode(walking())
    features[:, HUMANML3D_LAYOUT["positions"]] *= 1.1
    motion = REPRESENTATION.decode(features, 20.0, skeleton)
    bones = motion.joints[:, 1:] - motion.joints[:, list(PARENTS[1:])]
    lengths = skeleton.offsets[1:].norm(dim=-1).double()
    assert_close(bones.norm(dim=-1), lengths.expand(motion.frames, -1), atol=1e-6, rtol=0)


# Models -------------------------------------------------------------------------------------------------------------


def tiny_of_263():
    """The tiny model, but for its features."""
    config = CONFIG | {
        "denoiser": CONFIG["denoiser"] | {"features": 263},
        "representation": {"_target_": "stmc.motion.representation.HumanML3DRepresentation"},
    }
    mean = REPRESENTATION.encode(walking(1.0)).mean(dim=0).float()
    with torch.random.fork_rng():
        torch.manual_seed(0)
        arguments = {key: value for key, value in config["denoiser"].items() if key != "_target_"}
        denoiser = MdmSmpl(**arguments).eval().requires_grad_(False)
    return dataclasses.replace(
        tiny(),
        denoiser=denoiser,
        representation=REPRESENTATION,
        motion_statistics=Statistics(mean, torch.full_like(mean, 0.02)),
        skeleton=uniform_skeleton(),
        config=config,
    )


def test_a_model_of_263_features_generates_saves_loads_and_exports(tmp_path):
    timeline = Timeline.parse("walk forwards # 0 # 3 # legs\nwave # 1 # 2 # right arm")
    model = tiny_of_263()
    [motion] = model.generate(timeline, steps=4, sampler=ddim)
    assert motion.frames == 60
    assert motion.joints[:, JOINTS.index("head"), 2].min() > 1.0
    back = stmc.load(stmc.save(model, tmp_path / "run", "# Tiny\n"))
    assert isinstance(back.representation, HumanML3DRepresentation)
    [again] = dataclasses.replace(back, text_encoder=Hashes()).generate(timeline, steps=4, sampler=ddim)
    assert torch.equal(again.joints, motion.joints)
    stmc.write(motion, tmp_path / "motion.npz")
    stmc.write(motion, tmp_path / "motion.bvh")
    assert_close(stmc.read(tmp_path / "motion.npz").joints, motion.joints)
