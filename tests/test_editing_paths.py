"""Motions on other paths and at other paces: closed forms of where they go, feet that stay, bodies that stay whole."""

import math

import numpy as np
import pytest
import torch
from helpers.motions import STANDING, walking

import stmc
from stmc.data.sources.edited.jumping import soften
from stmc.data.sources.edited.kicking import LowKick
from stmc.editing.leg_posing import reach_with_legs
from stmc.motion.body import JOINTS, NUM_ROTATIONS, PARENTS
from stmc.motion.body_model import Skeleton
from stmc.motion.geometry import axis_angle_to_matrix, wrap
from stmc.motion.motion import Motion
from stmc.settings.records import SettingError

BODY = Skeleton(Skeleton.default().offsets.double())
STRAIGHT = walking(seconds=6.0, turn=0.0, speed=1.1)


def bones(motion: Motion) -> torch.Tensor:
    return torch.stack(
        [(motion.joints[:, child] - motion.joints[:, PARENTS[child]]).norm(dim=-1) for child in range(1, 24)]
    )


def joint(motion: Motion, name: str) -> torch.Tensor:
    return motion.joints[:, JOINTS.index(name)]


def stepping(frames: int = 80, fps: float = 20.0, length: float = 0.5) -> Motion:
    """A walk along -y whose feet stand exactly: the pelvis goes evenly, each ankle stays for half of the time."""
    time = torch.arange(frames, dtype=torch.float64) / fps
    rotations = standing(frames, knees=0.5).rotations
    pelvis = torch.stack([0 * time, -length * time, 0.82 + 0 * time], dim=1)
    ankles = []
    for side, phase in ((0.1, 0.0), (-0.1, 0.5)):
        cycles = time + phase
        swing = ((cycles % 1.0 - 0.5) / 0.5).clamp(0, 1)
        along = length * (cycles.floor() + swing - phase) - length / 4
        ankles.append(torch.stack([side + 0 * time, -along, 0.09 + 0.08 * (math.pi * swing).sin() ** 2], dim=1))
    posed = Motion.posed(rotations, pelvis, fps, BODY)
    feet = STANDING.expand(frames, 2, 3, 3)
    return reach_with_legs(posed, torch.stack(ankles, dim=1), feet, BODY)


def standing(frames: int = 80, fps: float = 20.0, knees: float = 0.3) -> Motion:
    """Somebody who stands on both feet with a little sway."""
    poses = torch.zeros(frames, NUM_ROTATIONS, 3, dtype=torch.float64)
    for side in ("left", "right"):
        for name, angle in (("hip", -knees / 2), ("knee", knees), ("ankle", -knees / 2)):
            poses[:, JOINTS.index(f"{side}_{name}"), 0] = angle
    poses[:, JOINTS.index("spine2"), 0] = 0.03 * torch.sin(torch.arange(frames) / fps)
    rotations = axis_angle_to_matrix(poses)
    rotations[:, 0] = STANDING @ rotations[:, 0]
    motion = Motion.posed(rotations, torch.zeros(frames, 3, dtype=torch.float64), fps, BODY)
    down = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64) * motion.joints[..., 2].min()
    return Motion.posed(rotations, motion.translation - down, fps, BODY)


EDITS = {
    "circle": lambda motion: stmc.bend_path(motion, radius=1.2),
    "quarter": lambda motion: stmc.bend_path(motion, angle=-math.pi / 2, ramp=0.2),
    "slow": lambda motion: stmc.change_pace(motion, tempo=0.7, stride=0.6),
    "fast": lambda motion: stmc.change_pace(motion, tempo=1.25, stride=1.1),
    "aside": lambda motion: stmc.shift_sideways(motion, 0.6, forward=0.4),
    "back": stmc.reverse,
    "twice": lambda motion: stmc.follow(motion, motion),
}


@pytest.mark.parametrize("edit", EDITS.values(), ids=EDITS)
def test_bones_keep_their_lengths(edit):
    lengths = bones(STRAIGHT)[:, :1]
    assert (bones(edit(STRAIGHT)) - lengths).abs().max() < 1e-9


@pytest.mark.parametrize("radius", [1.0, -1.5, 2.5])
def test_a_circle_of_the_asked_radius_closes(radius):
    speed = 1.1
    seconds = 2 * math.pi * abs(radius) / speed
    motion = walking(seconds=seconds + 0.05, turn=0.0, speed=speed)
    bent = stmc.bend_path(motion, radius=radius)
    assert (bent.translation[-1] - bent.translation[0])[:2].norm() < 0.05 + speed / motion.fps
    centre = bent.translation[:, :2].mean(dim=0)
    assert (bent.translation[:, :2] - centre).norm(dim=1).sub(abs(radius)).abs().max() < 0.05
    turned = np.unwrap(bent.heading.numpy())
    assert (turned[-1] - turned[0]) * math.copysign(1, radius) == pytest.approx(2 * math.pi, abs=0.15)


@pytest.mark.parametrize("ramp", [0.0, 0.3])
def test_a_path_turns_by_the_asked_angle_whatever_its_ends_are(ramp):
    bent = stmc.bend_path(STRAIGHT, angle=math.pi / 2, ramp=ramp)
    assert float(bent.heading[-1] - bent.heading[0]) == pytest.approx(math.pi / 2, abs=0.12)
    chord = bent.translation[-1] - bent.translation[0]
    assert math.atan2(chord[0], -chord[1]) == pytest.approx(math.pi / 4, abs=0.02)


def test_who_walks_to_the_left_leans_to_the_left_and_looks_there_before_he_turns():
    bent = stmc.bend_path(STRAIGHT, radius=1.2)
    frames = slice(20, 100)
    left = torch.stack([-bent.facing[:, 1], bent.facing[:, 0]], dim=1)
    leant, straight = ((joint(each, "neck") - joint(each, "pelvis"))[:, :2] for each in (bent, STRAIGHT))
    before = torch.stack([-STRAIGHT.facing[:, 1], STRAIGHT.facing[:, 0]], dim=1)
    assert ((leant * left).sum(dim=1) - (straight * before).sum(dim=1))[frames].mean() > 0.01
    ahead = bent.rotations[:, [JOINTS.index("neck"), JOINTS.index("head")]]
    assert not torch.allclose(ahead, STRAIGHT.rotations[:, [JOINTS.index("neck"), JOINTS.index("head")]])


@pytest.mark.parametrize(
    "edit",
    [
        lambda motion: motion,
        lambda motion: stmc.bend_path(motion, radius=1.0),
        lambda motion: stmc.bend_path(motion, angle=-1.5, ramp=0.2),
        lambda motion: stmc.shift_sideways(motion, 0.5),
        lambda motion: stmc.change_pace(motion, stride=0.6),
    ],
)
def test_feet_that_stand_stay_where_they_stand(edit):
    motion, edited = stepping(), edit(stepping())
    for side in ("left", "right"):
        steps, new = (joint(each, f"{side}_ankle").diff(dim=0).norm(dim=1) for each in (motion, edited))
        stands = steps < 1e-6
        assert stands.sum() > 30 and new[stands].max() < 1e-6 < 0.02 < new.max()


@pytest.mark.parametrize(("tempo", "stride"), [(0.7, 1.0), (1.0, 0.6), (1.25, 1.1), (0.6, 0.7)])
def test_tempo_and_stride_multiply_the_speed(tempo, stride):
    paced = stmc.change_pace(STRAIGHT, tempo, stride)
    way, before = ((each.translation[-1] - each.translation[0])[:2].norm() for each in (paced, STRAIGHT))
    assert float(way / before) == pytest.approx(stride, abs=1e-6)
    assert paced.frames == round(STRAIGHT.frames / tempo)
    speed = float(way) / (paced.frames - 1) * paced.fps
    assert speed == pytest.approx(1.1 * tempo * stride, rel=0.01)


def test_a_slowed_motion_passes_through_the_same_poses():
    slow = stmc.change_pace(STRAIGHT, tempo=0.5)
    where = torch.linspace(0, STRAIGHT.frames - 1, slow.frames, dtype=torch.float64)
    near = where.round().long()
    same = (where - near).abs() < 1e-3
    assert same.any() and (slow.joints[same] - STRAIGHT.joints[near[same]]).abs().max() < 0.02


def test_shorter_steps_come_with_arms_that_swing_less_and_legs_that_are_let_alone_in_time():
    short = stmc.change_pace(STRAIGHT, stride=0.5)
    swing = [joint(each, "left_wrist") - joint(each, "left_shoulder") for each in (short, STRAIGHT)]
    assert swing[0].std(dim=0).norm() < 0.6 * swing[1].std(dim=0).norm()


def test_a_reversed_walk_walks_back():
    back = stmc.reverse(STRAIGHT)
    way = back.translation[-1] - back.translation[0]
    assert float(way @ back.facing[0]) == pytest.approx(-float(way.norm()), rel=0.01)
    assert torch.equal(stmc.reverse(back).joints, STRAIGHT.joints)


def test_a_motion_is_moved_to_the_left_of_its_path():
    aside = stmc.shift_sideways(STRAIGHT, 0.7, forward=0.1)
    way, ahead = (STRAIGHT.translation[-1] - STRAIGHT.translation[0])[:2], STRAIGHT.facing[0, :2]
    new = (aside.translation[-1] - aside.translation[0])[:2]
    assert float(new @ ahead) == pytest.approx(0.1 * float(way @ ahead), abs=0.02)
    assert float(new[1] * ahead[0] - new[0] * ahead[1]) == pytest.approx(0.7, abs=0.02)
    assert wrap(aside.heading - STRAIGHT.heading).abs().max() < 1e-9


def test_an_edit_keeps_dtype_and_the_frame_rate():
    motion = walking(turn=0.0, fps=30.0).to(dtype=torch.float32)
    for edit in EDITS.values():
        edited = edit(motion)
        assert edited.joints.dtype == torch.float32 and edited.fps == 30.0


@pytest.mark.parametrize(
    "edit",
    [
        lambda: stmc.bend_path(STRAIGHT),
        lambda: stmc.bend_path(STRAIGHT, angle=1.0, radius=1.0),
        lambda: stmc.bend_path(STRAIGHT, radius=0.0),
        lambda: stmc.bend_path(STRAIGHT, angle=math.nan),
        lambda: stmc.bend_path(STRAIGHT, angle=1.0, ramp=0.7),
        lambda: stmc.bend_path(standing(), angle=1.0),
        lambda: stmc.change_pace(STRAIGHT, tempo=0.0),
        lambda: stmc.change_pace(STRAIGHT, stride=math.inf),
        lambda: stmc.shift_sideways(STRAIGHT, math.nan),
        lambda: stmc.turn_on_spot(standing(40), 3.0, steps=4, seconds=1.0),
        lambda: stmc.turn_on_spot(standing(), 3.0, pivot="middle"),
        lambda: stmc.turn_on_spot(standing(), math.inf),
        lambda: stmc.follow(STRAIGHT, STRAIGHT.trimmed(0, 1)),
        lambda: stmc.follow(STRAIGHT, walking(fps=30.0)),
        lambda: stmc.add_rest(STRAIGHT, standing(20), after=2.0),
        lambda: stmc.add_rest(STRAIGHT, standing(20), before=-1.0),
    ],
)
def test_what_cannot_be_done_is_said(edit):
    with pytest.raises(SettingError):
        edit()


@pytest.mark.parametrize("pivot", ["left", "right"])
@pytest.mark.parametrize("angle", [math.pi, -math.pi / 2])
def test_a_turn_on_the_spot_turns_about_the_ball_of_one_foot(pivot, angle):
    motion = standing(80)
    turn = stmc.turn_on_spot(motion, angle, pivot, steps=2, start=0.6, seconds=0.7)
    heading = np.unwrap(turn.heading.numpy())
    assert heading[-1] - heading[0] == pytest.approx(angle, abs=1e-6)
    assert (joint(turn, f"{pivot}_foot") - joint(motion, f"{pivot}_foot")).norm(dim=1).max() < 0.01
    other = joint(turn, f"{'right' if pivot == 'left' else 'left'}_foot")
    assert other.diff(dim=0).norm(dim=1).sum() > 0.3 and other[:, 2].max() > other[0, 2] + 0.03
    assert (bones(turn) - bones(motion)).abs().max() < 1e-9
    before, after = slice(0, 9), slice(48, None)
    assert (turn.joints[before] - motion.joints[before]).abs().max() < 0.01
    assert turn.joints[after].diff(dim=0).norm(dim=-1).max() < 0.02  # it stands again


def test_a_turn_keeps_the_trunk_moving_as_it_did():
    motion = standing(80)
    turn = stmc.turn_on_spot(motion, 1.0, start=0.5, seconds=0.6)
    spine = JOINTS.index("spine2")
    assert torch.equal(turn.rotations[:, spine], motion.rotations[:, spine])


def test_a_motion_goes_on_where_another_one_ends_and_the_feet_stay():
    first, second = standing(60, knees=0.5), standing(60, knees=0.1)
    both = stmc.follow(first, second)
    assert both.frames == 119 and torch.equal(both.joints[:60], first.joints)
    assert both.joints.diff(dim=0).norm(dim=-1).max() < 0.02
    feet = [JOINTS.index(f"{side}_{name}") for side in ("left", "right") for name in ("ankle", "foot")]
    assert (both.joints[:, feet] - both.joints[:1, feet]).abs().max() < 1e-3
    knee = JOINTS.index("left_knee")
    angles = [float(torch.arccos((each.rotations[-1, knee].trace() - 1) / 2)) for each in (both, first, second)]
    assert abs(angles[0] - angles[1]) > abs(angles[0] - angles[2])  # the pose became the second one's


def test_a_motion_faces_and_goes_on_in_the_direction_it_has():
    bent = stmc.bend_path(STRAIGHT, angle=math.pi / 2, ramp=0.3)
    both = stmc.follow(bent, STRAIGHT)
    way = (both.translation[-1] - both.translation[bent.frames])[:2]
    ahead = bent.facing[-1, :2]
    assert float(way @ ahead / way.norm()) > 0.98


def test_rest_comes_before_and_after_and_is_the_recording_s():
    motion, rest = standing(40, knees=0.6), standing(80, knees=0.2)
    rested = stmc.add_rest(motion, rest, before=1.0, after=2.0)
    assert rested.frames == 20 + 40 + 40
    assert (rested.joints[20:60] - motion.joints).abs().max() < 1e-9
    spine = JOINTS.index("spine2")
    assert torch.allclose(rested.rotations[-1, spine], rest.rotations[40, spine], atol=1e-2)
    assert rested.joints.diff(dim=0).norm(dim=-1).max() < 0.03


def test_a_low_kick_swings_one_leg_and_the_other_foot_stands():
    motion = standing(80)
    kick = LowKick(start=0.5, back=0.5, forward=0.9, windup=0.4, swing=0.2, recovery=0.6, hold=0.05)(motion)
    toes, other = joint(kick, "left_foot"), joint(kick, "right_foot")
    assert (other - other[0]).norm(dim=1).max() < 1e-3 and (bones(kick) - bones(motion)).abs().max() < 1e-9
    assert 0.25 < float(toes[:, 2].max()) < 0.75
    ahead = (toes - toes[0]) @ motion.facing[0]
    assert float(ahead.min()) < -0.25 and float(ahead.max()) > 0.45
    assert toes.diff(dim=0).norm(dim=1).max() * motion.fps > 4
    assert (kick.joints[-20:] - motion.joints[-20:]).abs().max() < 1e-3


def test_a_jump_is_softened_on_the_floor_and_not_in_the_air():
    frames = torch.arange(60, dtype=torch.float64)
    crouch = 0.5 * torch.exp(-(((frames - 15) / 5) ** 2)) + 0.5 * torch.exp(-(((frames - 45) / 5) ** 2))
    rise = torch.where(
        (frames > 22) & (frames < 38), 0.3 * (torch.pi * (frames - 22) / 16).sin(), torch.zeros_like(frames)
    )
    poses = torch.zeros(60, NUM_ROTATIONS, 3, dtype=torch.float64)
    for side in ("left", "right"):
        for name, share in (("hip", -0.5), ("knee", 1.0), ("ankle", -0.5)):
            poses[:, JOINTS.index(f"{side}_{name}"), 0] = 0.3 + share * 2 * crouch - 0.3 * (name != "knee")
    rotations = axis_angle_to_matrix(poses)
    rotations[:, 0] = STANDING @ rotations[:, 0]
    still = Motion.posed(rotations, torch.zeros(60, 3, dtype=torch.float64), 20.0, BODY)
    places = torch.zeros(60, 3, dtype=torch.float64)
    places[:, 2] = rise - still.joints[..., 2].amin(dim=1)
    jump = Motion.posed(rotations, places, 20.0, BODY)
    soft = soften(jump, 0.5)
    low, before = (float(joint(each, "pelvis")[:, 2].min()) for each in (soft, jump))
    top = float(joint(jump, "pelvis")[0, 2])
    assert top - low < 0.75 * (top - before)
    assert (soft.joints[28:32] - jump.joints[28:32]).abs().max() < 0.01
    assert (bones(soft) - bones(jump)).abs().max() < 1e-9
    assert (joint(soft, "left_ankle") - joint(jump, "left_ankle")).norm(dim=1).max() < 0.01
