"""Retrieval, realism, smoothness, matching, and the evaluation of timelines: parity with the published code."""

import re
from dataclasses import dataclass, field

import numpy as np
import pytest
import torch
from conftest import checked, golden, golden_sets
from torch import Tensor

from stmc.evaluation.metrics import matching_metrics as matching
from stmc.evaluation.metrics import realism, retrieval, smoothness
from stmc.evaluation.metrics import timeline_metrics as timelines
from stmc.motion.motion import Motion
from stmc.motion.representation import HumanML3DRepresentation
from stmc.motion.representation.humanml3d import features_to_joints, features_to_local_joints, z_up

pytestmark = pytest.mark.golden

RELATIVE = 2e-5
"""What the README allows what networks and arithmetic give; rank measures are exact."""

GUO = 1e-4
"""What it allows Guo features, and so what is read off them."""


def arrays(folder, name: str) -> dict:
    found = golden(folder, name)
    return {key: torch.from_numpy(value) if value.dtype.kind in "fiub" else value for key, value in found.items()}


def near(value: Tensor | np.ndarray | float, relative: float = RELATIVE):
    return pytest.approx(float(value), rel=relative)


def assert_retrieval(found: tuple[retrieval.Retrieval, retrieval.Retrieval], expected: dict, decimals: int) -> None:
    """The published numbers, which are rounded to 2 decimals where their name does not say "unrounded"."""
    half = 0.5 * 10**-decimals + 1e-9
    for side, result in zip(("t2m", "m2t"), found, strict=True):
        for count, share in result.recall.items():
            assert share == pytest.approx(expected[f"{side}/R{count:02d}"], abs=half, rel=0)
        assert result.median_rank == pytest.approx(expected[f"{side}/MedR"], abs=half, rel=0)
        assert result.candidates == expected[f"{side}/len"]


def retrieval_is_that_of_the_published_code(folder):
    data, expected = arrays(folder, "tmr_retrieval.npz"), golden(folder, "tmr_retrieval.json")
    similar = retrieval.similar_texts(data["sent_emb"], float(data["threshold"]))
    for table, right, suffix in (
        (data["sims"], None, "ranks0"),
        (data["sims"], similar, "ranks0_thr"),
        (data["sims_with_ties"], None, "ranks0_ties"),
    ):
        back = None if right is None else right.T
        assert torch.equal(retrieval.ranks(table, right).double(), data[f"t2m_{suffix}"].double())
        assert torch.equal(retrieval.ranks(table.T, back).double(), data[f"m2t_{suffix}"].double())
    names = [f"{index:06d}" for index in range(len(data["guo_sims"]))]
    found = {
        "normal": retrieval.t2m_m2t(data["sims"]),
        "threshold": retrieval.t2m_m2t(data["sims"], similar),
        "ties": retrieval.t2m_m2t(data["sims_with_ties"]),
        "guo": retrieval.small_batches(data["guo_sims"], names),
    }
    protocols = {name: re.match("[a-z]+", name).group() for name in expected}
    assert set(protocols.values()) == set(found)
    for name, protocol in protocols.items():
        assert_retrieval(found[protocol], expected[name], decimals=9 if name.endswith("_unrounded") else 2)


def the_measures_of_guo_are_those_of_the_published_code(folder):
    data = arrays(folder, "evaluator_metrics.npz")
    text, motion, real = data["text"], data["motion"], data["gt_motion"]
    assert matching.matching_score(text, motion) == near(data["matching_score"])
    assert matching.r_precision(text, motion) == pytest.approx(tuple(data["r_precision_top123"].tolist()), abs=1e-12)
    assert realism.frechet_distance(motion, real) == near(data["fid"])
    assert realism.frechet_distance(motion, motion) == pytest.approx(float(data["fid_self"]), abs=1e-9)
    pairs, seed = len(data["diversity_idx1"]), int(data["diversity_seed"])
    assert matching.embedding_diversity(motion, pairs, seed) == near(data["diversity"])
    pairs, seed = len(data["mm_idx1"]), int(data["mm_seed"])
    assert matching.multimodality(data["mm"], pairs, seed) == near(data["multimodality"])


def r_precision_of_flowmdm_is_that_of_the_published_code(folder):
    data = arrays(folder, "flowmdm_rprecision.npz")
    found = matching.r_precision_of_distinct(data["text"], data["motion"], data["captions"].tolist())
    assert found == pytest.approx(tuple(data["r_precision_top123"].tolist()), abs=1e-12)
    assert matching.matching_score(data["text"], data["motion"]) == near(data["matching_score"])


@pytest.mark.golden
@pytest.mark.parametrize("folder", golden_sets("flow"))
def test_measures_of_embeddings_are_those_of_the_published_code(folder, subtests):
    checked(
        subtests,
        [
            retrieval_is_that_of_the_published_code,
            the_measures_of_guo_are_those_of_the_published_code,
            r_precision_of_flowmdm_is_that_of_the_published_code,
        ],
        folder,
    )


def jerk_is_that_of_the_published_code(folder):
    data = arrays(folder, "jerk.npz")
    windows = [smoothness.transition_window(int(end)) for end in data["hml_lengths"].cumsum(0)[:-1]]
    pieces = torch.stack([features_to_joints(data["hml_features"][start:end]) for start, end in windows])
    for name, joints, average, tolerance in (
        ("babel", data["babel_joints"], smoothness.BABEL_JERK, RELATIVE),
        ("hml", pieces, smoothness.HUMANML3D_JERK, GUO),
    ):
        jerks = smoothness.jerk(joints)
        expected = data[f"{name}_jerk_per_transition"]
        torch.testing.assert_close(jerks, expected, atol=tolerance * float(expected.max()), rtol=0)
        curve = smoothness.jerk_curve(jerks)
        assert average == near(data[f"{name}_javg"])
        assert smoothness.peak_jerk(curve) == near(data[f"{name}_peak_jerk"], tolerance)
        assert smoothness.area_under_jerk(curve, average) == near(data[f"{name}_auj"], tolerance)
    jerks = smoothness.jerk(data["var_joints"], data["var_lengths"])
    torch.testing.assert_close(jerks, data["var_jerk"], atol=RELATIVE * float(data["var_jerk"].max()), rtol=0)


def transition_distances_are_those_of_the_published_code(folder):
    data = arrays(folder, "stmc_transition.npz")
    real = [z_up(features_to_local_joints(data[key])) for key in sorted(data) if key.startswith("feats_")]
    points = [smoothness.quarter_points(len(pose)) for pose in real]
    assert smoothness.transition_distance(real, points) == near(data["gt_transition"], GUO)
    features = HumanML3DRepresentation().encode(bodies(z_up(data["exp_joints"])))
    spans = [tuple(span) for span in data["exp_intervals"].tolist()]
    points = [smoothness.published_transition_points(spans, len(features))]
    pose = z_up(features_to_local_joints(features))
    assert smoothness.published_transition_distance([pose], points) == near(data["exp_transition"], GUO)
    truth = timelines.GroundTruth(data["lat_text"], data["lat_motion"])
    found = timelines.semantics(truth.motions, range(len(truth.texts)), truth)
    assert found.recall_1 / 100 == near(data["gt_m2t_top_1"])
    assert found.recall_3 / 100 == near(data["gt_m2t_top_3"])
    assert found.m2t == near(data["gt_m2t_score"])


@pytest.mark.golden
@pytest.mark.parametrize("folder", golden_sets("flow"))
def test_smoothness_is_that_of_the_published_code(folder, subtests):
    checked(
        subtests,
        [
            jerk_is_that_of_the_published_code,
            transition_distances_are_those_of_the_published_code,
        ],
        folder,
    )


def bodies(joints: Tensor) -> Motion:
    """A motion of these joints, z up; rotations and hands are not looked at."""
    hands = joints[:, 20:22] if joints.shape[1] == 22 else joints[:, 22:]
    rotations = torch.eye(3, dtype=joints.dtype).expand(len(joints), 22, 3, 3)
    return Motion(rotations, joints[:, 0], torch.cat([joints[:, :22], hands], dim=1), 20)


@dataclass
class Stub:
    """The golden numbers' encoder; remembers how many frames it was given."""

    matrix: Tensor
    seen: list[int] = field(default_factory=list)
    fps: int = 20

    def features(self, motion: Motion) -> Tensor:
        return HumanML3DRepresentation().encode(motion)

    def motions(self, features) -> Tensor:
        self.seen += [len(rows) for rows in features]
        return torch.stack([torch.tanh(rows.double().mean(dim=0) @ self.matrix).float() for rows in features])


def the_evaluation_of_timelines_is_that_of_the_published_code(folder, mode):
    data = arrays(folder, "mtt_eval.npz")
    expected = golden(folder, "mtt_eval_expected.json")["end_to_end"]["exp"][mode]
    lengths = golden(folder, "mtt_eval_expected.json")["end_to_end"]["frames_passed_to_encoder"][mode]
    joints = [data[f"exp{index}_joints"] for index in range(len(data["intervals"]))]
    motions = [bodies(each[:, :22] if mode == "yup22" else each) for each in joints]
    spans = [[tuple(span) for span in each.tolist()] for each in data["intervals"]]
    if mode == "only_text":
        spans = [
            [(0, len(motion), number) for _, _, number in each] for motion, each in zip(motions, spans, strict=True)
        ]
    stub = Stub(data["W"])
    truth = timelines.GroundTruth(data["text_latents"], data["gt_motion_latents"])
    found = timelines.published_timeline_scores(motions, spans, stub, truth)
    assert found.fid_plus == near(expected["fid"], GUO)
    assert found.semantics.recall_1 / 100 == near(expected["m2t_top_1"])
    assert found.semantics.recall_3 / 100 == near(expected["m2t_top_3"])
    assert found.semantics.m2t == near(expected["m2t_score"], GUO)
    assert found.semantics.m2m == near(expected["m2m_score"], GUO)
    assert found.transition / 100 == near(expected["transition"], GUO)
    assert sorted(stub.seen) == sorted(frames for calls in lengths for frames in calls)


def the_evaluation_of_the_ground_truth_is_that_of_the_published_code(folder):
    data = arrays(folder, "mtt_eval.npz")
    expected = golden(folder, "mtt_eval_expected.json")["end_to_end"]["gt"]
    motions = [bodies(data[f"gt{index}_joints"]) for index in range(len(data["text_latents"]))]
    stub = Stub(data["W"])
    features = [stub.features(motion) for motion in motions]
    latents = stub.motions(features)
    torch.testing.assert_close(latents, data["gt_motion_latents"], atol=GUO, rtol=0)
    truth = timelines.GroundTruth(data["text_latents"], latents)
    found = timelines.semantics(latents, range(len(latents)), truth)
    assert found.recall_1 / 100 == near(expected["m2t_top_1"])
    assert found.recall_3 / 100 == near(expected["m2t_top_3"])
    assert found.m2t == near(expected["m2t_score"], GUO)
    assert found.m2m == near(expected["m2m_score"])
    assert realism.fid(latents, latents) == pytest.approx(expected["fid"], abs=1e-9)
    poses = [z_up(features_to_local_joints(rows)) for rows in features]
    points = [smoothness.quarter_points(len(pose)) for pose in poses]
    assert smoothness.transition_distance(poses, points) == near(expected["transition"], GUO)
    steps = torch.stack(
        [smoothness.pose_steps(pose)[[i - 1 for i in p]] for pose, p in zip(poses, points, strict=True)]
    )
    torch.testing.assert_close(steps, data["gt_transition"], atol=GUO, rtol=0)


def each_transition_is_the_published_one_by_name_and_the_distance_of_poses_by_default(folder):
    data = arrays(folder, "mtt_eval.npz")
    measured = {"transition_official": [], "transition_pelvis_subtracted": []}
    counts, chosen = [], []
    for index, spans in enumerate(data["intervals"].tolist()):
        features = HumanML3DRepresentation().encode(bodies(data[f"exp{index}_joints"]))
        points = smoothness.published_transition_points([(a, b) for a, b, _ in spans], len(features))
        pose = z_up(features_to_local_joints(features))
        counts.append(len(points))
        chosen += points
        for point in points:
            measured["transition_official"].append(smoothness.published_transition_distance([pose], [[point]]))
            measured["transition_pelvis_subtracted"].append(smoothness.transition_distance([pose], [[point]]))
    assert counts == data["transition_counts"].tolist() and chosen == data["transition_points"].tolist()
    for name, values in measured.items():
        torch.testing.assert_close(torch.tensor(values, dtype=torch.double), data[name], atol=GUO, rtol=0)


def scores_from_latents_are_those_of_the_published_code(folder):
    data = arrays(folder, "mtt_eval_latents.npz")
    expected = golden(folder, "mtt_eval_expected.json")["from_latents"]
    truth = timelines.GroundTruth(data["text_latents"], data["motion_latents_gt"])
    found = timelines.semantics(data["crop_latents"].flatten(0, 1), data["crop_text_number"].flatten().tolist(), truth)
    own = timelines.semantics(truth.motions, range(len(truth.texts)), truth)
    for result, name in ((found, "exp"), (own, "gt")):
        assert result.recall_1 / 100 == near(expected[name]["m2t_top_1"])
        assert result.recall_3 / 100 == near(expected[name]["m2t_top_3"])
        assert result.m2t == near(expected[name]["m2t_score"])
        assert result.m2m == near(expected[name]["m2m_score"])
    latents = data["realism_latents"].flatten(0, 1)
    assert realism.fid(latents, truth.motions) == near(expected["exp"]["fid"])


def the_frechet_distance_is_that_of_the_published_code(folder):
    data, expected = arrays(folder, "mtt_eval_latents.npz"), golden(folder, "mtt_eval_expected.json")["fid"]
    for name, values in expected.items():
        first, second = data[f"fid_{name}_x"], data[f"fid_{name}_y"]
        assert realism.frechet_distance(first, second) == near(values["fid_raw"])
        for variant in ("fid_normalised", "fid_normalised_scipy_1_11_2", "fid_by_symmetric_eig"):
            assert realism.fid(first, second) == near(values[variant])
        assert realism.fid(first, first) == pytest.approx(0, abs=1e-9)


def the_published_crops_begin_where_they_did(folder):
    data = arrays(folder, "mtt_eval.npz")
    assert realism.published_crop_starts() == tuple(data["realism_starts"].tolist())


@pytest.mark.golden
@pytest.mark.parametrize("folder", golden_sets("stmc"))
def test_the_tables_of_timelines_are_those_of_the_published_code(folder, subtests):
    checked(
        subtests,
        [
            (the_evaluation_of_timelines_is_that_of_the_published_code, "zup24"),
            (the_evaluation_of_timelines_is_that_of_the_published_code, "yup22"),
            (the_evaluation_of_timelines_is_that_of_the_published_code, "only_text"),
            the_evaluation_of_the_ground_truth_is_that_of_the_published_code,
            each_transition_is_the_published_one_by_name_and_the_distance_of_poses_by_default,
            scores_from_latents_are_those_of_the_published_code,
            the_frechet_distance_is_that_of_the_published_code,
            the_published_crops_begin_where_they_did,
        ],
        folder,
    )
