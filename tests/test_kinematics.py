"""Measures of motions whose every number is known in closed form, and the abilities that are read off them."""

import dataclasses
import math

import pytest
import torch
from helpers.bandai_files import about, posed, skeleton
from torch import Tensor

from stmc.evaluation.benchmarks.ability import abilities, keeps_running, raises_while_walking
from stmc.motion import kinematics
from stmc.motion.body import JOINTS, BodyPart
from stmc.motion.geometry import rotation_z
from stmc.motion.motion import Motion

FPS = 30
LEFT, RIGHT = (1.0, "left"), (-1.0, "right")


def seconds(duration: float) -> Tensor:
    return torch.arange(round(duration * FPS), dtype=torch.float64) / FPS


def moving(
    duration: float = 4.0, speed: float = 0.0, yaw_rate: float = 0.0, direction: float = 0.0, **joints: Tensor
) -> Motion:
    """`speed` m/s at `direction` radians to the left of the heading, which turns by `yaw_rate` rad/s; arms hang but for
    what `joints` says."""
    time = seconds(duration)
    heading = 0.7 + yaw_rate * time
    way = heading + direction
    velocity = speed / FPS * torch.stack([torch.sin(way), -torch.cos(way), torch.zeros_like(way)], dim=-1)
    pelvis = torch.cumsum(velocity, dim=0) - velocity + torch.tensor([1.0, 2.0, 1.0], dtype=torch.float64)
    hanging = {f"{side}_shoulder": about("z", torch.full_like(time, -1.3 * sign)) for sign, side in (LEFT, RIGHT)}
    return posed(hanging | joints, pelvis, heading)


def lifted(duration: float, side: str, start: float = 0.0, end: float = math.inf) -> dict[str, Tensor]:
    """The arm of `side` straight up between two moments, and hanging before and after."""
    time = seconds(duration)
    sign = dict((name, sign) for sign, name in (LEFT, RIGHT))[side]
    up = (time >= start) & (time < end)
    return {f"{side}_shoulder": about("z", sign * torch.where(up, math.pi / 2, -1.3))}


def waving(duration: float, side: str, waves: float, amplitude: float = 0.6, up: bool = True) -> dict[str, Tensor]:
    """Upper arm level, forearm up (or down), swinging sideways as a cosine, that is from one turning point on."""
    time = seconds(duration)
    sign = dict((name, sign) for sign, name in (LEFT, RIGHT))[side]
    swing = amplitude * torch.cos(2 * math.pi * waves * time / time[-1])
    forearm = sign * (math.pi / 2 if up else -math.pi / 2) + swing
    return {f"{side}_shoulder": about("z", torch.zeros_like(time)), f"{side}_elbow": about("z", forearm)}


def test_an_unknown_joint_is_refused_with_those_there_are():
    with pytest.raises(ValueError, match="unknown joint 'tail'; choose from pelvis, left_hip"):
        kinematics.joint(moving(), "tail")


@pytest.mark.parametrize("yaw_rate", [0.0, 0.5])
@pytest.mark.parametrize(
    ("direction", "share"), [(0.0, 1.0), (math.pi, -1.0), (math.pi / 2, 0.0), (math.pi / 3, 0.5)], ids=str
)
def test_forward_speed_is_the_part_of_the_velocity_along_the_heading(direction, share, yaw_rate):
    speed = kinematics.forward_speed(moving(speed=1.3, yaw_rate=yaw_rate, direction=direction))
    assert speed.shape == (4 * FPS - 1,)
    torch.testing.assert_close(speed, torch.full_like(speed, 1.3 * share), atol=1e-9, rtol=0)


def test_rising_is_not_walking():
    motion = moving()
    up = torch.linspace(0, 1, motion.frames, dtype=torch.float64)[:, None] * torch.tensor([0.0, 0.0, 1.0])
    rising = Motion.posed(motion.rotations, motion.translation + up, FPS, skeleton())
    assert kinematics.forward_speed(rising).abs().max() < 1e-12


@pytest.mark.parametrize("yaw_rate", [0.3, -0.3, 4.0, 0.0])
def test_a_turn_is_the_net_angle_to_the_left_with_full_turns_counted(yaw_rate):
    assert kinematics.turn(moving(yaw_rate=yaw_rate)) == pytest.approx(yaw_rate * (4 - 1 / FPS), abs=1e-9)


@pytest.mark.parametrize(("sign", "side"), [LEFT, RIGHT])
@pytest.mark.parametrize("angle", [-1.3, 0.0, 0.4, math.pi / 2])
def test_a_wrist_s_height_follows_from_the_shoulder_s_angle(angle, sign, side):
    turned = {f"{side}_shoulder": about("z", torch.full((30,), sign * angle, dtype=torch.float64))}
    motion = moving(1.0, **turned)
    bones = skeleton().offsets[[JOINTS.index(f"{side}_elbow"), JOINTS.index(f"{side}_wrist")]].sum(dim=0)
    expected = abs(bones[0]) * math.sin(angle) + bones[1] * math.cos(angle)
    height = kinematics.wrist_height(motion, side, "shoulder")
    torch.testing.assert_close(height, expected.expand(30), atol=1e-9, rtol=0)


@pytest.mark.parametrize(("_", "side"), [LEFT, RIGHT])
@pytest.mark.parametrize("waves", [1, 2, 5])
def test_a_wave_to_and_fro_is_two_swings(waves, _, side):
    motion = moving(6.0, speed=1.0, yaw_rate=0.8, **waving(6.0, side, waves))
    other = "left" if side == "right" else "right"
    assert kinematics.swings(motion, side) == 2 * waves
    assert kinematics.swings(motion, other) == 0


def test_what_is_too_small_or_below_the_elbow_is_no_swing():
    length = skeleton().offsets[JOINTS.index("left_wrist")].norm().item()
    for extent, expected in ((0.06, 6), (0.04, 0)):
        motion = moving(4.0, **waving(4.0, "left", 3, amplitude=math.asin(extent / 2 / length)))
        assert kinematics.swings(motion, "left", extent=0.05) == expected
    assert kinematics.swings(moving(4.0, **waving(4.0, "left", 3, up=False)), "left") == 0


def test_raising_and_lowering_an_arm_is_not_waving():
    motion = moving(4.0, **lifted(4.0, "left", start=1.0, end=2.0))
    assert kinematics.swings(motion, "left") < 3


def sliding(motion: Motion, above: float = 0.0) -> float:
    """Foot sliding of a motion whose lowest toe is `above` the floor."""
    lowest = min(float(kinematics.joint(motion, f"{side}_foot")[:, 2].min()) for side in ("left", "right"))
    return kinematics.foot_sliding(motion, floor=lowest - above)


def lifted_by(motion: Motion, height: torch.Tensor) -> Motion:
    up = height.double()[:, None] * torch.tensor([0.0, 0.0, 1.0])
    return Motion.posed(motion.rotations, motion.translation + up, FPS, skeleton())


def test_feet_that_stand_do_not_slide():
    assert sliding(moving(yaw_rate=0.0, **lifted(4.0, "left", start=1.0))) == pytest.approx(0, abs=1e-12)


@pytest.mark.parametrize("above", [-0.01, 0.0, 0.02])
def test_feet_that_are_dragged_slide_by_the_way_of_each_frame(above):
    assert sliding(moving(speed=0.6), above) == pytest.approx(0.6 / FPS, abs=1e-9)


def test_feet_that_tread_on_the_spot_do_not_slide():
    motion = moving()
    assert sliding(lifted_by(motion, 0.01 * torch.sin(9 * seconds(4.0)))) == pytest.approx(0, abs=1e-9)


def test_a_foot_in_the_air_may_move():
    swing = 0.5 * torch.sin(9 * seconds(4.0))
    raised = about("x", -1.0 + swing)  # the thigh forward and up: the foot stays above the other
    motion = moving(**{"left_hip": raised})
    lowest = kinematics.joint(motion, "left_foot")[:, 2] - kinematics.joint(motion, "right_foot")[:, 2]
    assert lowest.min() > kinematics.CONTACT_HEIGHT
    assert sliding(motion) == pytest.approx(0, abs=1e-12)


@pytest.mark.parametrize("height", [0.005, 0.0125, 0.02])
def test_the_higher_a_foot_the_less_of_a_contact_it_is(height):
    motion = moving(1.0)
    still, frames = motion.frames // 2, torch.arange(motion.frames)
    way = 0.1 * (frames - still).clamp(min=0).double()[:, None] * torch.tensor([1.0, 0.0, 0.0])
    swings = Motion.posed(motion.rotations, way, FPS, skeleton())
    swings = lifted_by(swings, torch.where(frames > still, height, 0.0))
    share = 2 - 2 ** (height / 0.025)  # of a contact, as MANN has it: each of the frames that go 10 cm
    steps = motion.frames - 1 - still
    assert sliding(swings) == pytest.approx(0.1 * share * steps / (share * steps + still), rel=1e-6)


def test_sliding_counts_only_frames_whose_next_is_a_contact_too():
    motion = moving(1.0, speed=0.3)
    hop = torch.zeros(motion.frames)
    hop[::2] = 0.5
    assert math.isnan(sliding(lifted_by(motion, hop)))


def test_penetration_is_the_mean_depth_of_the_lowest_joint():
    motion = moving(2.0)
    depth = motion.joints[..., 2].min() + torch.where(seconds(2.0) < 1, 0.1, -0.1)
    moved = motion.translation - depth[:, None] * torch.tensor([0.0, 0.0, 1.0])
    sunk = Motion.posed(motion.rotations, moved, FPS, skeleton())
    assert kinematics.floor_penetration(sunk) == pytest.approx(0.05, abs=1e-7)
    assert kinematics.floor_penetration(sunk, floor=-0.2) == 0
    assert kinematics.floor_penetration(sunk, floor=0.1) == pytest.approx(0.1, abs=1e-7)


def elsewhere(motion: Motion) -> Motion:
    """The same movement at another place, under another heading."""
    turned = rotation_z(torch.tensor(1.1, dtype=torch.float64))
    rotations = motion.rotations.clone()
    rotations[:, 0] = turned @ rotations[:, 0]
    return Motion.posed(rotations, motion.translation @ turned.T + 3, motion.fps, skeleton())


def test_the_same_movement_elsewhere_is_no_diversity():
    motion = moving(speed=1.0, yaw_rate=0.4)
    assert kinematics.diversity([motion, elsewhere(motion)]) == pytest.approx(0, abs=1e-9)


def test_diversity_is_the_mean_distance_of_a_joint_over_all_pairs():
    motion = moving(2.0)
    shifted = []
    for metres in (0.0, 0.24, 0.48):
        joints = motion.joints.clone()
        joints[:, JOINTS.index("head"), 2] += metres
        shifted.append(dataclasses.replace(motion, joints=joints))
    mean_of_pairs = (0.24 + 0.48 + 0.24) / 3 / len(JOINTS)
    assert kinematics.diversity(shifted) == pytest.approx(mean_of_pairs, abs=1e-9)
    assert kinematics.diversity([shifted[0], shifted[1].trimmed(0, 10)]) == pytest.approx(0.24 / 24, abs=1e-9)
    with pytest.raises(ValueError, match="at least two"):
        kinematics.diversity(shifted[:1])


# Abilities --------------------------------------------------------------------------------------------------------


def both(maker, *arguments) -> dict[str, Tensor]:
    return maker(*arguments[:1], "left", *arguments[1:]) | maker(*arguments[:1], "right", *arguments[1:])


SHOWN = {
    "stands": ((lambda: moving(3.0)), ()),
    "raises left": ((lambda: moving(3.0, **lifted(3.0, "left", 1, 2))), ("raise the left arm",)),
    "raises right": ((lambda: moving(3.0, **lifted(3.0, "right", 1, 2))), ("raise the right arm",)),
    "raises both": ((lambda: moving(3.0, **both(lifted, 3.0, 1, 2))), ("raise both arms",)),
    "strolls": ((lambda: moving(speed=1.2)), ("walk forwards",)),
    "creeps": ((lambda: moving(speed=0.4)), ()),
    "jogs": ((lambda: moving(speed=1.8)), ("walk forwards", "run")),
    "runs": ((lambda: moving(speed=2.7)), ("run", "run for 8 s", "run for 15 s", "run for 30 s")),
    "backs": ((lambda: moving(speed=-0.8)), ("walk backwards",)),
    "sidles": ((lambda: moving(speed=0.8, direction=math.pi / 2)), ()),
    "turns left": ((lambda: moving(speed=1.0, yaw_rate=0.4)), ("walk forwards", "turn left")),
    "turns right": ((lambda: moving(speed=1.0, yaw_rate=-0.4)), ("walk forwards", "turn right")),
    "veers": ((lambda: moving(speed=1.0, yaw_rate=0.15)), ("walk forwards",)),
    "waves left": ((lambda: moving(4.0, **waving(4.0, "left", 2))), ("wave with the left hand", "raise the left arm")),
    "waves right": (
        (lambda: moving(4.0, **waving(4.0, "right", 2))), ("wave with the right hand", "raise the right arm"),
    ),
    "waves both": (
        (lambda: moving(4.0, **both(waving, 4.0, 2))),
        ("wave with both hands", "wave with the left hand", "wave with the right hand", "raise both arms"),
    ),
    "waves once": ((lambda: moving(4.0, **waving(4.0, "left", 1))), ("raise the left arm",)),
}  # fmt: skip


@pytest.mark.parametrize("name", SHOWN)
def test_a_motion_shows_the_abilities_it_has_and_no_others(name):
    make, expected = SHOWN[name]
    motion = make()
    assert {ability.name for ability in abilities() if ability.shown(motion)} == set(expected)


def walking_with(
    start: float = 2.5, end: float = 5.5, speed: float = 1.2, side: str = "right", **more: Tensor
) -> Motion:
    return moving(8.0, speed=speed, **lifted(8.0, side, start, end), **more)


@pytest.mark.parametrize(
    ("motion", "shown"),
    [
        (lambda: walking_with(), True),
        (lambda: walking_with(start=2.0, end=6.0), True),
        (lambda: walking_with(start=3.5, end=4.0), True),
        (lambda: walking_with(start=1.0), False),
        (lambda: walking_with(end=7.0), False),
        (lambda: walking_with(start=6.0, end=6.2), False),
        (lambda: walking_with(speed=0.2), False),
        (lambda: walking_with(speed=2.5), False),
        (lambda: walking_with(side="left"), False),
        (lambda: walking_with(**lifted(8.0, "left", 7.0, 7.5)), False),
    ],
    ids=["exact", "slack", "short", "early", "late", "after", "stands", "runs", "other arm", "both arms"],
)
def test_walking_and_raising_meanwhile_is_shown_only_at_the_right_time_by_the_right_arm(motion, shown):
    assert raises_while_walking(motion()) == shown


def test_walking_must_go_on_during_the_raise():
    time = seconds(8.0)
    pelvis = torch.zeros(len(time), 3, dtype=torch.float64)
    speed = torch.where((time > 2.5) & (time < 5.5), 0.1, 1.2)
    pelvis[:, 1] = -torch.cumsum(speed / FPS, dim=0)
    hanging = {"left_shoulder": about("z", torch.full_like(time, -1.3))}
    stopping = posed(hanging | lifted(8.0, "right", 2.5, 5.5), pelvis)
    assert not raises_while_walking(stopping)


def test_who_slows_down_to_a_walk_does_not_keep_running():
    time = seconds(12.0)
    pelvis = torch.zeros(len(time), 3, dtype=torch.float64)
    for slow, kept in ((1.2, False), (2.2, True)):
        speed = torch.where(time < 8, 2.6, slow)  # 2.1 m/s on the whole
        pelvis[:, 1] = -torch.cumsum(speed / FPS, dim=0)
        assert keeps_running(posed({}, pelvis)) == kept


def test_every_ability_asks_for_its_text_on_the_parts_it_is_about():
    asked = {ability.name: ability.timeline for ability in abilities()}
    assert len(asked) == 15
    for name, timeline in asked.items():
        texts = [prompt.text for prompt in timeline.prompts]
        assert texts == (["walk forwards", "raise the right arm"] if "meanwhile" in name else [name.split(" for ")[0]])
        arms = {part for prompt in timeline.prompts for part in prompt.parts} & {BodyPart.LEFT_ARM, BodyPart.RIGHT_ARM}
        named = {part for part in arms if str(part).split()[0] in name or "both" in name}
        assert arms == named, name
        assert timeline.duration == float(name.split()[2]) if " for " in name else timeline.duration <= 10
    assert all(0.85 <= ability.expected <= 1 for ability in abilities())


def test_the_hand_step_is_the_furthest_that_a_wrist_moves_in_a_frame_beside_the_pelvis():
    motion = moving(duration=1.0, speed=1.5)
    assert kinematics.hand_step(motion) == pytest.approx(0, abs=1e-6)
    joints = motion.joints.clone()
    joints[10:, JOINTS.index("left_wrist"), 2] += 0.3
    joints[20:, JOINTS.index("right_wrist"), 0] -= 0.4
    joints[25, JOINTS.index("head")] += 1.0
    assert kinematics.hand_step(dataclasses.replace(motion, joints=joints)) == pytest.approx(0.4, abs=1e-6)
    assert kinematics.hand_step(motion.trimmed(3, 4)) == 0
