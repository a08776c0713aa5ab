"""Arms that reach, heads and trunks that turn, bodies that bend: goals are met, the rest stays to the last digit."""

import math

import pytest
import torch
from helpers.motions import standing_still, walk, walking
from hypothesis import given
from hypothesis import strategies as st
from torch.testing import assert_close

import stmc
from stmc.editing import Oscillation, WristKey, body_frame, copy_arm, reach
from stmc.editing.keys import Timing, minimum_jerk
from stmc.motion.body import JOINTS, PARENTS
from stmc.motion.geometry import global_rotations, matrix_to_axis_angle, rotation_z

SIDES = ("left", "right")
ARM = ("collar", "shoulder", "elbow", "wrist", "hand")
EAR = WristKey(1.2, 0.6, (0.17, 0.02, 0.06), "head", pole=(0.6, -1, 0.3), shrug=0.1, arc=(0.03, 0, 0.1))
BACK = WristKey(2.6, 0.7)


def at(motion, name):
    return motion.joints[:, JOINTS.index(name)]


def seen(motion, joint, frame, side):
    """Where a joint is in the axes of a body frame."""
    origin, axes = body_frame(motion, frame, side)
    return ((at(motion, joint) - origin)[:, None] @ axes)[:, 0]


def bones(motion):
    return (motion.joints[:, 1:] - motion.joints[:, list(PARENTS[1:])]).norm(dim=-1)


def same_but(first, second, joints):
    """Whether all other joints are equal, to the last digit, in position and in rotation."""
    others = [place for place, name in enumerate(JOINTS) if name not in joints]
    rotations = [place for place in others if place < 22]
    places = torch.equal(first.joints[:, others], second.joints[:, others])
    return places and torch.equal(first.rotations[:, rotations], second.rotations[:, rotations])


def forward(motion, joint):
    return global_rotations(motion.rotations, PARENTS)[:, JOINTS.index(joint), :, 2]


# Timing -------------------------------------------------------------------------------------------------------------


def test_minimum_jerk_begins_and_ends_at_rest_and_is_half_way_in_the_middle():
    phase = torch.tensor([0.0, 0.5, 1.0], dtype=torch.float64, requires_grad=True)
    way = minimum_jerk(phase)
    (speed,) = torch.autograd.grad(way.sum(), phase)
    assert_close(way.detach(), torch.tensor([0.0, 0.5, 1.0], dtype=torch.float64))
    assert_close(speed, torch.tensor([0.0, 1.875, 0.0], dtype=torch.float64))


@pytest.mark.parametrize(("skew", "earlier"), [(1.5, True), (0.8, False)])
def test_a_skew_moves_the_fastest_moment(skew, earlier):
    seconds = torch.linspace(0, 2, 2001, dtype=torch.float64)
    fastest = int(Timing(1.5, 1.0, skew).progress(seconds).diff().argmax())
    assert (fastest < 1000) == earlier and abs(fastest - 1000) > 50


@pytest.mark.parametrize("bad", [{"takes": 0}, {"takes": math.nan}, {"skew": 0.5}, {"skew": math.nan}])
def test_impossible_timings_are_refused(bad):
    with pytest.raises(ValueError, match=next(iter(bad))):
        Timing(**{"time": 1, "takes": 1} | bad)


# Arms ---------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("side", SIDES)
@pytest.mark.parametrize(
    ("frame", "goal"),
    [
        ("chest", (0.1, -0.2, 0.3)),
        ("head", (0.17, 0.02, 0.06)),
        ("shoulder", (0.1, 0.05, 0.4)),
        ("ground", (0.15, 1.1, 0.1)),
    ],
)
def test_the_wrist_is_at_its_goal_from_the_arrival_on(side, frame, goal):
    motion = walking(seconds=3)
    reached = reach(motion, side, [WristKey(1.0, 0.6, goal, frame)])
    wrist = seen(reached, f"{side}_wrist", frame, side)[20:]
    assert (wrist - wrist.new_tensor(goal)).norm(dim=-1).max() < 1e-3
    assert (bones(reached) - bones(motion)).abs().max() < 1e-9


@given(seed=st.integers(0, 1000), side=st.sampled_from(SIDES))
def test_any_goal_is_met_as_near_as_the_arm_can(seed, side):
    goal = tuple(torch.randn(3, generator=torch.Generator().manual_seed(seed)).mul(0.4).tolist())
    motion = walk(30, seed=seed)
    reached = reach(motion, side, [WristKey(0.8, 0.6, goal, "shoulder")])
    wrist, wanted = seen(reached, f"{side}_wrist", "shoulder", side)[-1], torch.tensor(goal, dtype=torch.float64)
    arm = float(bones(motion)[0, [JOINTS.index(f"{side}_{name}") - 1 for name in ("elbow", "wrist")]].sum())
    own = float((at(motion, f"{side}_wrist") - at(motion, f"{side}_shoulder"))[-1].norm())
    near, far = min(0.3 * arm, own), max(0.998 * arm, own)
    assert_close(wrist, wanted * wanted.norm().clamp(near, far) / wanted.norm(), atol=1e-6, rtol=0)


@pytest.mark.parametrize("side", SIDES)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_all_but_the_arm_and_all_before_and_after_stay_to_the_last_digit(side, dtype):
    motion = walking(seconds=4).to(dtype=dtype)
    reached = reach(motion, side, [EAR, BACK], tremor=0.001, seed=3)
    assert same_but(reached, motion, [f"{side}_{name}" for name in ARM])
    assert torch.equal(reached.translation, motion.translation)
    for frames in (slice(0, 13), slice(52, None)):
        assert torch.equal(reached.joints[frames], motion.joints[frames])
        assert torch.equal(reached.rotations[frames], motion.rotations[frames])
    assert (at(reached, f"{side}_wrist") - at(motion, f"{side}_wrist"))[30].norm() > 0.3


def test_the_other_side_does_the_mirror_image():
    motion = walking(seconds=4)
    left = reach(motion, "left", [EAR, BACK])
    right = reach(motion.mirrored(), "right", [EAR, BACK]).mirrored()
    assert_close(left.joints, right.joints, atol=1e-12, rtol=0)
    assert_close(left.rotations, right.rotations, atol=1e-12, rtol=0)


def test_an_arm_comes_and_goes_without_a_jump():
    motion = walking(seconds=4)
    reached = reach(motion, "left", [EAR, BACK])
    steps = matrix_to_axis_angle(reached.rotations[:-1].mT @ reached.rotations[1:]).norm(dim=-1)
    assert steps.max() < 0.5


def test_the_elbow_is_on_the_side_of_its_pole():
    motion = walking(seconds=2)
    for height in (-1.0, 1.0):
        key = WristKey(1.0, 0.6, (0.1, 0.0, 0.25), pole=(0.3, height, 0.0))
        elbow = seen(reach(motion, "left", [key]), "left_elbow", "chest", "left")[20:]
        assert (elbow[:, 1] * height > 0.05).all()


def test_a_key_that_begins_before_the_last_arrived_is_passed_by():
    motion = walking(seconds=3)
    keys = [WristKey(1.0, 0.5, (0.3, 0.1, 0.1)), WristKey(1.3, 0.5, (0.0, -0.2, 0.35))]
    reached = reach(motion, "left", keys)
    wrist = seen(reached, "left_wrist", "chest", "left")
    assert (wrist.diff(dim=0).norm(dim=-1)[14:24] > 0.005).all()
    assert_close(wrist[26:], wrist.new_tensor(keys[1].goal).expand(34, 3), atol=1e-3, rtol=0)


def test_oscillations_begin_at_arrival_with_one_phase_and_have_their_size():
    wave = Oscillation(1.0, (0.05, 0.0, 0.0), (0.0, 0.03, 0.0))
    offsets = wave.offsets(torch.tensor([-1.0, 0.0, 0.75, 1.0, 1.25], dtype=torch.float64))
    expected = [[0, 0, 0], [0, 0, 0], [-0.05, 0, 0], [0, 0.03, 0], [0.05, 0, 0]]
    assert_close(offsets, torch.tensor(expected, dtype=torch.float64), atol=1e-12, rtol=0)
    key = WristKey(1.0, 0.6, (0.1, -0.1, 0.3), oscillation=wave)
    wrist = seen(reach(walking(seconds=3), "left", [key]), "left_wrist", "chest", "left")
    assert_close(wrist[[40, 45]], wrist.new_tensor([[0.1, -0.07, 0.3], [0.15, -0.1, 0.3]]), atol=1e-9, rtol=0)


def test_a_tremor_has_its_size_belongs_to_its_seed_and_needs_one():
    motion = walking(seconds=6)
    key = WristKey(0.5, 0.5, (0.1, -0.1, 0.3))
    still, first, again, other = (
        seen(reach(motion, "left", [key], tremor, seed), "left_wrist", "chest", "left")[10:]
        for tremor, seed in ((0, None), (0.002, 1), (0.002, 1), (0.002, 2))
    )
    assert torch.equal(first, again) and not torch.equal(first, other)
    assert 0.001 < float((first - still).square().mean().sqrt()) < 0.004
    with pytest.raises(ValueError, match="seed"):
        reach(motion, "left", [key], tremor=0.002)


def test_requests_that_make_no_sense_are_refused():
    motion = walking(seconds=2)
    with pytest.raises(ValueError, match="side"):
        reach(motion, "both", [EAR])
    with pytest.raises(ValueError, match="sort them by time"):
        reach(motion, "left", [BACK, EAR])
    with pytest.raises(ValueError, match="frame"):
        reach(motion, "left", [WristKey(1, 1, (0, 0, 0), "foot")])
    with pytest.raises(ValueError, match="sort them by time"):
        stmc.turn_head(motion, [stmc.TurnKey(2, 1), stmc.TurnKey(1, 1)])


def test_a_copied_arm_is_the_mirror_image_of_the_other_and_the_rest_stays():
    motion = walking(seconds=3)
    copied = copy_arm(motion, "right")
    assert same_but(copied, motion, [f"right_{name}" for name in ARM])
    assert (bones(copied) - bones(motion)).abs().max() < 1e-9
    for joint in ("elbow", "wrist"):
        there = [seen(copied, f"{side}_{joint}", "chest", side) for side in SIDES]
        assert (there[0] - there[1]).abs().max() < 0.01  # the default body is not quite symmetric


# Heads and trunks ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("turn", "toward"), [({"yaw": 0.8}, (1, 0)), ({"pitch": 0.5}, (0, -1))])
def test_a_head_turns_by_what_was_asked_and_nothing_else_does(turn, toward):
    [motion] = [stmc.Motion.posed(torch.eye(3).double().repeat(60, 22, 1, 1), torch.zeros(60, 3).double(), 20, BODY)]
    turned = stmc.turn_head(motion, [stmc.TurnKey(1.0, 0.5, **turn), stmc.TurnKey(2.0, 0.5)])
    assert same_but(turned, motion, ["neck", "head"])
    [angle] = turn.values()
    axis = forward(turned, "head")[25]
    assert_close(axis[2], torch.tensor(math.cos(angle), dtype=torch.float64))
    assert_close(axis[:2], math.sin(angle) * axis.new_tensor(toward))
    assert torch.equal(turned.joints[40:], motion.joints[40:])


BODY = stmc.Skeleton(stmc.Skeleton.default().offsets.double())


def test_a_trunk_turns_its_chest_legs_stay_and_a_steady_gaze_stays():
    motion = walking(seconds=3)
    keys = [stmc.TurnKey(1.0, 0.6, yaw=0.6), stmc.TurnKey(2.5, 0.6)]
    turned, steady = stmc.turn_trunk(motion, keys), stmc.turn_trunk(motion, keys, gaze=1)
    legs = [f"{side}_{name}" for side in SIDES for name in ("hip", "knee", "ankle", "foot")]
    for edited in (turned, steady):
        assert same_but(edited, motion, set(JOINTS) - {"pelvis", *legs})
        assert (bones(edited) - bones(motion)).abs().max() < 1e-9
        assert torch.equal(edited.joints[51:], motion.joints[51:])
        angle = matrix_to_axis_angle(_chest(motion)[30].mT @ _chest(edited)[30]).norm()
        assert abs(float(angle) - 0.6) < 0.02
    away = [torch.acos((forward(each, "head")[30] * forward(motion, "head")[30]).sum()) for each in (turned, steady)]
    assert away[0] > 0.5 and away[1] < 0.06


def _chest(motion):
    return global_rotations(motion.rotations, PARENTS)[:, JOINTS.index("spine3")]


# Pelvis and feet ----------------------------------------------------------------------------------------------------


def test_a_pelvis_moves_as_asked_over_feet_that_stay():
    motion = standing_still(60)
    keys = [stmc.PelvisKey(1.0, 0.8, (0.05, -0.15, 0.03), yaw=0.2, pitch=0.1), stmc.PelvisKey(2.5, 0.8)]
    shifted = stmc.shift_pelvis(motion, keys)
    for name in ("left_ankle", "right_ankle", "left_foot", "right_foot"):
        assert_close(at(shifted, name), at(motion, name), atol=1e-9, rtol=0)
    moved = (shifted.translation - motion.translation)[25]
    assert_close(moved, moved.new_tensor([0.05, -0.03, -0.15]), atol=1e-9, rtol=0)  # faces -y, left is +x
    assert abs(float(shifted.heading[25] - motion.heading[25]) - 0.2) < 0.01
    assert (bones(shifted) - bones(motion)).abs().max() < 1e-9
    assert torch.equal(shifted.rotations[51:], motion.rotations[51:])
    assert torch.equal(shifted.translation[51:], motion.translation[51:])


def test_a_pelvis_moves_in_its_own_heading():
    motion = standing_still(40)
    quarter = rotation_z(torch.tensor(math.pi / 2, dtype=torch.float64))
    rotations = motion.rotations.clone()
    rotations[:, 0] = quarter @ rotations[:, 0]
    turned = stmc.Motion.posed(rotations, motion.translation, 20, BODY)
    keys = [stmc.PelvisKey(1.0, 0.8, (0.05, -0.1, 0.04), yaw=0.2)]
    first, second = (stmc.shift_pelvis(each, keys) for each in (motion, turned))
    pelvis = motion.translation[-1]
    assert_close(second.translation[-1] - pelvis, quarter @ (first.translation[-1] - pelvis))


def test_a_foot_steps_and_the_other_stays():
    motion = standing_still(60)
    lower = stmc.shift_pelvis(motion, [stmc.PelvisKey(0.6, 0.5, (0, -0.1, 0))])
    stepped = stmc.step(lower, "right", [stmc.FootKey(1.5, 0.6, (0, 0, 0.15), lift=0.08)])
    assert same_but(stepped, lower, [f"right_{name}" for name in ("hip", "knee", "ankle", "foot")])
    moved = at(stepped, "right_ankle") - at(lower, "right_ankle")
    assert_close(moved[-1], moved.new_tensor([0, -0.15, 0]), atol=1e-9, rtol=0)
    assert 0.07 < float(moved[:, 2].max()) <= 0.08 + 1e-9


def test_who_bends_down_reaches_the_floor_with_a_hand_and_comes_up_again():
    motion = standing_still(100)
    bent = stmc.bend_down(motion, 1.6, 1.0, depth=0.4)
    picked = reach(bent, "left", [WristKey(1.6, 1.0, (0.1, 0.16, 0.1), "ground"), WristKey(3.2, 1.0)])
    assert_close(at(picked, "left_wrist")[34, 2], torch.tensor(0.16, dtype=torch.float64), atol=1e-3, rtol=0)
    assert_close(at(picked, "right_foot"), at(motion, "right_foot"), atol=1e-9, rtol=0)
    assert torch.equal(picked.joints[65:], motion.joints[65:])
    assert (bones(picked) - bones(motion)).abs().max() < 1e-9
