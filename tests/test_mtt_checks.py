"""MTT's 60 texts told by geometry: made-up motions that show one, their mirror images, and recordings."""

import math

import pytest
import torch
from conftest import data_file
from hypothesis import given
from hypothesis import strategies as st

from stmc.data.sources.contents import CONTENTS
from stmc.evaluation.benchmarks.atomic_prompts import read_texts
from stmc.evaluation.benchmarks.mtt_checks import MTT_CHECKS, confusions, mirror_words, same_meaning
from stmc.evaluation.benchmarks.published_timelines import sample_published_timelines
from stmc.evaluation.metrics.gestures import head_turn_left, longest, reversals, visits
from stmc.evaluation.metrics.steps import heading_change, jumps_with_both_feet, path_length
from stmc.motion.body import JOINTS, NUM_ROTATIONS
from stmc.motion.body_model import Skeleton
from stmc.motion.geometry import axis_angle_to_matrix, rotation_z
from stmc.motion.motion import Motion
from stmc.timeline import Timeline

FPS, FRAMES, TALL = 20, 120, 0.9
TIME = torch.arange(FRAMES) / FPS
UP = torch.tensor([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])


def moved(height=TALL, path=None, heading=None, **turns) -> Motion:
    """Six seconds with arms hanging; rotations are angles [frames] about x, y or z by joint, as `head="y", ...`."""
    angles = torch.zeros(FRAMES, NUM_ROTATIONS, 3)
    angles[:, JOINTS.index("left_shoulder"), 2] = -1.3
    angles[:, JOINTS.index("right_shoulder"), 2] = 1.3
    for name, (axis, angle) in turns.items():
        angles[:, JOINTS.index(name)] = 0
        angles[:, JOINTS.index(name), "xyz".index(axis)] = torch.as_tensor(angle).float()
    rotations = axis_angle_to_matrix(angles)
    heading = torch.zeros(FRAMES) if heading is None else heading
    rotations[:, 0] = rotation_z(heading) @ UP @ rotations[:, 0]
    place = torch.zeros(FRAMES, 3) if path is None else path.clone()
    place[:, 2] = height
    return Motion.posed(rotations, place, FPS, Skeleton.default())


def put(motion: Motion, **joints: torch.Tensor) -> Motion:
    """The motion with some joints elsewhere, for checks read joints; bones need not fit."""
    places = motion.joints.clone()
    for name, path in joints.items():
        places[:, JOINTS.index(name)] = path
        if name.endswith("_wrist"):  # the elbow halfway, hanging, bones of 23.5 cm
            side = name.removesuffix("_wrist")
            shoulder = places[:, JOINTS.index(f"{side}_shoulder")]
            half = (path - shoulder).norm(dim=-1, keepdim=True) / 2
            drop = (0.235**2 - half**2).clamp(min=0).sqrt() * torch.tensor([0.0, 0.0, 1.0])
            places[:, JOINTS.index(f"{side}_elbow")] = (shoulder + path) / 2 - drop
    return Motion(motion.rotations, motion.translation, places, motion.fps)


def hand(*, chest=None, head=None, side="left", motion=None) -> Motion:
    """A standing body whose wrist is at [frames, 3] to the left, up and ahead of the chest's middle or the head."""
    motion = moved() if motion is None else motion
    names = ["head"] if chest is None else ["left_shoulder", "right_shoulder"]
    origin = sum(motion.joints[:, JOINTS.index(name)] for name in names) / len(names)
    left, up, ahead = (head if chest is None else chest).unbind(dim=1)
    return put(motion, **{f"{side}_wrist": origin + torch.stack([left, -ahead, up], dim=1)})


def between(start, end, share: torch.Tensor) -> torch.Tensor:
    """From one place (share 0) to another (share 1)."""
    start, end = torch.tensor(start), torch.tensor(end)
    return start + share[:, None] * (end - start)


def bumps(*times: float, width: float) -> torch.Tensor:
    """1 around the times, 0 elsewhere, smooth."""
    return sum(torch.exp(-(((TIME - time) / width) ** 4)) for time in times)


def still(*place: float) -> torch.Tensor:
    return torch.tensor(place).expand(FRAMES, 3)


def waving(axis: int, rate: float, extent: float, *place: float) -> torch.Tensor:
    path = still(*place).clone()
    path[:, axis] += extent / 2 * torch.sin(2 * math.pi * rate * TIME)
    return path


def walking(speed: float, rate: float = 0.0) -> Motion:
    """Along the heading, which turns to the left by `rate` radians a second."""
    heading = rate * TIME
    steps = speed / FPS * torch.stack([torch.sin(heading), -torch.cos(heading), torch.zeros(FRAMES)], dim=1)
    return moved(path=steps.cumsum(dim=0), heading=heading)


def jumping(left: float, ahead: float) -> Motion:
    """Once, at 2 s, both feet together."""
    phase = ((TIME - 2) / 0.4).clamp(0, 1)
    path = torch.stack([left * phase, -ahead * phase, torch.zeros(FRAMES)], dim=1)
    return moved(height=TALL + 0.25 * torch.sin(math.pi * phase), path=path)


def half_turn(pivot: str) -> Motion:
    """To the left by 180 degrees in a second and a half about the ball of one foot."""
    heading = math.pi * ((TIME - 2) / 1.5).clamp(0, 1)
    motion = moved(heading=heading)
    ball = motion.joints[:, JOINTS.index(f"{pivot}_foot")] * torch.tensor([1.0, 1.0, 0.0])
    return moved(heading=heading, path=ball[:1] - ball)


def kicking(height: float) -> Motion:
    motion = moved()
    ankle, foot = (motion.joints[:, JOINTS.index(f"left_{name}")] for name in ("ankle", "foot"))
    away = bumps(2.0, width=0.25)[:, None] * torch.tensor([0.0, -0.8, height - float(ankle[0, 2])])
    return put(motion, left_ankle=ankle + away, left_foot=foot + away)


GUARD, PLATE, BITE = (0.08, 0.0, 0.2), (0.1, -0.5, 0.2), (0.05, -0.04, 0.18)
LEFT = {
    "walk in a circle counterclockwise": lambda: walking(1.1, math.radians(60)),
    "walk in a quarter circle to the left": lambda: walking(0.8, math.radians(15)),
    "turn 180 degrees to the left on the left foot": lambda: half_turn("left"),
    "turn 180 degrees to the left on the right foot": lambda: half_turn("right"),
    "turn left": lambda: walking(0.1, math.radians(15)),
    "hop to the left": lambda: jumping(0.4, 0.0),
    "low kick with the left foot": lambda: kicking(0.45),
    "high kick with the left foot": lambda: kicking(1.0),
    "raise the left arm": lambda: moved(left_shoulder=("z", -1.3 + 2.4 * bumps(3.0, width=1.0))),
    "wave with the left hand": lambda: hand(chest=waving(0, 1.0, 0.3, 0.3, 0.25, 0.2)),
    "talk on phone with left hand": lambda: hand(head=between(PLATE, (0.16, 0.02, 0.06), (TIME - 1).clamp(0, 1))),
    "point with his left hand": lambda: moved(left_shoulder=("y", -1.4 * torch.ones(FRAMES))),
    "drink with the left arm": lambda: hand(
        head=between(PLATE, BITE, bumps(3.0, width=0.9)), motion=moved(head=("x", -0.3 * bumps(3.0, width=0.6)))
    ),
    "eat something with the left arm": lambda: hand(head=between(PLATE, BITE, bumps(1.5, 3.0, 4.5, width=0.4))),
    "look left": lambda: moved(head=("y", 0.9 * bumps(3.0, width=0.9))),
    "throw something with left hand": lambda: hand(
        chest=between((0.3, 0.1, -0.12), (0.1, 0.1, 0.42), ((TIME - 2) / 0.2).clamp(0, 1))
        + between((0.0, 0.0, 0.0), (0.0, -0.45, -0.3), ((TIME - 2.3) / 0.5).clamp(0, 1))
    ),
    "pick something with the left hand": lambda: put(
        moved(), left_wrist=between((0.2, -0.3, 0.8), (0.2, -0.3, 0.15), bumps(3.0, width=1.0))
    ),
    "punch with the left hand": lambda: hand(chest=between(GUARD, (0.05, 0.0, 0.46), bumps(2.0, 4.0, width=0.15))),
    "touches back of head with left hand": lambda: hand(
        head=between(PLATE, (0.1, 0.05, -0.1), (TIME - 1).clamp(0, 1))
    ),
    "wipe with the left hand": lambda: hand(chest=waving(0, 0.8, 0.3, 0.1, -0.2, 0.35)),
}  # fmt: skip


def two_hands(left: torch.Tensor, right: torch.Tensor) -> Motion:
    return hand(chest=right, side="right", motion=hand(chest=left))


def swinging_a_club() -> Motion:
    angle = math.radians(100) * torch.sin(math.pi * ((TIME - 2) / 0.6).clamp(-0.5, 0.5))
    path = torch.stack([0.5 * torch.sin(angle), -0.5 * torch.cos(angle), torch.full((FRAMES,), 0.3)], dim=1)
    return two_hands(path, path + torch.tensor([-0.06, 0.0, 0.0]))


def lowered(depth: torch.Tensor) -> Motion:
    """Down by so many metres, the feet where they stand."""
    motion, standing = moved(height=TALL - depth), moved()
    feet = [f"{side}_{name}" for side in ("left", "right") for name in ("ankle", "foot")]
    return put(motion, **{name: standing.joints[:, JOINTS.index(name)] for name in feet})


CLAP = 0.09 * (1 - torch.cos(2 * math.pi * 1.5 * TIME))[:, None] * torch.tensor([1.0, 0.0, 0.0])
NECK = still(0.32, -0.16, 0.22)
SYMMETRIC = {
    "walk forwards": lambda: walking(1.2),
    "slowly walk forwards": lambda: walking(0.5),
    "quickly walk forwards": lambda: walking(1.8),
    "walk backwards": lambda: walking(-0.7),
    "slowly walk backwards": lambda: walking(-0.3),
    "quickly walk backwards": lambda: walking(-1.3),
    "run": lambda: walking(3.0),
    "perform a squat": lambda: lowered(0.45 * bumps(3.0, width=0.8)),
    "sit down": lambda: lowered(0.4 * (TIME - 2).clamp(0, 1)),
    "jump forward": lambda: jumping(0.0, 0.6),
    "jump backward": lambda: jumping(0.0, -0.5),
    "bow": lambda: moved(spine1=("x", 0.8 * bumps(3.0, width=1.0))),
    "dodge a hit to his head": lambda: moved(spine1=("z", -0.5 * bumps(3.0, width=0.5))),
    "applause": lambda: two_hands(still(0.05, -0.1, 0.27) + CLAP, still(-0.05, -0.1, 0.27) - CLAP),
    "play the guitar": lambda: two_hands(NECK, waving(1, 1.8, 0.06, -0.03, -0.25, 0.21)),
    "play golf": swinging_a_club,
    "play the violin": lambda: two_hands(
        still(0.27, 0.0, 0.28), between((0.03, -0.02, 0.22), (-0.2, -0.06, 0.35), 0.5 + 0.5 * torch.sin(4 * TIME))
    ),
}  # fmt: skip


@pytest.mark.parametrize("text", LEFT)
def test_a_motion_shows_its_text_and_its_mirror_image_the_other_sides_alone(text):
    motion, other = LEFT[text](), mirror_words(text)
    assert MTT_CHECKS[text].shows(motion) and not MTT_CHECKS[text].shows(motion.mirrored())
    if other in MTT_CHECKS:  # the half turns to the right are none of MTT's texts
        assert MTT_CHECKS[other].shows(motion.mirrored()) and not MTT_CHECKS[other].shows(motion)


@pytest.mark.parametrize("text", SYMMETRIC)
def test_a_motion_without_a_side_and_its_mirror_image_show_its_text(text):
    assert MTT_CHECKS[text].shows(SYMMETRIC[text]())
    if text not in ("play the guitar", "play the violin"):  # for right-handed players alone
        assert MTT_CHECKS[text].shows(SYMMETRIC[text]().mirrored())


@pytest.mark.parametrize("text", MTT_CHECKS)
def test_standing_still_shows_nothing(text):
    assert not MTT_CHECKS[text].shows(moved())


@pytest.mark.parametrize("text", SYMMETRIC | LEFT)
def test_a_motion_shows_no_text_that_means_something_else(text):
    motion = (SYMMETRIC | LEFT)[text]()
    shown = {other for other in MTT_CHECKS if MTT_CHECKS[other].shows(motion)}
    assert shown - same_meaning(text) == set()


def test_every_text_of_the_table_stands_for_its_sides_and_its_actions_have_contents():
    assert len(MTT_CHECKS) == 60
    for text, check in MTT_CHECKS.items():
        assert mirror_words(mirror_words(text)) == text
        assert set(check.meant) <= set(MTT_CHECKS), text
    recorded = {action for check in MTT_CHECKS.values() for action in check.actions}
    assert {"walk", "bow", "wave-left-hand", "wave-right-hand", "jumping-jack"} <= recorded & set(CONTENTS)


def test_a_guitar_that_is_held_still_and_hands_that_are_held_together_are_no_music():
    assert not MTT_CHECKS["play the guitar"].shows(two_hands(NECK, still(-0.03, -0.25, 0.21)))
    assert not MTT_CHECKS["applause"].shows(two_hands(still(0.06, -0.1, 0.27), still(-0.06, -0.1, 0.27)))
    assert not MTT_CHECKS["play the violin"].shows(two_hands(still(0.27, 0.0, 0.28), still(-0.1, -0.04, 0.3)))


def test_a_half_turn_that_goes_on_slides_or_turns_about_the_other_foot_is_none():
    text = "turn 180 degrees to the left on the left foot"
    for wrong in (half_turn("right"), walking(0.3, math.radians(30)), walking(0.3, math.radians(48))):
        assert not MTT_CHECKS[text].shows(wrong)


def test_one_bite_is_no_meal_and_a_hand_that_stays_at_the_mouth_does_not_eat():
    eats = MTT_CHECKS["eat something with the left arm"].shows
    assert not eats(hand(head=between(PLATE, BITE, bumps(3.0, width=0.4))))
    assert not eats(hand(head=between(PLATE, BITE, bumps(3.0, width=1.5))))


def test_a_drink_needs_a_head_that_tips_back():
    held = hand(head=between(PLATE, BITE, bumps(3.0, width=0.9)))
    assert not MTT_CHECKS["drink with the left arm"].shows(held)


def test_a_jump_needs_a_landing_and_rest():
    jump = jumping(0.0, 0.6)
    up = int(jump.translation[:, 2].argmax())
    assert MTT_CHECKS["jump forward"].shows(jump)
    assert not MTT_CHECKS["jump forward"].shows(jump.trimmed(0, up + 2))
    goes_on = jump.translation + torch.tensor([0.0, -2.0, 0.0]) * (TIME - 2.3).clamp(min=0)[:, None]
    running = Motion(jump.rotations, goes_on, jump.joints + (goes_on - jump.translation)[:, None], FPS)
    assert not MTT_CHECKS["jump forward"].shows(running)


@given(degrees=st.integers(-720, 720))
def test_a_turn_is_counted_in_full_and_looking_to_the_right_is_no_look_to_the_left(degrees):
    motion = moved(heading=math.radians(degrees) * TIME / TIME[-1])
    assert math.degrees(float(heading_change(motion)[-1])) == pytest.approx(degrees, abs=0.1)
    assert math.degrees(float(head_turn_left(motion)[-1])) == pytest.approx(max(0, degrees), abs=0.1)


def test_measures_are_what_their_names_say():
    near = torch.tensor([0, 1, 1, 0, 1, 1, 0, 0, 0, 1], dtype=torch.bool)
    assert visits(near, 1, least=2, apart=2) == [(1, 6)]
    assert visits(near, 1, least=1, apart=1) == [(1, 3), (4, 6), (9, 10)]
    assert longest(near, 2) == 1.0 and longest(~near[1:3], 2) == 0.0
    assert reversals(torch.sin(2 * math.pi * TIME), 0.5) == 13  # 6 periods and the last rise
    assert path_length(walking(1.0)) == pytest.approx(6.0, abs=0.06)
    [jump] = jumps_with_both_feet(jumping(0.3, -0.2))
    assert (jump.left, jump.forward) == (pytest.approx(0.3, abs=0.01), pytest.approx(-0.2, abs=0.01))


def test_confusions_are_shares_of_motions():
    shares = confusions({"walk forwards": [walking(1.2), moved()], "bow": [SYMMETRIC["bow"]()]})
    assert shares["walk forwards"] == {"walk forwards": 0.5, "bow": 0.0} and shares["bow"]["bow"] == 1.0


@pytest.mark.data
def test_the_checks_are_those_of_the_published_texts_and_their_draw_makes_the_published_timelines():
    prompts = read_texts(data_file("mtt/texts.txt"))
    assert {prompt.text for prompt in prompts} == set(MTT_CHECKS)
    published = Timeline.read_all(data_file("mtt/MTT.txt"))
    assert [each.prompts for each in sample_published_timelines(prompts)] == [each.prompts for each in published]
