"""Success by the distance to the training: bins by cosines that are known."""

import math

import pytest
import torch

from stmc.evaluation.benchmarks.novelty import nearest_cosines, success_by_distance


class Angles:
    """A text is its angle, in degrees."""

    name, width = "angles", 2

    def encode(self, texts):
        angles = torch.tensor([math.radians(float(text)) for text in texts])
        return 3 * torch.stack([angles.cos(), angles.sin()], dim=1)[:, None], torch.ones(len(texts), dtype=torch.long)


def test_the_nearest_of_the_training_counts():
    found = nearest_cosines(["10", "50", "90", "10"], ["0", "90", "90"], Angles())
    torch.testing.assert_close(found, torch.tensor([math.cos(math.radians(angle)) for angle in (10, 40, 0, 10)]))


def test_success_is_told_by_distance():
    """Cosines of 10, 30, 40, 60 and 70 degrees: 0.98, 0.87, 0.77, 0.5 and 0.34."""
    shares = {"10": 1.0, "30": 0.75, "40": 0.5, "60": 0.25, "70": 0.0}
    found = success_by_distance(shares, ["0"], Angles())
    assert [(each.name, each.size) for each in found] == [
        ("below 0.7", 2), ("0.7 to 0.8", 1), ("0.8 to 0.9", 1), ("0.9 and more", 1)
    ]  # fmt: skip
    assert [each.success for each in found] == pytest.approx([0.125, 0.5, 0.75, 1.0])
    assert success_by_distance({"0": 1.0}, ["0"], Angles())[0].success is None
