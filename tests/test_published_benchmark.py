"""The paper's benchmark from files in their published forms: AMASS's recordings, MTT's three files, and a TMR of
HumanML3D's features. What the script prints is computed a second time here, slowly, by the published formulas."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from conftest import data_file
from helpers.scripts import configured, run
from helpers.tiny_model import Hashes, tiny
from scipy.spatial.transform import Rotation, Slerp
from test_evaluators import SIZES, drawn, evaluator, small
from torch.testing import assert_close

import stmc
from stmc.data.sources.amass.amass_recordings import read_recording, strip_mirror_prefix
from stmc.diffusion.statistics import Statistics
from stmc.evaluation.benchmarks.atomic_prompts import read_atomic_prompts
from stmc.evaluation.benchmarks.ground_truth import ReferenceMotions, amass_reference_motions
from stmc.evaluation.metrics.timeline_metrics import PUBLISHED
from stmc.evaluation.results import read_results
from stmc.evaluators import Evaluator
from stmc.motion.body import JOINTS, PARENTS
from stmc.motion.body_model import Skeleton
from stmc.motion.representation import HumanML3DRepresentation
from stmc.motion.representation.humanml3d import features_to_joints, joints_to_features, z_up
from stmc.run import save, save_evaluator

TEXTS = """\
raise the left arm # left hand
raise the right arm # right hand
turn left # left leg # right leg
turn right # legs
bow # torso # neck
"""
MOTIONS = """\
BMLmovi/Subject_1_F_MoSh/Subject_1_F_2_poses # 0.0 # 1.53
M/BMLmovi/Subject_1_F_MoSh/Subject_1_F_2_poses # 0.0 # 1.53
M/ACCAD/Female1Running_c3d/C6 - turn right_poses # 0.37 # 1.892
ACCAD/Female1Running_c3d/C6 - turn right_poses # 0.37 # 1.892
KIT/3/bow01_poses # 0.1 # 2.0
"""
TIMELINES = """\
turn left # 0.0 # 4.0 # left leg # right leg
bow # 4.0 # 7.03 # torso # neck
raise the right arm # 2.0 # 5.5 # right hand

raise the left arm # 0.0 # 3.21 # left hand
turn right # 3.21 # 6.4 # legs
bow # 1.0 # 6.0 # neck
"""
SPANS = [[(0, 80, 2), (80, 140, 4), (40, 110, 1)], [(0, 64, 0), (64, 128, 3), (20, 120, 4)]]
"""Frames and the number of the text, by hand."""


def recording(rate: float, seconds: float, **turning: float) -> dict[str, np.ndarray]:
    """AMASS's arrays of somebody who stands; `turning` joints turn by so many radians a second, the root about the up
    axis, spine1 forwards, arms up or down."""
    frames = round(rate * seconds)
    moments, angles = np.arange(frames) / rate, np.zeros((frames, 52, 3))
    upright = Rotation.from_rotvec([np.pi / 2, 0, 0])
    heading = Rotation.from_rotvec(turning.get("pelvis", 0.0) * moments[:, None] * [0, 0, 1])
    angles[:, 0] = (heading * upright).as_rotvec()
    for joint, axis in (("left_shoulder", 2), ("left_elbow", 1), ("spine1", 0)):
        angles[:, JOINTS.index(joint), axis] = turning.get(joint, 0.0) * moments
    angles[:, 22:] = 0.1
    trans = np.stack([0.3 * moments, np.sin(moments), np.full(frames, 0.9)], axis=1)
    return {
        "trans": trans,
        "gender": np.array("female"),
        "mocap_framerate": np.array(rate),
        "betas": np.linspace(-1, 1, 16),
        "dmpls": np.zeros((frames, 8)),
        "poses": angles.reshape(frames, 156),
    }


RECORDED = {
    "BMLmovi/Subject_1_F_MoSh/Subject_1_F_2_poses": recording(120.0, 1.6, left_shoulder=0.9, left_elbow=-0.5),
    "ACCAD/Female1Running_c3d/C6 - turn right_poses": recording(60.0, 2.0, pelvis=-1.1, spine1=0.1),
    "KIT/3/bow01_poses": recording(100.0, 2.0, spine1=0.4),
}


@pytest.fixture(scope="module")
def work(tmp_path_factory) -> Path:
    """Everything that a user of the benchmark has, as files."""
    folder = tmp_path_factory.mktemp("published")
    for name, arrays in RECORDED.items():
        path = folder / "AMASS" / f"{name}.npz"
        path.parent.mkdir(parents=True)
        np.savez(path, **arrays)
    for name, content in (("texts", TEXTS), ("motions", MOTIONS), ("MTT", TIMELINES)):
        (folder / f"{name}.txt").write_text(content)
    save(tiny(longest=200), folder / "model", "card")
    save_evaluator(evaluator_of_humanml3d(), folder / "tmr", "card")
    return folder


def evaluator_of_humanml3d() -> Evaluator:
    """Small and not trained, but of weights so large that its latents lie apart and no rank hangs on rounding."""
    network = small(263, 384).eval().requires_grad_(False)
    weights = network.state_dict().items()
    network.load_state_dict(
        {name: value * (3 if value.ndim > 1 and "tokens" not in name else 1) for name, value in weights}
    )
    config = {
        "network": {"_target_": "stmc.evaluators.Tmr", "features": 263, "text_width": 384, **SIZES},
        "text_encoder": {"_target_": "stmc.text.MiniLM", "pooling": "tokens"},
        "representation": {"_target_": "stmc.motion.representation.HumanML3DRepresentation"},
    }
    standing = torch.from_numpy(np.concatenate(ground_truth()).mean(axis=0))
    statistics = Statistics(standing, torch.full((263,), 0.1)), Statistics(torch.zeros(384), torch.ones(384))
    return Evaluator(network, Hashes(), HumanML3DRepresentation(), *statistics, 20, config)


@pytest.fixture(scope="module")
def reference_motions(work) -> ReferenceMotions:
    return amass_reference_motions(work / "AMASS", 20)


# The slow way ---------------------------------------------------------------------------------------------------------


def oracle_joints(path: str, start: float, end: float, fps: float = 20.0) -> np.ndarray:
    """The published preparation: poses at another rate, mirrored, and only then posed; frames int(fps * seconds). It
    begins above the origin."""
    mirrored, arrays = path.startswith("M/"), RECORDED[path.removeprefix("M/")]
    angles, trans, rate = arrays["poses"].reshape(-1, 52, 3)[:, :22], arrays["trans"], float(arrays["mocap_framerate"])
    frames = len(trans)
    moments = np.clip((np.arange(int(frames * fps / rate)) + 0.5) * rate / fps - 0.5, 0, frames - 1)
    turns = [Slerp(np.arange(frames), Rotation.from_rotvec(angles[:, joint]))(moments) for joint in range(22)]
    trans = np.stack([np.interp(moments, np.arange(frames), trans[:, axis]) for axis in range(3)], axis=1)
    if mirrored:
        swapped = [JOINTS.index(other(name)) for name in JOINTS[:22]]
        turns = [Rotation.from_rotvec(turns[joint].as_rotvec() * [1, -1, -1]) for joint in swapped]
        trans = trans * [-1, 1, 1]
    bones = Skeleton.default().offsets.double().numpy()
    world, places = [turns[0]], [trans + bones[0]]
    for joint in range(1, 22):
        world.append(world[PARENTS[joint]] * turns[joint])
        places.append(places[PARENTS[joint]] + world[PARENTS[joint]].apply(bones[joint]))
    return from_origin(np.stack(places, axis=1)[int(fps * start) : int(fps * end)])


def from_origin(joints: np.ndarray) -> np.ndarray:
    return joints - joints[0, 0] * [1, 1, 0]


def other(name: str) -> str:
    left, right = name.startswith("left"), name.startswith("right")
    return name.replace("left", "right") if left else name.replace("right", "left") if right else name


def guo(joints: np.ndarray) -> np.ndarray:
    """HumanML3D's features: those that golden numbers hold."""
    x, y, z = np.moveaxis(joints[:, :22], -1, 0)
    return joints_to_features(torch.from_numpy(np.stack([x, z, -y], axis=-1))).numpy().astype(np.float32)


def local(features: np.ndarray) -> np.ndarray:
    """Joints by the features, as if nobody ever turned: x, -z, y."""
    path = np.concatenate([np.zeros((1, 2)), features[:-1, 1:3].cumsum(axis=0)])
    pelvis = np.stack([path[:, 0], features[:, 3], path[:, 1]], axis=1)
    joints = features[:, 4:67].reshape(-1, 21, 3) + pelvis[:, None] * [1, 0, 1]
    x, y, z = np.moveaxis(np.concatenate([pelvis[:, None], joints], axis=1), -1, 0)
    return np.stack([x, -z, y], axis=-1)


def steps(poses: np.ndarray, points) -> list[float]:
    return [float(np.linalg.norm(poses[point] - poses[point - 1], axis=-1).mean()) for point in points]


def quarters(features: np.ndarray) -> list[int]:
    return [len(features) // 4, 2 * len(features) // 4, 3 * len(features) // 4]


def cosine(first: np.ndarray, second: np.ndarray) -> float:
    return float(first @ second / np.linalg.norm(first) / np.linalg.norm(second))


def frechet(first: np.ndarray, second: np.ndarray) -> float:
    one, two = (rows / np.linalg.norm(rows, axis=1, keepdims=True) for rows in (first, second))
    first, second = np.cov(one, rowvar=False), np.cov(two, rowvar=False)
    root = np.sqrt(np.abs(np.linalg.eigvals(first @ second))).sum()
    return float(((one.mean(0) - two.mean(0)) ** 2).sum() + np.trace(first) + np.trace(second) - 2 * root)


def ground_truth() -> list[np.ndarray]:
    shown = [[field.strip() for field in line.split("#")] for line in MOTIONS.splitlines()]
    return [guo(oracle_joints(path, float(start), float(end))) for path, start, end in shown]


class Slow:
    """The published tables of ground truth and of joints, text by text and crop by crop."""

    def __init__(self, judge: Evaluator) -> None:
        self.texts = judge.texts([line.split("#")[0].strip() for line in TEXTS.splitlines()]).double().numpy()
        self.features = ground_truth()
        self.latents = lambda rows: judge.motions([torch.from_numpy(each) for each in rows]).double().numpy()
        self.motions = self.latents(self.features)

    def semantics(self, crops: np.ndarray, numbers: list[int]) -> dict[str, float]:
        ranks, to_text, to_motion = [], [], []
        for crop, number in zip(crops, numbers, strict=True):
            told = [cosine(crop, text) for text in self.texts]
            ranks.append(sorted(range(len(told)), key=lambda text: -told[text]).index(number))
            to_text.append((1 + told[number]) / 2)
            to_motion.append((1 + cosine(crop, self.motions[number])) / 2)
        shares = {f"recall_{count}": 100 * np.mean([rank < count for rank in ranks]) for count in (1, 3)}
        return shares | {"m2t": np.mean(to_text), "m2m": np.mean(to_motion)}

    def real(self) -> dict[str, float]:
        distances = []
        for rows in self.features:
            poses = local(rows)
            distances += steps(poses - poses[:, :1], quarters(rows))
        found = self.semantics(self.motions, [*range(len(self.texts))])
        return found | {"fid": 0.0, "fid_plus": 0.0, "transition": 100 * np.mean(distances)}

    def generated(self, joints: list[np.ndarray], one_text: bool) -> dict[str, float]:
        crops, numbers, anywhere, distances = [], [], [], []
        for each, spans in zip(joints, SPANS, strict=True):
            rows = guo(each)
            edges = sorted({edge for start, end, _ in spans for edge in (start, end) if edge < len(rows)})[1:-1]
            poses = local(rows)
            distances += steps(poses - poses[..., :1], quarters(rows) if one_text else edges)
            anywhere += [rows[start : start + 100] for start in np.random.RandomState(0).randint(0, 263 - 100, 5)]
            for start, end, number in spans:
                crops.append(rows if one_text else rows[start:end])
                numbers.append(number)
        own = self.latents(crops)
        fids = {"fid": frechet(own, self.motions), "fid_plus": frechet(self.latents(anywhere), self.motions)}
        return self.semantics(own, numbers) | fids | {"transition": 100 * np.mean(distances)}


# The tests ------------------------------------------------------------------------------------------------------------


def test_the_published_table_is_the_one_that_the_published_formulas_give(work, monkeypatch):
    monkeypatch.setattr("stmc.text.MiniLM.encode", lambda encoder, texts: Hashes().encode(texts))
    run(
        "evaluate", "evaluate", "benchmark=mtt", f"benchmark.folder={work}", f"benchmark.amass={work / 'AMASS'}",
        f"models.MDM-SMPL={work / 'model'}", f"evaluator={work / 'tmr'}", f"output={work / 'out'}", "seeds=[1]",
        "experiment.methods=[one_text, stmc]", "experiment.settings.steps=[2]", "experiment.settings.stitch_from=[0]",
        "device=cpu", "precision=fp32", "batch=2", "experiment.figure=null",
    )  # fmt: skip
    found = {result.method: result.metrics for result in read_results(work / "out" / "results.jsonl")}
    slow, model = Slow(stmc.load_evaluator(work / "tmr")), stmc.load(work / "model")
    expected = {"ground_truth": slow.real()}
    for method in ("one_text", "stmc"):
        settings = {
            "seed": [2, 3],
            "steps": 2,
            "stitch_from": 0.0,
            "method": method,
            "joints_from": "features",
            "clean_feet": False,
        }
        motions = model.generate(stmc.Timeline.read_all(work / "MTT.txt"), **settings)
        joints = [motion.joints.double().numpy() for motion in motions]
        expected[method] = slow.generated(joints, one_text=method == "one_text")
    for method, numbers in expected.items():
        for key, value in numbers.items():
            assert found[method][key] == pytest.approx(value, rel=1e-3, abs=1e-5), (method, key)
    assert len({number for numbers in expected.values() for number in numbers.values()}) > 10


def test_the_ground_truth_is_cut_and_mirrored_as_published(work, reference_motions):
    for prompt in read_atomic_prompts(work / "texts.txt", work / "motions.txt"):
        expected = oracle_joints(prompt.clip, prompt.start, prompt.end)
        shown = from_origin(reference_motions(prompt.clip, prompt.start, prompt.end).joints[:, :22].numpy())
        assert_close(shown, expected, atol=2e-5, rtol=0)


@pytest.mark.parametrize("name", RECORDED)
def test_a_name_with_m_is_the_mirror_image(work, reference_motions, name):
    plain, image = reference_motions(name, 0.1, 1.5), reference_motions(f"M/{name}", 0.1, 1.5)
    recorded = read_recording(work / "AMASS" / f"{name}.npz", Skeleton.default()).mirrored().resampled(20)
    posed = stmc.Motion.posed(recorded.rotations, recorded.translation, 20, Skeleton.default()).trimmed(2, 30)
    assert_close(image.rotations, posed.rotations, atol=1e-9, rtol=0)
    assert_close(image.joints, posed.joints, atol=1e-6, rtol=0)
    assert float((image.joints - plain.joints).norm(dim=-1).max()) > 0.05


def test_the_mirror_images_of_the_published_atomic_prompts_are_known_by_their_names():
    paths = [line.split("#")[0].strip() for line in data_file("mtt/motions.txt").read_text().splitlines()]
    known = [strip_mirror_prefix(path) for path in paths]
    assert sum(image for _, image in known) == 22
    assert [f"M/{path}" if image else path for path, image in known] == paths


def test_recordings_that_are_not_there_and_an_evaluator_of_other_features_are_named(work, reference_motions):
    with pytest.raises(ValueError, match="no recording 'KIT/3/jump_poses'"):
        reference_motions("M/KIT/3/jump_poses", 0.0, 1.0)
    with pytest.raises(ValueError, match="uses 205 features; the published formulas need one of HumanML3D's 263"):
        PUBLISHED.real_transition([reference_motions("KIT/3/bow01_poses", 0.0, 1.0)], evaluator())


@pytest.mark.parametrize("representation", [None, HumanML3DRepresentation()], ids=["205", "263"])
def test_joints_are_the_skeletons_or_the_features_own(representation):
    model = tiny()
    if representation:
        encoded = representation.encode(model.generate(stmc.Timeline.parse("walk # 0 # 1"), steps=2)[0])
        statistics = Statistics(encoded.mean(dim=0), torch.full((263,), 0.05))
        model = replace(model, representation=representation, motion_statistics=statistics)
    features = drawn(1, 12, model.representation.width)
    [posed], [own] = model.decode(features, [9]), model.decode(features, [9], joints_from="features")
    raw = model.motion_statistics.restore(features)[0, :9]
    if representation:
        assert_close(own.joints[:, :22], z_up(features_to_joints(raw)), atol=1e-5, rtol=0)
    else:
        assert_close(own.joints, model.representation.integrate(raw)[2], atol=1e-5, rtol=0)
    assert float((own.joints - posed.joints).abs().max()) > 1e-3


def test_the_overlaps_are_those_of_table_a_1():
    chosen = configured("evaluate", "experiment=overlap").experiment.settings.overlap
    assert list(chosen) == [0.25, 0.4, 0.5, 0.6, 0.75, 1.0, 1.25]
