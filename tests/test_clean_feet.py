"""Feet that stand: what is locked stays, what is not is left alone, and bodies stay whole."""

import math
from dataclasses import replace

import pytest
import torch
from helpers.motions import STANDING, walking
from hypothesis import given
from hypothesis import strategies as st

from stmc.motion.body import JOINTS, NUM_ROTATIONS, PARENTS
from stmc.motion.body_model import Skeleton
from stmc.motion.feet import clean_feet
from stmc.motion.feet.contacts import held_steps, standing_steps
from stmc.motion.feet.leg_bending import sinking
from stmc.motion.geometry import axis_angle_to_matrix, forward_kinematics, global_rotations
from stmc.motion.inverse_kinematics import bend_limb
from stmc.motion.kinematics import foot_sliding
from stmc.motion.motion import Motion

BODY = Skeleton(Skeleton.default().offsets.double())
BONES = [(child, parent) for child, parent in enumerate(PARENTS) if parent >= 0]
FEET = [JOINTS.index(f"{side}_{name}") for side in ("left", "right") for name in ("ankle", "foot")]


def bent(frames: int, knees: float = 0.4) -> torch.Tensor:
    """Rotations of somebody who stands with bent knees and flat feet."""
    poses = torch.zeros(frames, NUM_ROTATIONS, 3, dtype=torch.float64)
    for side in ("left", "right"):
        for name, angle in (("hip", -knees / 2), ("knee", knees), ("ankle", -knees / 2)):
            poses[:, JOINTS.index(f"{side}_{name}"), 0] = angle
    rotations = axis_angle_to_matrix(poses)
    rotations[:, 0] = STANDING @ rotations[:, 0]
    return rotations


def sliding(way: torch.Tensor, knees: float = 0.4, fps: float = 20.0) -> Motion:
    """Somebody who stands and is pushed over the floor as a whole, the toes on the floor: `way` [frames, 3]."""
    motion = Motion.posed(bent(len(way), knees), way.double(), fps, BODY)
    up = torch.tensor([0.0, 0.0, 1.0]) * motion.joints[0, :, 2].min()
    return Motion.posed(motion.rotations, motion.translation - up, fps, BODY)


def drift(frames: int = 60, metres: float = 0.1) -> torch.Tensor:
    return torch.linspace(0, 1, frames, dtype=torch.float64)[:, None] * torch.tensor([metres, 0.0, 0.0])


def bones(motion: Motion) -> torch.Tensor:
    return torch.stack([(motion.joints[:, child] - motion.joints[:, parent]).norm(dim=-1) for child, parent in BONES])


def toes(motion: Motion) -> torch.Tensor:
    return motion.joints[:, [JOINTS.index("left_foot"), JOINTS.index("right_foot")]]


def test_a_body_that_slides_as_a_whole_stands_and_its_trunk_goes_on_as_it_went():
    motion = sliding(drift())
    clean = clean_feet(motion)
    assert foot_sliding(motion) > 1e-3 > 1e-6 > foot_sliding(clean)
    assert torch.equal(clean.translation, motion.translation)
    assert torch.equal(
        clean.rotations[:, [0, 3, 6, 9, 12, 15, 16, 17]], motion.rotations[:, [0, 3, 6, 9, 12, 15, 16, 17]]
    )
    assert (toes(clean).mean(dim=0) - toes(motion).mean(dim=0)).norm(dim=-1).max() < 1e-9


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_motion_that_does_not_slide_is_left_as_it_is(dtype):
    motion = sliding(torch.zeros(50, 3)).to(dtype=dtype)
    sway = motion.rotations.clone()
    sway[:, JOINTS.index("left_shoulder")] = axis_angle_to_matrix(
        torch.linspace(0, 2, 50, dtype=dtype)[:, None] * torch.tensor([0.0, 0.0, 1.0], dtype=dtype)
    )
    motion = Motion.posed(sway, motion.translation, 20, Skeleton.default())
    clean = clean_feet(motion)
    for name in ("rotations", "translation", "joints"):
        assert (getattr(clean, name) - getattr(motion, name)).abs().max() < 1e-6
    assert clean.joints.dtype == dtype


def test_a_body_in_the_air_is_not_touched():
    motion = sliding(drift() + torch.tensor([0.0, 0.0, 0.5]))
    clean = clean_feet(Motion.posed(motion.rotations, motion.translation + torch.tensor([0, 0, 0.5]), 20.0, BODY))
    assert torch.equal(clean.translation, motion.translation + torch.tensor([0, 0, 0.5]))
    assert torch.equal(clean.rotations, motion.rotations)


def test_frames_far_from_every_contact_are_those_of_the_motion():
    height = torch.zeros(80, dtype=torch.float64)
    height[20:60] = torch.linspace(0, math.pi, 40, dtype=torch.float64).sin() * 0.8
    way = drift(80, 0.6)
    way[:, 2] = height
    motion = sliding(way)
    motion = Motion.posed(motion.rotations, way + motion.translation[0] * torch.tensor([0.0, 0.0, 1.0]), 20.0, BODY)
    clean = clean_feet(motion)
    for name in ("rotations", "translation", "joints"):
        assert torch.equal(getattr(clean, name)[32:48], getattr(motion, name)[32:48])
    assert not torch.equal(clean.joints[:15], motion.joints[:15])


@pytest.mark.parametrize(("seed", "knees", "speed"), [(0, 0.3, 0.02), (1, 0.6, 0.1), (2, 1.0, 0.2), (3, 0.3, 0.2)])
def test_whatever_is_held_stays_and_bones_keep_their_lengths(seed, knees, speed):
    generator = torch.Generator().manual_seed(seed)
    course = torch.randn(60, 3, generator=generator, dtype=torch.float64).cumsum(dim=0)
    steps = course.diff(dim=0, prepend=course[:1])
    steps = steps / steps.norm(dim=-1, keepdim=True).clamp(min=1e-9) * speed / 20 * torch.tensor([1.0, 1.0, 0.0])
    motion = sliding(steps.cumsum(dim=0), knees)
    held = held_steps(motion.joints[:, FEET], motion.fps, 0.0)
    clean = clean_feet(motion)
    assert clean.joints[:, FEET].diff(dim=0).norm(dim=-1)[held].max() < 1e-3
    assert (bones(clean) - bones(motion)).abs().max() < 1e-6
    posed = BODY.pose(clean.rotations, clean.translation)
    assert (posed - clean.joints).abs().max() < 1e-6


def test_nothing_of_a_foot_stays_below_the_floor():
    motion = sliding(drift())
    sunk = Motion.posed(motion.rotations, motion.translation - torch.tensor([0.0, 0.0, 0.03]), 20.0, BODY)
    assert float(toes(sunk)[..., 2].min()) < -0.029
    assert float(toes(clean_feet(sunk))[..., 2].min()) > -1e-6
    assert float(toes(clean_feet(sunk, floor=-0.1))[..., 2].min()) == pytest.approx(float(toes(sunk)[..., 2].min()))


def test_the_largest_step_of_a_walk_hardly_grows_and_its_feet_stand():
    motion = walking(seconds=6.0)
    clean = clean_feet(motion)
    largest = motion.joints.diff(dim=0).norm(dim=-1).max()
    assert clean.joints.diff(dim=0).norm(dim=-1).max() < 1.2 * largest
    assert (clean.joints - motion.joints).norm(dim=-1).mean() < 0.03


def test_the_pelvis_sinks_only_where_a_leg_is_too_short():
    straight, crouched = (clean_feet(sliding(drift(metres=0.3), knees)) for knees in (0.1, 0.9))
    before = sliding(drift(metres=0.3), 0.9)
    assert torch.equal(crouched.translation, before.translation)
    sunk = sliding(drift(metres=0.3), 0.1).translation - straight.translation
    assert 1e-3 < float(sunk[:, 2].max()) < 0.1 and float(sunk[:, :2].abs().max()) == 0
    assert float(sunk[:, 2].diff().abs().max()) < 0.01


def test_a_single_frame_and_the_settings_that_go_with_a_motion_are_kept():
    motion = replace(sliding(drift()), overlap=0.5)
    assert clean_feet(motion).overlap == 0.5
    assert clean_feet(motion.trimmed(0, 1)).frames == 1


@given(bend=st.floats(0.05, 2.0), reach=st.floats(0.3, 0.79), angle=st.floats(-0.8, 0.8), seed=st.integers(0, 1000))
def test_a_leg_reaches_where_its_foot_should_be_by_a_knee_that_bends_as_it_did(bend, reach, angle, seed):
    offsets = BODY.offsets[[0, 1, 4, 7]]
    twist = torch.randn(3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    local = axis_angle_to_matrix(
        torch.stack([torch.zeros(3), twist / 3, torch.tensor([bend, 0, 0]), torch.zeros(3)]).double()
    )
    world = global_rotations(local, (-1, 0, 1, 2))
    joints = forward_kinematics(local, offsets, (-1, 0, 1, 2))
    hip, knee, ankle = joints[1:, None]
    along = torch.nn.functional.normalize(ankle[0] - hip[0], dim=-1)
    target = hip + reach * (axis_angle_to_matrix(angle * torch.linalg.cross(along, world[1, :, 0])) @ along)
    thigh, shin = bend_limb(world[1:2], world[2:3], joints[None, 1:], target - hip, world[1:2, :, 0])
    new_knee = hip + (thigh @ offsets[2])
    assert (new_knee + shin @ offsets[3] - target).abs().max() < 1e-6
    normals = [torch.linalg.cross(knee - hip, ankle - knee), torch.linalg.cross(new_knee - hip, target - new_knee)]
    assert (normals[0] * normals[1]).sum() > 0


def test_a_body_that_lies_does_not_sink_into_the_floor():
    hips = torch.tensor([[[0.0, 0.0, 0.1]]], dtype=torch.float64).expand(10, 1, 3)
    ankles = torch.tensor([[[0.8, 0.0, 0.1]]], dtype=torch.float64).expand(10, 1, 3)
    knees = (hips + ankles) / 2
    assert float(sinking(hips, knees, ankles, ankles + torch.tensor([0.2, 0, 0]), 5).max()) == 0


def test_a_contact_is_low_slow_and_long_enough_and_fast_steps_part_contacts():
    steps = torch.tensor([0.0, 0.0, 0.0, 0.1, 0.0, 0.0, 0.0, 0.1, 0.0, 0.1, 0.1])
    place = torch.zeros(12, 1, 3)
    place[1:, 0, 0] = steps.cumsum(dim=0)
    assert held_steps(place, 20, 0.0)[:, 0].tolist() == [True] * 3 + [False] + [True] * 3 + [False] * 4
    assert not held_steps(place + torch.tensor([0, 0, 0.2]), 20, 0.0).any()
    assert held_steps(place + torch.tensor([0, 0, 0.2]), 20, 0.2).any()


def feet_of(left: torch.Tensor, right: torch.Tensor) -> torch.Tensor:
    """Level feet whose toes go along these paths [frames, 3]."""
    heel = torch.tensor([0.0, 0.1, 0.0])
    return torch.stack([torch.stack([toes + heel, toes], dim=1) for toes in (left, right)], dim=1).double()


STILL, LIFTED, LEVEL = torch.zeros(20, 3), torch.tensor([0.0, 0.0, 0.3]).expand(20, 3), torch.full((20,), 0.9).double()
GLIDING = torch.arange(20)[:, None] * torch.tensor([0.0, -0.02, 0.0]) + torch.tensor([0.0, 0.0, 0.01])


def test_a_foot_that_glides_stands_where_nothing_else_carries_and_swings_where_the_other_stands():
    swinging = GLIDING * torch.tensor([1.0, 1.1, 1.0])
    assert not held_steps(feet_of(swinging, LIFTED), 20, 0.0).any()
    alone = standing_steps(feet_of(swinging, LIFTED), LEVEL, 20, 0.0)
    assert alone[:, 0].all() and not alone[:, 1].any()
    beside = standing_steps(feet_of(swinging, STILL), LEVEL, 20, 0.0)
    assert beside[:, 1].all() and not beside[:, 0].any()


@pytest.mark.parametrize("way", [[1.0, 2.5, 1.0], [1.0, 1.1, 12.0]], ids=["fast", "high"])
def test_a_foot_that_is_fast_or_high_does_not_stand(way):
    assert not standing_steps(feet_of(GLIDING * torch.tensor(way), LIFTED), LEVEL, 20, 0.0).any()


def test_nothing_stands_by_gliding_while_the_pelvis_falls_freely():
    falling = 0.9 - 9.81 / 2 * ((torch.arange(20) - 10).double() / 20) ** 2
    swinging = GLIDING * torch.tensor([1.0, 1.1, 1.0])
    assert not standing_steps(feet_of(swinging, LIFTED), falling, 20, 0.0)[1:-1].any()


def test_contacts_that_next_to_nothing_parts_are_one_and_a_step_parts_them():
    def moved(metres: float, frames: int) -> torch.Tensor:
        share = ((torch.arange(20) - 8) / frames).clamp(0, 1)[:, None]
        return standing_steps(feet_of(share * torch.tensor([metres, 0.0, 0.0]), STILL), LEVEL, 20, 0.0)[:, 0]

    assert moved(0.05, 1).all()
    assert not moved(0.2, 1).all() and not moved(0.3, 6)[8:14].any()


def test_a_contact_begins_when_the_point_is_down():
    place = torch.zeros(20, 1, 3)
    place[:, 0, 2] = torch.tensor([0.05, 0.045, 0.04, 0.036, 0.032, 0.028, 0.024, 0.022, 0.015, *[0.01] * 11])
    assert held_steps(place, 20, 0.0)[:, 0].tolist() == [False] * 8 + [True] * 11


def halves() -> tuple[Motion, torch.Tensor]:
    """Somebody who is pushed over the floor, and the second half of the frames."""
    return sliding(drift(60, 0.3)), torch.arange(60) >= 30


def test_frames_that_are_not_free_stay_and_what_stands_in_the_last_goes_on_standing_there():
    motion, free = halves()
    clean = clean_feet(motion, free=free)
    for name in ("rotations", "translation", "joints"):
        assert torch.equal(getattr(clean, name)[~free], getattr(motion, name)[~free])
    assert (toes(clean)[30:] - toes(motion)[29]).abs().max() < 1e-3
    assert (toes(motion)[30:] - toes(motion)[29]).abs().max() > 0.1


def test_between_frames_that_are_not_free_feet_come_to_each_without_a_pop():
    motion, _ = halves()
    free = torch.ones(60, dtype=torch.bool)
    free[[20, 40]] = False
    clean = clean_feet(motion, free=free)
    assert torch.equal(clean.joints[~free], motion.joints[~free])
    largest = motion.joints.diff(dim=0).norm(dim=-1).max()
    assert clean.joints.diff(dim=0).norm(dim=-1).max() < 1.5 * largest


def test_feet_below_the_floor_where_they_must_stay_rise_slowly():
    motion, free = halves()
    sunk = Motion.posed(motion.rotations, motion.translation - torch.tensor([0.0, 0.0, 0.03]), 20.0, BODY)
    clean = clean_feet(sunk, free=free)
    assert torch.equal(clean.joints[~free], sunk.joints[~free])
    assert toes(clean)[..., 2].diff(dim=0).max() < 0.02 and float(toes(clean)[40:, :, 2].min()) > -0.031


def test_a_motion_of_which_nothing_is_free_is_itself_and_other_lengths_are_refused():
    motion, free = halves()
    assert clean_feet(motion, free=torch.zeros(60, dtype=torch.bool)) is motion
    with pytest.raises(ValueError, match="59 frames, but the motion has 60"):
        clean_feet(motion, free=free[1:])
