"""Actions told by geometry: made-up motions that show one and no other."""

import math

import pytest
import torch

from stmc.data.sources.contents import CONTENTS
from stmc.evaluation.benchmarks.questions import QUESTIONS, Rates, rates
from stmc.evaluation.metrics.action_measures import cycles, flights, stretches, torsion
from stmc.motion.body import JOINTS, NUM_ROTATIONS
from stmc.motion.body_model import Skeleton
from stmc.motion.geometry import axis_angle_to_matrix, rotation_z
from stmc.motion.motion import Motion

FPS, FRAMES, TALL = 20, 40, 0.9
UP = torch.tensor([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])


def moved(height=None, path=None, heading=None, **turns) -> Motion:
    """Two seconds with arms hanging; rotations are axis-angle vectors [frames, 3] by joint."""
    angles = torch.zeros(FRAMES, NUM_ROTATIONS, 3)
    angles[:, JOINTS.index("left_shoulder"), 2] = -1.3
    angles[:, JOINTS.index("right_shoulder"), 2] = 1.3
    for name, values in turns.items():
        angles[:, JOINTS.index(name)] = values
    rotations = axis_angle_to_matrix(angles)
    heading = torch.zeros(FRAMES) if heading is None else heading
    rotations[:, 0] = rotation_z(heading) @ UP @ rotations[:, 0]
    place = torch.zeros(FRAMES, 3) if path is None else path.clone()
    place[:, 2] = TALL if height is None else height
    return Motion.posed(rotations, place, FPS, Skeleton.default())


def about(axis: str, angle: torch.Tensor | float) -> torch.Tensor:
    angle = torch.as_tensor(angle).expand(FRAMES)
    return angle[:, None] * torch.eye(3)["xyz".index(axis)]


def going(speed: float) -> torch.Tensor:
    path = torch.zeros(FRAMES, 3)
    path[:, 1] = -speed * torch.arange(FRAMES) / FPS
    return path


TIME = torch.linspace(0, 1, FRAMES)
HOP = TALL + 0.3 * torch.sin(math.pi * ((TIME - 0.3) / 0.3).clamp(0, 1))
FOLD = torch.sin(math.pi * TIME)  # up, down and up again
SIT = {"left_hip": about("x", -1.5), "right_hip": about("x", -1.5)}
MOTIONS = {
    "stand": lambda: moved(),
    "sit": lambda: moved(height=0.5, **SIT),
    "sit-down": lambda: moved(height=0.9 - 0.45 * TIME),
    "stand-up": lambda: moved(height=0.45 + 0.45 * TIME),
    "squat": lambda: moved(height=0.9 - 0.45 * FOLD),
    "jump-up": lambda: moved(height=HOP),
    "jump-forward": lambda: moved(height=HOP, path=going(0.5)),
    "jump-over": lambda: moved(height=HOP, path=going(2.0)),
    "turn-around": lambda: moved(heading=math.pi * TIME),
    "run-turn-left": lambda: moved(heading=0.8 * TIME, path=going(2.6)),
    "twist": lambda: moved(spine3=about("y", 0.8 * torch.sin(6 * TIME))),
    "kick": lambda: moved(right_hip=about("x", -1.6 * torch.exp(-(((TIME - 0.5) / 0.06) ** 2)))),
    "arm-circle": lambda: moved(
        left_shoulder=about("z", torch.sin(20 * TIME)), right_shoulder=about("z", -torch.sin(20 * TIME))
    ),
}


@pytest.mark.parametrize("name", MOTIONS)
def test_a_motion_shows_its_action(name):
    assert QUESTIONS[name](MOTIONS[name]())


@pytest.mark.parametrize("name", MOTIONS)
def test_standing_still_is_no_other_action(name):
    assert QUESTIONS[name](MOTIONS["stand"]()) == (name == "stand")


@pytest.mark.parametrize("axis", ["x", "z"])  # forwards and to the side
def test_who_stays_bent_does_not_stand(axis):
    angles = {degrees: QUESTIONS["stand"](moved(spine1=about(axis, math.radians(degrees)))) for degrees in (10, 45)}
    assert angles == {10: True, 45: False}


def test_the_order_of_sitting_and_standing_matters():
    shown = {
        name: [other for other in MOTIONS if QUESTIONS[name](MOTIONS[other]())] for name in ("sit-down", "stand-up")
    }
    assert shown == {"sit-down": ["sit-down"], "stand-up": ["stand-up"]}


def test_a_body_that_stays_in_the_air_has_not_jumped():
    rising = moved(height=TALL + 0.4 * TIME)
    assert flights(rising) and not QUESTIONS["jump-up"](rising)


def test_actions_are_contents_and_both_sides_are_asked_alike():
    assert set(QUESTIONS) <= set(CONTENTS)
    left, right = moved(heading=0.8 * TIME, path=going(2.6)), moved(heading=-0.8 * TIME, path=going(2.6))
    assert QUESTIONS["run-turn-right"](right) and not QUESTIONS["run-turn-right"](left)


def test_rises_are_counted_from_turning_point_to_turning_point():
    assert cycles(torch.tensor([0.0, 1.0, 0.1, 1.0, 0.9, 1.0, 0.0, 0.4]), 0.5) == 2
    assert stretches(torch.tensor([True, False, True, True])) == [(0, 1), (2, 4)]
    assert float(torsion(moved()).abs().max()) < 1e-5


def test_rates_count_every_other_content_alike():
    still, sitting = MOTIONS["stand"](), MOTIONS["sit"]()
    others = {"many": [sitting] * 9, "one": [still]}
    assert rates(QUESTIONS["sit"], [sitting, still], others) == Rates(ceiling=0.5, chance=0.5)
    with pytest.raises(ValueError, match="of the action and of other actions"):
        rates(QUESTIONS["sit"], [], others)
