"""Statistics in pieces are those of the whole."""

import pytest
import torch

from stmc.diffusion import statistics
from stmc.diffusion.statistics import Statistics


@pytest.mark.parametrize("at_once", [1, 7, 100])
def test_statistics_do_not_depend_on_how_many_rows_are_summed_at_once(at_once, monkeypatch):
    monkeypatch.setattr(statistics, "_ROWS_AT_ONCE", at_once)
    rows = torch.randn(50, 3, generator=torch.Generator().manual_seed(0)) * torch.tensor([1.0, 0.1, 0.0]) + 100
    found = Statistics.of(rows, floor=1e-3)
    std, mean = torch.std_mean(rows.double(), dim=0, correction=0)
    torch.testing.assert_close(found.mean.double(), mean, rtol=1e-6, atol=0)
    torch.testing.assert_close(found.std[:2].double(), std[:2], rtol=1e-6, atol=0)
    assert found.std[2] == pytest.approx(1e-3)


def test_statistics_of_nothing_are_an_error():
    with pytest.raises(ValueError, match="rows is empty"):
        Statistics.of(torch.zeros(0, 3), floor=1e-3)
