"""Measures against closed forms: what they say of motions and latents about which everything is known."""

import math

import pytest
import torch
from helpers.motions import walking
from hypothesis import given
from hypothesis import strategies as st

from stmc.evaluation.metrics import matching_metrics as matching
from stmc.evaluation.metrics import realism, retrieval, smoothness
from stmc.evaluation.metrics import timeline_metrics as timelines
from stmc.evaluation.metrics.plausibility import ImplausibleMotion, check_joints
from stmc.motion.body import MIRROR
from stmc.motion.motion import Motion
from stmc.motion.representation.humanml3d import y_up


def normal(rows: int, width: int, seed: int = 0) -> torch.Tensor:
    return torch.randn(rows, width, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def with_moments(mean: torch.Tensor, covariance: torch.Tensor, rows: int = 50, seed: int = 0) -> torch.Tensor:
    """Latents that have this very mean and covariance."""
    values = normal(rows, len(mean), seed)
    values = values - values.mean(dim=0)
    own = torch.linalg.cholesky(torch.cov(values.T))
    return values @ torch.linalg.inv(own).T @ torch.linalg.cholesky(covariance).T + mean


def test_the_distance_of_two_normal_distributions_is_that_of_the_closed_form():
    deviations = torch.tensor([[1.0, 2.0, 0.5], [3.0, 2.0, 0.1]], dtype=torch.float64)
    means = torch.tensor([[0.0, 1.0, 2.0], [1.0, 1.0, 0.0]], dtype=torch.float64)
    first, second = (
        with_moments(mean, (deviation**2).diag(), seed=seed)
        for seed, (mean, deviation) in enumerate(zip(means, deviations, strict=True))
    )
    expected = (means[0] - means[1]).square().sum() + (deviations[0] - deviations[1]).square().sum()
    assert realism.frechet_distance(first, second) == pytest.approx(float(expected), rel=1e-9)


def test_the_distance_of_covariances_that_do_not_commute_is_that_of_the_roots_eigenvalues():
    covariances = [normal(4, 4, seed) @ normal(4, 4, seed).T + torch.eye(4) for seed in (1, 2)]
    zero = torch.zeros(4, dtype=torch.float64)
    first, second = (with_moments(zero, each, seed=seed) for seed, each in enumerate(covariances))
    eigenvalues = torch.linalg.eigvals(covariances[0] @ covariances[1]).real
    expected = covariances[0].trace() + covariances[1].trace() - 2 * eigenvalues.sqrt().sum()
    assert realism.frechet_distance(first, second) == pytest.approx(float(expected), rel=1e-9)


@given(st.integers(2, 6), st.integers(2, 6), st.integers(1, 8), st.integers(0, 5))
def test_a_distance_is_symmetric_and_not_negative_also_for_less_latents_than_dimensions(first, second, width, seed):
    one, other = normal(first, width, seed), normal(second, width, seed + 1)
    distance = realism.frechet_distance(one, other)
    assert distance >= 0
    assert distance == pytest.approx(realism.frechet_distance(other, one), abs=1e-9)
    assert realism.frechet_distance(one, one) == pytest.approx(0, abs=1e-9)
    moved = realism.frechet_distance(one, one + 3.0)
    assert moved == pytest.approx(9.0 * width)


def test_fid_does_not_know_how_long_latents_are():
    one, other = normal(20, 5, 0), normal(30, 5, 1)
    assert realism.fid(one * 7, other) == pytest.approx(realism.fid(one, other))


@pytest.mark.parametrize("bad", [torch.zeros(1, 3), torch.full((4, 3), torch.nan)])
def test_a_distribution_that_has_no_covariance_is_an_error(bad):
    with pytest.raises(ValueError, match="at least 2 finite latents"):
        realism.frechet_distance(bad, torch.zeros(4, 3))


def test_crops_lie_within_motions_and_reach_every_place():
    starts = realism.crop_starts([100, 103, 40] * 200, 100, seed=0)
    assert {len(each) for each in starts} == {5}
    assert {start for each in starts[0::3] for start in each} == {0}
    assert {start for each in starts[1::3] for start in each} == {0, 1, 2, 3}
    assert {start for each in starts[2::3] for start in each} == {0}
    assert realism.crop_starts([300], 100, seed=0) == realism.crop_starts([300], 100, seed=0)
    assert realism.crop_starts([300], 100, seed=0) != realism.crop_starts([300], 100, seed=1)


def test_ranks_count_what_is_better_and_half_of_what_is_as_good():
    table = torch.tensor([[0.5, 0.9, 0.1], [0.3, 0.3, 0.3], [0.1, 0.2, 0.3]])
    assert retrieval.ranks(table).tolist() == [1.0, 1.0, 0.0]
    first, second = retrieval.t2m_m2t(table)
    assert first.recall[1] == pytest.approx(100 / 3) and first.recall[2] == 100 and first.median_rank == 2
    assert second.recall[1] == pytest.approx(200 / 3)  # half a candidate is in the way of the third


def test_any_of_several_right_answers_counts_and_none_of_them_is_in_the_way():
    table = torch.tensor([[0.5, 0.9, 0.9], [0.5, 0.5, 0.1], [0.0, 0.0, 0.0]])
    right = torch.tensor([[True, True, True], [True, True, False], [False, False, True]])
    assert retrieval.ranks(table, right).tolist() == [0.0, 0.0, 1.0]


@pytest.mark.parametrize(
    ("table", "right", "message"),
    [
        (torch.zeros(2, 3), None, "pass `right`"),
        (torch.zeros(2, 2), torch.tensor([[True, False], [False, False]]), "query 1 has no correct answer"),
        (torch.full((2, 2), torch.nan), None, "4 of 4 scores are NaN"),
    ],
)
def test_retrieval_of_what_cannot_be_ranked_is_an_error(table, right, message):
    with pytest.raises(ValueError, match=message):
        retrieval.ranks(table, right)


@pytest.mark.parametrize("seed", range(3))
def test_random_scores_find_the_right_one_as_often_as_chance(seed):
    table = normal(64, 64, seed)
    found = retrieval.small_batches(table, [f"{i:02d}" for i in range(64)])[0]
    assert found.candidates == 32 and found.recall[10] < 75
    order = torch.randperm(64, generator=torch.Generator().manual_seed(seed))
    names = [f"{i:02d}" for i in range(64)]
    shuffled = retrieval.small_batches(table[order][:, order], [names[i] for i in order])
    assert shuffled == retrieval.small_batches(table, names)


def test_texts_that_say_the_same_are_near_and_every_text_is_near_itself():
    sentences = torch.tensor([[1.0, 0.0], [2.0, 0.1], [0.0, 1.0], [0.0, 0.0]])
    assert retrieval.similar_texts(sentences).int().tolist() == [[1, 1, 0, 0], [1, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]


def test_matching_is_the_distance_of_pairs_and_precision_their_rank_among_32():
    texts = 10 * torch.eye(40)
    assert matching.matching_score(texts, texts + 3 * torch.eye(40)) == pytest.approx(3.0)
    assert matching.r_precision(texts, texts) == (1.0, 1.0, 1.0)
    swapped = texts[[1, 0, *range(2, 40)]]
    assert matching.r_precision(texts, swapped)[0] == pytest.approx(30 / 32)
    with pytest.raises(ValueError, match="31 pairs are fewer than a batch of 32"):
        matching.r_precision(texts[:31], texts[:31])


def test_equal_captions_are_no_wrong_answers_to_each_other():
    texts = 10 * torch.eye(32)
    texts[1] = texts[0]
    motions = texts.clone()
    motions[0] = texts[5] + 0.1
    captions = ["same", "same", *(str(i) for i in range(30))]
    assert matching.r_precision_of_distinct(texts, motions, captions)[0] == pytest.approx(30 / 31)


def test_variety_is_the_mean_distance_of_pairs():
    two = torch.cat([torch.zeros(300, 4), torch.full((300, 4), 1.5)])
    assert matching.embedding_diversity(two, 300) == pytest.approx(1.5, abs=0.2)  # half of all pairs are 3 apart
    assert matching.multimodality(torch.zeros(5, 30, 4)) == 0
    with pytest.raises(ValueError, match="300 pairs without replacement"):
        matching.embedding_diversity(two[:299], 300)


def still(frames: int = 40, joints: int = 22) -> torch.Tensor:
    return normal(1, joints * 3).reshape(1, joints, 3).repeat(frames, 1, 1)


def test_a_jump_of_the_pose_is_measured_where_it_is_and_the_path_of_the_body_is_not():
    path = torch.stack([torch.arange(40.0).double(), torch.zeros(40), torch.zeros(40)], dim=-1)[:, None]
    local = still() + path
    local[20:, 1:] += torch.tensor([0.0, 0.3, 0.4])
    steps = smoothness.pose_steps(local)
    assert steps[19] == pytest.approx(0.5 * 21 / 22)
    assert steps[torch.arange(39) != 19].abs().max() < 1e-9
    assert smoothness.transition_distance([local, still()], [[20], [10, 30]]) == pytest.approx(0.5 * 21 / 22 / 3)


def test_the_published_distance_counts_the_path_of_the_body():
    path = torch.stack([torch.arange(40.0).double(), torch.zeros(40), torch.zeros(40)], dim=-1)[:, None]
    assert smoothness.transition_distance([still() + path], [[20]]) == pytest.approx(0)
    assert smoothness.published_transition_distance([still() + path], [[20]]) == pytest.approx(math.sqrt(2))


@pytest.mark.parametrize(("points", "message"), [([[0]], "0 < point"), ([[40]], "0 < point"), ([[]], "no transition")])
def test_points_that_are_no_transitions_are_errors(points, message):
    with pytest.raises(ValueError, match=message):
        smoothness.transition_distance([still()], points)


def test_transitions_are_every_begin_and_end_within_a_motion():
    spans = [(0, 70), (70, 151), (20, 50)]
    assert smoothness.transition_points(spans, 151) == (20, 50, 70)
    assert smoothness.published_transition_points(spans, 150) == (20, 50)
    assert smoothness.transition_points([(0, 40)], 40) == ()
    assert smoothness.quarter_points(40) == (10, 20, 30)
    assert smoothness.transition_window(100, 60) == (70, 130) and smoothness.transition_window(100, 5) == (98, 103)


def test_constant_acceleration_has_no_jerk_and_a_cubic_path_the_same_everywhere():
    time = torch.arange(30.0, dtype=torch.float64)[:, None, None]
    assert smoothness.jerk(still(30) + 0.5 * time**2).max() < 1e-9
    cubic = still(30) + torch.cat([time**3, -2 * time**3, torch.zeros_like(time)], dim=-1) / 6
    torch.testing.assert_close(smoothness.jerk(cubic), torch.full((27,), 3.0, dtype=torch.float64))
    assert smoothness.jerk(cubic[None], torch.tensor([10]))[0].tolist() == pytest.approx([3.0] * 7 + [0.0] * 20)


def test_peak_and_area_are_read_off_the_mean_curve():
    curve = smoothness.jerk_curve(torch.tensor([[0.0, 4.0, 0.0], [2.0, 0.0, 0.0]]))
    assert smoothness.peak_jerk(curve) == 2.0
    assert smoothness.area_under_jerk(curve, 0.5) == pytest.approx(0.5 + 1.5 + 0.5)


def test_people_who_walk_are_plausible_with_22_joints_and_with_24():
    joints = walking().joints
    check_joints([joints, joints[:, :22].float()])


ORDER = [0, 2, 5, 8, 11, 1, 4, 7, 10, 3, 6, 9, 12, 15, 14, 17, 19, 21, 13, 16, 18, 20, 22, 23]
"""SMPL's joints limb after limb, as HumanML3D's kinematic chains have them."""


@pytest.mark.parametrize(
    ("broken", "message"),
    [
        (lambda joints: y_up(joints), r"y up, not z up.*\(x, -z, y\)"),
        (lambda joints: joints[..., [2, 0, 1]], "x up, not z up"),
        (lambda joints: joints * torch.tensor([1.0, -1.0, -1.0]), "-z up, not z up"),
        (lambda joints: 100 * joints, "suggests centimetres; divide by 100"),
        (lambda joints: 1000 * joints, "suggests millimetres"),
        (lambda joints: 0.1 * joints, "convert to metres"),
        (lambda joints: joints[:, ORDER], "not in SMPL's order"),
        (lambda joints: joints.flip(1), "not in SMPL's order"),
        (lambda joints: joints[:, list(MIRROR)], "left and right are exchanged"),
        (lambda joints: joints * torch.tensor([-1.0, 1.0, 1.0]), "mirrored"),
        (lambda joints: joints[:, :21], "has 21 joints"),
        (lambda joints: joints * torch.nan, "not finite"),
    ],
)
def test_axes_units_orders_and_sides_that_are_wrong_are_named(broken, message):
    with pytest.raises(ImplausibleMotion, match=message):
        check_joints([broken(walking().joints)])


def test_one_who_lies_is_fine_among_others_and_not_alone():
    joints = walking().joints
    lying = torch.stack([joints[..., 0], -joints[..., 2], joints[..., 1]], dim=-1)
    check_joints([joints, joints, joints, joints, lying[:20]])
    with pytest.raises(ImplausibleMotion, match="-y up, not z up"):
        check_joints([lying])
    with pytest.raises(ImplausibleMotion, match="no motion"):
        check_joints([])


class Mean:
    """A judge whose latents are what a motion's root does on average; so crops are told apart by their speed."""

    fps = 20

    def features(self, motion: Motion) -> torch.Tensor:
        return torch.cat([motion.joints[:, 0].diff(dim=0), torch.ones(motion.frames - 1, 1)], dim=-1).float()

    def motions(self, features) -> torch.Tensor:
        return torch.stack([rows.mean(dim=0) for rows in features])


def test_motions_that_show_their_texts_score_full_marks_and_others_do_not():
    judge = Mean()
    speeds = [0.2, 1.5, 4.0, 8.0]
    real = [walking(6.0, 20.0, speed, 0.0) for speed in speeds]
    latents = judge.motions([judge.features(motion) for motion in real])
    truth = timelines.GroundTruth(latents * 2, latents)
    spans = [[(0, 60, number), (60, 120, number)] for number in range(4)]
    right = timelines.timeline_scores(real, spans, judge, truth)
    assert right.semantics.recall_1 == 100 and right.semantics.m2t == pytest.approx(1, abs=1e-3)
    assert right.fid_plus < 1e-2
    assert 0 < right.transition < 10
    wrong = [[(start, end, (number + 2) % 4) for start, end, number in each] for each in spans]
    assert timelines.timeline_scores(real, wrong, judge, truth).semantics.recall_1 == 0
    slow = [motion.resampled(40) for motion in real]
    assert timelines.timeline_scores(slow, spans, judge, truth).semantics.recall_1 == 100


def test_motions_with_a_wrong_axis_have_no_scores():
    motion = walking()
    lying = Motion(motion.rotations, motion.translation, y_up(motion.joints), motion.fps)
    truth = timelines.GroundTruth(torch.eye(4), torch.eye(4))
    for scored in (timelines.timeline_scores, timelines.published_timeline_scores):
        with pytest.raises(ImplausibleMotion, match="y up"):
            scored([lying], [[(0, 50, 0)]], Mean(), truth)
