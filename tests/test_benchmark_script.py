"""`stmc benchmark`: how often poses are denoised, counted by hand."""

import pytest
from helpers.scripts import loaded
from test_methods import flow as flow

from stmc.timeline import Timeline

TWO = [Timeline.parse("walk # 0 # 2\nsit down # 2 # 4")]
"""Two crops of 45 frames where they overlap by half a second, and 10 frames without a text between them."""


@pytest.mark.parametrize(
    ("method", "frames"),
    [
        ("flow_mdm", 2 * 80),  # with its texts and without, each frame once
        ("sinc", 2 * 80),
        ("stmc_paper", 2 * 90 + 10),
        ("multi_diffusion", 2 * 90),
        ("double_take", 2 * 90 + 0.9 * 80),  # nine steps of ten again, without a text
    ],
)
def test_poses_are_counted_as_often_as_they_are_denoised(flow, method, frames):
    counted = loaded("benchmark").poses_denoised(flow, TWO, method, steps=10)
    assert counted == pytest.approx(frames / 80)
