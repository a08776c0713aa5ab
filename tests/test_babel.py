"""The 135 features: parity with the published ones, what they forget, and the way back."""

import math

import pytest
import torch
from conftest import golden, golden_sets
from helpers.motions import walk, walking
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor
from torch.testing import assert_close

from stmc.motion.body import NUM_ROTATIONS, BodyPart
from stmc.motion.body_model import Skeleton
from stmc.motion.geometry import axis_angle_to_matrix
from stmc.motion.motion import Motion
from stmc.motion.representation import BABEL_LAYOUT, BabelRepresentation, Representation
from stmc.motion.representation.babel import _rotate

REPRESENTATION = BabelRepresentation()
SETS = pytest.mark.parametrize("folder", golden_sets("flow"))


def test_it_is_a_representation_with_fields_of_the_paper():
    assert isinstance(REPRESENTATION, Representation)
    starts = {name: field.start for name, field in BABEL_LAYOUT.slices.items()}
    assert starts == {"root_height": 0, "root_velocity": 1, "rotations": 3}
    assert REPRESENTATION.width == BABEL_LAYOUT.width == 3 + 6 * NUM_ROTATIONS == 135
    assert sorted(column for own in REPRESENTATION.columns.values() for column in own) == list(range(135))
    assert REPRESENTATION.columns[BodyPart.LEGS][:9] == tuple(range(9))


def test_a_body_that_walks_straight_has_the_numbers_that_one_expects():
    """At heading zero, upright: the root is turned by a quarter about x alone, so that its vector has no z."""
    upright = axis_angle_to_matrix(torch.tensor([math.pi / 2, 0, 0], dtype=torch.float64))
    rotations = torch.eye(3, dtype=torch.float64).repeat(4, NUM_ROTATIONS, 1, 1)
    rotations[:, 0] = upright
    translation = torch.tensor([[0.0, -0.1 * frame, 0.9] for frame in range(4)], dtype=torch.float64)
    motion = Motion.posed(rotations, translation, 20, Skeleton.default())
    features = REPRESENTATION.encode(motion)
    assert_close(features[:, 0], torch.full((4,), 0.9, dtype=torch.float64))
    # Turned by a quarter to the right, so that -y becomes -x; the first frame has no step.
    expected = torch.tensor([[0.0, 0.0]] + [[-0.1, 0.0]] * 3, dtype=torch.float64)
    assert_close(features[:, 1:3], expected, atol=1e-12, rtol=0)
    assert_close(features[0, 3:9], torch.tensor([0.0, 0, -1, -1, 0, 0], dtype=torch.float64), atol=1e-12, rtol=0)
    assert_close(features[0, 9:15], torch.tensor([1.0, 0, 0, 0, 1, 0], dtype=torch.float64), atol=1e-12, rtol=0)


def placed(motion: Motion, heading: float) -> Motion:
    """The same with its first pelvis above the origin and its first heading as told."""
    centre = motion.translation[0] * motion.translation.new_tensor([1, 1, 0])
    rotations, translation = motion.rotations, motion.translation - centre
    rotations, translation = _rotate(rotations, translation, heading - motion.heading[0])
    return Motion.posed(rotations, translation, motion.fps, Skeleton.default())


@settings(max_examples=30)
@given(st.floats(-3, 3), st.floats(-3, 3), st.floats(-5, 5))
def test_a_motion_comes_back_wherever_it_stood_and_looked(turn, heading, shift):
    motion = walking(1.0)
    rotations, translation = _rotate(motion.rotations, motion.translation + shift, torch.tensor(turn).double())
    translation = translation - translation.new_tensor([0, 0, shift])
    moved = Motion.posed(rotations, translation, motion.fps, Skeleton.default())
    back = REPRESENTATION.decode(REPRESENTATION.encode(moved), motion.fps, heading=heading)
    expected = placed(motion, heading)
    assert_close(back.rotations, expected.rotations, atol=1e-6, rtol=0)
    assert_close(back.joints, expected.joints.to(back.joints), atol=1e-5, rtol=0)


def test_features_do_not_know_where_the_body_stands():
    motion = walking(1.0)
    away = Motion(motion.rotations, motion.translation + torch.tensor([3.0, -2.0, 0.0]).double(), motion.joints, 20.0)
    assert_close(REPRESENTATION.encode(away), REPRESENTATION.encode(motion), atol=1e-12, rtol=0)


def test_differentiating_and_integrating_undo_each_other():
    features = REPRESENTATION.differentiate(*REPRESENTATION.integrate(REPRESENTATION.encode(walking(1.0))))
    assert_close(features, REPRESENTATION.encode(walking(1.0)), atol=1e-12, rtol=0)


@settings(max_examples=50)
@given(st.integers(1, 6), st.floats(0, 30), st.integers(0, 2**31))
def test_any_finite_features_decode(frames, size, seed):
    features = size * torch.randn(frames, 135, generator=torch.Generator().manual_seed(seed))
    motion = REPRESENTATION.decode(features, 30, heading=1.0)
    assert motion.frames == frames
    assert_close(motion.translation[0, :2], torch.zeros(2))
    assert abs(float(motion.heading[0]) - 1) < 1e-3 or float(motion.rotations[0, 0, :2, 0].norm()) < 1e-2


def test_features_of_another_width_are_an_error():
    with pytest.raises(ValueError, match="205 columns; this representation needs 135"):
        REPRESENTATION.decode(torch.zeros(3, 205), 20)


def test_a_motion_of_one_frame_has_features():
    assert REPRESENTATION.encode(walk().trimmed(0, 1)).shape == (1, 135)


@pytest.mark.golden
@SETS
def test_features_and_their_inverse_are_the_published_ones(folder):
    data = {name: torch.from_numpy(array) for name, array in golden(folder, "babel_features.npz").items()}
    frames = len(data["trans"])
    rotations = axis_angle_to_matrix(data["axis_angle"].reshape(frames, NUM_ROTATIONS, 3))
    close(rotations, data["rot_matrices"])
    close(REPRESENTATION.differentiate(rotations, data["trans"]), data["features_canon0"])
    motion = Motion.posed(rotations, data["trans"], 30, Skeleton.default())
    close(REPRESENTATION.encode(motion), data["features_canon1"])
    for canonical in (0, 1):
        inverse = REPRESENTATION.integrate(data[f"features_canon{canonical}"])
        for actual, name in zip(inverse, ("inverse_rots", "inverse_trans"), strict=True):
            close(actual, data[f"{name}_canon{canonical}"].reshape(actual.shape))


def close(actual: Tensor, expected: Tensor) -> None:
    assert_close(actual, expected, atol=2e-5 * float(expected.abs().max()), rtol=0)
