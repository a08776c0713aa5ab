"""Padding, masks and positions."""

import math

import pytest
import torch

from stmc.diffusion.tensors import mask, pad, sinusoids


def test_padded_sequences_keep_their_frames_and_end_in_zeros():
    sequences = [torch.ones(3, 2), torch.full((5, 2), 2.0)]
    batch, lengths = pad(sequences)
    assert batch.shape == (2, 5, 2) and lengths.tolist() == [3, 5]
    assert torch.equal(batch[0, :3], sequences[0]) and batch[0, 3:].eq(0).all()
    assert torch.equal(batch[1], sequences[1])


@pytest.mark.parametrize("dtype", [torch.float64, torch.int64])
def test_padding_keeps_the_dtype_and_any_trailing_shape(dtype):
    batch, _ = pad([torch.ones(2, 4, 3, dtype=dtype), torch.ones(1, 4, 3, dtype=dtype)])
    assert batch.shape == (2, 2, 4, 3) and batch.dtype == dtype


def test_an_empty_batch_cannot_be_padded():
    with pytest.raises(ValueError, match="pass at least one"):
        pad([])


def test_a_mask_is_true_where_frames_exist():
    assert mask(torch.tensor([1, 3])).tolist() == [[True, False, False], [True, True, True]]
    assert mask(torch.tensor([1, 0]), 2).tolist() == [[True, False], [False, False]]


def test_positions_are_sines_and_cosines_of_wavelengths_that_grow_along_the_width():
    table = sinusoids(100, 6)
    for place in (0, 1, 37, 99):
        angles = [place / 10000 ** (pair / 3) for pair in range(3)]
        expected = [f(angle) for angle in angles for f in (math.sin, math.cos)]
        torch.testing.assert_close(table[place], torch.tensor(expected), atol=1e-5, rtol=0)
