"""How much a body moves, how still it becomes, and whether it floats: closed forms of made-up motions."""

import pytest
import torch
from helpers.motions import standing_still, walking

from stmc.evaluation.metrics.liveliness import lower_toe_height, motion_energy, rest_energy
from stmc.motion.motion import Motion

FPS = 20.0


def carried(paths: torch.Tensor) -> Motion:
    """A standing body that is carried along a path, [frames, 3], as stiff as it is."""
    still = standing_still(len(paths), FPS)
    return Motion(still.rotations, still.translation + paths, still.joints + paths[:, None], FPS)


def along(speeds: list[float]) -> torch.Tensor:
    """The path ahead at some metres per second from each frame to the next."""
    distances = torch.tensor([0.0, *speeds], dtype=torch.float64).cumsum(dim=0) / FPS
    return distances[:, None] * torch.tensor([0.0, -1.0, 0.0], dtype=torch.float64)


def test_the_energy_of_a_body_that_is_carried_is_the_square_of_its_speed():
    assert motion_energy(carried(along([1.5] * 60))) == pytest.approx(2.25)
    assert motion_energy(standing_still(60)) == motion_energy(standing_still(1)) == 0


def test_a_motion_that_turns_to_stone_has_no_energy_at_rest_and_one_that_goes_on_has():
    moves, freezes = carried(along([1.0] * 80)), carried(along([1.0] * 50 + [0.0] * 20 + [1.0] * 10))
    assert rest_energy(freezes) == 0 < motion_energy(freezes)
    assert rest_energy(moves) == pytest.approx(1.0) == motion_energy(moves)
    shorter = carried(along([1.0, 0.0] * 5))
    assert rest_energy(shorter) == motion_energy(shorter) == pytest.approx(0.5)


def test_a_body_that_is_lifted_floats_by_as_much_and_one_that_jumps_does_not():
    lifted, up = torch.zeros(40, 3, dtype=torch.float64), torch.zeros(40, 3, dtype=torch.float64)
    lifted[:, 2], up[10:20, 2] = 0.05, 0.3
    floor = lower_toe_height(carried(torch.zeros(40, 3, dtype=torch.float64)))
    assert lower_toe_height(carried(lifted)) == pytest.approx(floor + 0.05)
    assert lower_toe_height(carried(up)) == pytest.approx(floor)
    assert lower_toe_height(walking()) < 0.05
