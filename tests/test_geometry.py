"""Rotations near the identity and at a half turn, trees against a slow loop, resampling and mirroring against maths."""

import math

import pytest
import roma
import torch
from conftest import checked, golden, golden_sets
from hypothesis import given
from hypothesis import strategies as st
from torch.testing import assert_close

from stmc.motion import geometry
from stmc.motion.body import MIRROR, NUM_ROTATIONS, PARENTS

AXES = [(1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0), (0.6, -0.8, 0.0), (-0.48, 0.6, 0.64)]
ANGLES = [0.0, 1e-12, 1e-8, 1e-6, 1e-4, 0.1, 1.0, 3.0, math.pi - 1e-4, math.pi - 1e-7, math.pi]
DTYPES = [torch.float32, torch.float64]
TOLERANCE = {torch.float32: 2e-6, torch.float64: 1e-12}


def around(axis, angle, dtype=torch.float64):
    return torch.tensor(axis, dtype=dtype) * angle


def random_rotations(*shape, seed=0, dtype=torch.float64, size=1.0):
    generator = torch.Generator().manual_seed(seed)
    return geometry.axis_angle_to_matrix(size * torch.randn(*shape, 3, generator=generator, dtype=dtype))


def angle_between(first, second):
    return geometry.matrix_to_axis_angle(first.mT @ second).norm(dim=-1)


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("angle", ANGLES)
@pytest.mark.parametrize("axis", AXES)
def test_every_form_of_a_rotation_gives_the_same_matrix_back(axis, angle, dtype):
    matrix = geometry.axis_angle_to_matrix(around(axis, angle, dtype))
    limit = {"atol": TOLERANCE[dtype], "rtol": 0.0}
    assert_close(matrix @ matrix.mT, torch.eye(3, dtype=dtype), **limit)
    assert_close(torch.linalg.det(matrix), torch.ones((), dtype=dtype), **limit)
    assert_close(geometry.axis_angle_to_matrix(geometry.matrix_to_axis_angle(matrix)), matrix, **limit)
    assert_close(geometry.quaternion_to_matrix(geometry.matrix_to_quaternion(matrix)), matrix, **limit)
    assert_close(geometry.rows_to_matrix(geometry.matrix_to_rows(matrix)), matrix, **limit)


@pytest.mark.parametrize("angle", [1e-7, 1e-4, 1.0, math.pi - 1e-6])
@pytest.mark.parametrize("axis", AXES)
def test_axis_and_angle_come_back_up_to_a_half_turn(axis, angle):
    vector = around(axis, angle)
    back = geometry.matrix_to_axis_angle(geometry.axis_angle_to_matrix(vector))
    assert_close(back, vector, atol=1e-9, rtol=0)


def test_a_rotation_turns_column_vectors_counter_clockwise():
    quarter = geometry.axis_angle_to_matrix(torch.tensor([0.0, 0.0, math.pi / 2], dtype=torch.float64))
    assert_close(quarter @ torch.tensor([1.0, 0, 0]).double(), torch.tensor([0, 1.0, 0]).double())
    assert_close(geometry.rotation_z(torch.tensor(math.pi / 2, dtype=torch.float64)), quarter)


def test_quaternions_have_their_real_part_first_and_never_negative():
    half = math.sqrt(0.5)
    quarter = geometry.matrix_to_quaternion(geometry.rotation_z(torch.tensor(math.pi / 2)))
    assert_close(quarter, torch.tensor([half, 0.0, 0.0, half]))
    assert (geometry.matrix_to_quaternion(random_rotations(200, size=3.0))[:, 0] >= 0).all()


@given(z=st.floats(-3.1, 3.1), y=st.floats(-1.5, 1.5), x=st.floats(-3.1, 3.1))
def test_the_heading_is_the_first_of_the_zyx_angles(z, y, x):
    angles = torch.tensor([z, y, x], dtype=torch.float64)
    matrix = roma.euler_to_rotmat("ZYX", angles)
    assert_close(geometry.heading(matrix), angles[0], atol=1e-10, rtol=0)


@given(turn=st.floats(-10, 10), seed=st.integers(0, 1000))
def test_turning_about_the_up_axis_adds_to_the_heading(turn, seed):
    matrix, turn = random_rotations(seed=seed), torch.tensor(turn, dtype=torch.float64)
    turned = geometry.heading(geometry.rotation_z(turn) @ matrix)
    assert_close(geometry.wrap(turned - geometry.heading(matrix) - turn), torch.zeros((), dtype=torch.float64))


@given(angle=st.floats(-50, 50))
def test_wrapped_angles_lie_within_half_a_turn_and_point_the_same_way(angle):
    wrapped = geometry.wrap(torch.tensor(angle, dtype=torch.float64))
    assert -math.pi <= wrapped <= math.pi
    assert math.isclose(math.cos(wrapped), math.cos(angle), abs_tol=1e-9)
    assert math.isclose(math.sin(wrapped), math.sin(angle), abs_tol=1e-9)


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize(
    "rows", [[0] * 6, [1, 0, 0, 1, 0, 0], [0, 0, 1, 0, 0, -2], [0, 0, 0, 0, 1, 0], [1e-30] * 6, [0, 2, 0, 0, 0, 0]]
)
def test_rows_that_no_rotation_has_still_give_a_rotation(rows, dtype):
    matrix = geometry.rows_to_matrix(torch.tensor(rows, dtype=dtype))
    assert_close(matrix @ matrix.mT, torch.eye(3, dtype=dtype))
    assert_close(torch.linalg.det(matrix), torch.ones((), dtype=dtype))


def test_gram_schmidt_keeps_the_first_row_and_the_plane_of_both():
    rows = torch.tensor([0.0, 3.0, 0.0, 1.0, 5.0, 0.0])
    expected = torch.tensor([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
    assert_close(geometry.rows_to_matrix(rows), expected)


def test_blended_rows_are_those_of_the_rotations_that_gram_schmidt_makes_of_each():
    blended = torch.randn(5, 3 * 6, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    rows = geometry.orthonormal_rows(blended)
    for joint in (slice(0, 6), slice(6, 12), slice(12, 18)):
        assert_close(rows[:, joint], geometry.matrix_to_rows(geometry.rows_to_matrix(blended[:, joint])))
    assert_close(geometry.orthonormal_rows(rows), rows)


def test_a_mean_of_frames_is_the_slow_sum_of_raised_cosines():
    values = torch.randn(9, 2, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    weights = [1 + math.cos(math.pi * offset / 3) for offset in (-2, -1, 0, 1, 2)]
    slow = [sum(w * values[frame + k] for k, w in enumerate(weights)) / sum(weights) for frame in range(5)]
    assert_close(geometry.average_frames(values, 2), torch.stack(slow))
    assert_close(geometry.average_frames(values, 0), values)


def test_joints_are_where_a_slow_walk_down_the_tree_finds_them():
    rotations, generator = random_rotations(4, NUM_ROTATIONS), torch.Generator().manual_seed(1)
    offsets = torch.randn(24, 3, generator=generator, dtype=torch.float64)
    found = geometry.forward_kinematics(rotations, offsets, PARENTS)
    turned = geometry.global_rotations(rotations, PARENTS)
    for frame in range(4):
        for joint in range(24):
            position, rotation, at = torch.zeros(3, dtype=torch.float64), torch.eye(3, dtype=torch.float64), joint
            while PARENTS[at] >= 0:
                parent = PARENTS[at]
                position, at = rotations[frame, parent] @ (offsets[at] + position), parent
            at = joint
            while at >= 0:
                rotation = (rotations[frame, at] @ rotation) if at < NUM_ROTATIONS else rotation
                at = PARENTS[at]
            assert_close(found[frame, joint], position)
            assert_close(turned[frame, joint], rotation)


def test_kinematics_of_many_sequences_are_those_of_each():
    rotations, offsets = random_rotations(2, 3, NUM_ROTATIONS), torch.randn(24, 3, dtype=torch.float64)
    both = geometry.forward_kinematics(rotations, offsets, PARENTS)
    assert both.shape == (2, 3, 24, 3)
    assert_close(both[1], geometry.forward_kinematics(rotations[1], offsets, PARENTS))


def test_both_frame_rates_cover_the_same_time():
    positions = geometry.sampling_positions(121, 120, 20)
    assert_close(positions, 2.5 + 6 * torch.arange(20, dtype=torch.float64))
    assert_close(geometry.sampling_positions(9, 30, 30), torch.arange(9, dtype=torch.float64))
    assert geometry.sampling_positions(3, 10, 30).tolist() == pytest.approx(
        [0, 0, 1 / 3, 2 / 3, 1, 4 / 3, 5 / 3, 2, 2], abs=1e-12
    )


def test_too_few_frames_for_one_new_frame_are_an_error_that_says_so():
    with pytest.raises(ValueError, match="1 frames at 30 fps are too short for one frame at 20 fps"):
        geometry.sampling_positions(1, 30, 20)


@given(speed=st.floats(-0.2, 0.2), old=st.sampled_from([30, 60, 120, 25.0]), seed=st.integers(0, 100))
def test_a_steady_turn_stays_steady_at_another_frame_rate(speed, old, seed):
    axis = torch.nn.functional.normalize(torch.randn(3, generator=torch.Generator().manual_seed(seed)).double(), dim=-1)
    turn = geometry.axis_angle_to_matrix(axis * speed * torch.arange(40, dtype=torch.float64)[:, None])[:, None]
    expected = axis * speed * geometry.sampling_positions(40, old, 20)[:, None]
    resampled = geometry.resample_rotations(turn, old, 20)[:, 0]
    assert_close(resampled, geometry.axis_angle_to_matrix(expected), atol=1e-9, rtol=0)


def test_resampled_rotations_take_the_shortest_arc_in_proportion():
    rotations = random_rotations(30, 5, size=2.0)
    positions = geometry.sampling_positions(30, 30, 20)
    before, share = positions.floor().long(), (positions - positions.floor())[:, None]
    resampled = geometry.resample_rotations(rotations, 30, 20)
    whole = angle_between(rotations[before], rotations[before + 1])
    assert_close(angle_between(rotations[before], resampled), share * whole, atol=1e-7, rtol=0)
    assert_close(angle_between(resampled, rotations[before + 1]), (1 - share) * whole, atol=1e-7, rtol=0)


def test_mirroring_twice_changes_nothing_and_once_swaps_the_sides():
    rotations, positions = random_rotations(3, NUM_ROTATIONS), torch.randn(3, 24, 3, dtype=torch.float64)
    order = MIRROR[:NUM_ROTATIONS]
    assert_close(geometry.mirror_rotations(geometry.mirror_rotations(rotations, order), order), rotations)
    assert_close(geometry.mirror_positions(geometry.mirror_positions(positions, MIRROR), MIRROR), positions)
    expected = positions[:, MIRROR.index(20)] * torch.tensor([-1.0, 1.0, 1.0])
    assert_close(geometry.mirror_positions(positions, MIRROR)[:, 20], expected)


def test_mirrored_rotations_pose_the_mirror_image_of_a_symmetric_skeleton():
    offsets = torch.randn(24, 3, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    offsets = (offsets + geometry.mirror_positions(offsets, MIRROR)) / 2
    rotations = random_rotations(6, NUM_ROTATIONS)
    posed = geometry.forward_kinematics(rotations, offsets, PARENTS)
    mirrored = geometry.forward_kinematics(
        geometry.mirror_rotations(rotations, MIRROR[:NUM_ROTATIONS]), offsets, PARENTS
    )
    assert_close(mirrored, geometry.mirror_positions(posed, MIRROR))


@pytest.mark.parametrize("dtype", DTYPES)
def test_results_have_the_dtype_of_the_arguments(dtype):
    rotations = random_rotations(6, NUM_ROTATIONS, dtype=dtype)
    results = [
        geometry.matrix_to_quaternion(rotations),
        geometry.rows_to_matrix(geometry.matrix_to_rows(rotations)),
        geometry.resample_rotations(rotations, 30, 20),
        geometry.resample_positions(rotations[..., 0], 30, 20),
        geometry.mirror_rotations(rotations, MIRROR[:NUM_ROTATIONS]),
        geometry.forward_kinematics(rotations, torch.ones(24, 3, dtype=dtype), PARENTS),
    ]
    assert {result.dtype for result in results} == {dtype}


def rotation_conversions_agree_with_the_published_ones(folder):
    data = {name: torch.from_numpy(value) for name, value in golden(folder, "smplrifke.npz").items() if value.ndim}
    matrix, limit = data["geo_matrix"], {"atol": 1e-7, "rtol": 0.0}
    assert_close(geometry.axis_angle_to_matrix(data["geo_aa"]), matrix, **limit)
    assert_close(geometry.quaternion_to_matrix(data["geo_quat"]), matrix, **limit)
    assert_close(geometry.axis_angle_to_matrix(data["geo_aa_back"]), matrix, **limit)
    assert_close(geometry.matrix_to_rows(matrix), data["geo_6d"], **limit)
    assert_close(geometry.rows_to_matrix(data["geo_6d_in"]), data["geo_6d_matrix"], **limit)
    # At a half turn both signs mean the same rotation: only elsewhere is there one vector to agree on.
    unique = geometry.matrix_to_axis_angle(matrix).norm(dim=-1) < math.pi - 1e-5
    assert unique.sum() > 30
    assert_close(geometry.matrix_to_axis_angle(matrix)[unique], data["geo_aa_back"][unique], **limit)
    sign = torch.where(data["geo_quat"][:, :1] < 0, -1, 1)
    assert_close(geometry.matrix_to_quaternion(matrix)[unique], (sign * data["geo_quat"])[unique], **limit)


def amass_cases(folder):
    data = golden(folder, "amass_prepare.npz")
    for case, fps in enumerate(data["old_fps"]):
        prefix = f"c{case}_"
        arrays = {name.removeprefix(prefix): data[name] for name in data if name.startswith(prefix)}
        yield float(fps), {name: torch.from_numpy(value).double() for name, value in arrays.items()}


def resampling_takes_the_published_moments_and_straight_lines(folder):
    for fps, case in amass_cases(folder):
        assert_close(geometry.sampling_positions(len(case["trans"]), fps, 20), case["index"], atol=1e-5, rtol=0)
        for name in {"trans", "joints"} & case.keys():
            assert_close(geometry.resample_positions(case[name], fps, 20), case[f"out_{name}"], atol=1e-5, rtol=0)


def resampled_rotations_equal_the_published_ones_where_nothing_is_interpolated(folder):
    seen = 0
    for fps, case in amass_cases(folder):
        ours = geometry.resample_rotations(rotations_of(case["poses"]), fps, 20)
        whole = case["index"] == case["index"].floor()
        seen += int(whole.sum())
        assert_close(ours[whole], rotations_of(case["out_poses"])[whole], atol=1e-6, rtol=0)
    assert seen > 20


def between_two_frames_rotations_stay_between_them_also_where_the_published_ones_leave_r10(folder):
    strays = 0
    for fps, case in amass_cases(folder):
        before, share = case["index"].floor().long(), (case["index"] - case["index"].floor())[:, None]
        after = (before + 1).clamp(max=len(case["poses"]) - 1)
        given, published = rotations_of(case["poses"]), rotations_of(case["out_poses"])
        whole = angle_between(given[before], given[after])
        arc = angle_between(given[before], geometry.resample_rotations(given, fps, 20))
        assert_close(arc, share * whole, atol=1e-5, rtol=0)
        detour = angle_between(given[before], published) + angle_between(published, given[after]) - whole
        strays += int((detour > 0.1).sum())
    assert strays > 0


@pytest.mark.golden
@pytest.mark.parametrize("folder", golden_sets("stmc"))
def test_resampling_is_the_published_one_but_for_r10(folder, subtests):
    checked(
        subtests,
        [
            resampling_takes_the_published_moments_and_straight_lines,
            resampled_rotations_equal_the_published_ones_where_nothing_is_interpolated,
            between_two_frames_rotations_stay_between_them_also_where_the_published_ones_leave_r10,
        ],
        folder,
    )


def rotations_of(poses):
    return geometry.axis_angle_to_matrix(poses.reshape(-1, NUM_ROTATIONS, 3))


def mirroring_agrees_with_the_published_one(folder):
    data = golden(folder, "amass_prepare.npz")
    assert data["mirror_joint_perm"].tolist() == list(MIRROR[:NUM_ROTATIONS])
    poses, expected = (rotations_of(torch.from_numpy(data[name])) for name in ("mirror_poses", "mirror_out_poses"))
    assert_close(geometry.mirror_rotations(poses, MIRROR[:NUM_ROTATIONS]), expected, atol=1e-12, rtol=0)
    trans, expected = (torch.from_numpy(data[name])[:, None] for name in ("mirror_trans", "mirror_out_trans"))
    assert_close(geometry.mirror_positions(trans, [0]), expected, atol=1e-12, rtol=0)


@pytest.mark.golden
@pytest.mark.parametrize("folder", golden_sets("stmc"))
def test_rotations_and_mirror_images_are_the_published_ones(folder, subtests):
    checked(
        subtests,
        [
            rotation_conversions_agree_with_the_published_ones,
            mirroring_agrees_with_the_published_one,
        ],
        folder,
    )
