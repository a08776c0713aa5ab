"""Sampling, features, measures and losses against their papers' formulas, number by number: parity for everybody."""

import numpy as np
import pytest
import torch
from helpers import equations, formulas
from helpers.appendix_b import by_the_rules
from helpers.collages import COLUMNS, plans_of, timeline
from helpers.equations import Weights
from helpers.motions import walk, walking
from test_equations import agree, drawn, filled
from torch import Tensor

from stmc.composing import NULL, collage, compose_tracks, guided_crops, guided_sequences
from stmc.denoisers import FlowMdm, MdmSmpl
from stmc.diffusion import Schedule, ddim, ddpm, dpm_solver
from stmc.diffusion.tensors import mask
from stmc.evaluation.metrics import realism, retrieval, smoothness
from stmc.evaluators import Tmr
from stmc.motion.body import BodyPart
from stmc.motion.representation import SmplRepresentation
from stmc.motion.representation.humanml3d import joints_to_features, uniform_skeleton, y_up
from stmc.training import Pairs, TmrObjective

# Samplers -------------------------------------------------------------------------------------------------------------


def bent(x, t: int):
    """A predictor that is not linear, for arrays and tensors alike."""
    return x / (1 + abs(x)) + 0.01 * t


@pytest.mark.parametrize("steps", [9, 30])
@pytest.mark.parametrize("schedule", [Schedule.cosine(30), Schedule.linear(30)], ids=["cosine", "linear"])
def test_whole_chains_of_every_sampler_are_those_of_their_papers(schedule, steps):
    left, times = schedule.alpha_bar.tolist(), schedule.spaced(steps)
    x, noises = drawn(2, 4, 3), drawn(steps, 2, 4, 3, seed=2)

    def draw():
        stream = iter(noises)
        return lambda shape: next(stream)

    given = (bent, left, times, x.numpy(), noises.numpy())
    chains = {
        "ddpm": (ddpm(bent, schedule, x, draw(), steps, "std"), formulas.ancestral(*given)),
        "published": (ddpm(bent, schedule, x, draw(), steps, "variance"), formulas.ancestral(*given, published=True)),
        "ddim": (ddim(bent, schedule, x, None, steps), formulas.implicit(*given, eta=0.0)),
        "ddim with noise": (ddim(bent, schedule, x, draw(), steps, 0.6), formulas.implicit(*given, eta=0.6)),
        "dpm solver": (dpm_solver(bent, schedule, x, None, steps), formulas.second_order(*given[:4])),
    }
    for name, (ours, theirs) in chains.items():
        ours = torch.stack(list(ours))
        np.testing.assert_allclose(ours.numpy(), np.stack(theirs), rtol=1e-9, atol=1e-9, err_msg=name)


# STMC as a whole ------------------------------------------------------------------------------------------------------

TIMELINES = [
    [("walk", 0, 12, "legs"), ("run", 12, 21, "legs", "spine"), ("wave", 5, 16, "right arm")],
    [("stand", 0, 14, "legs", "spine"), ("nod", 3, 10, "head")],
]


class Slow:
    """STMC (section 3.3 and Eq. 1 to 6) for one timeline: plans by appendix B, the network crop by crop, weights tile
    by tile, step by step."""

    def __init__(self, prompts: list, overlap: int, weights: Weights, texts: dict[str, np.ndarray], guidance: float):
        spans = [(start, end, parts) for _, start, end, *parts in prompts]
        self.frames, self.crops, self.plus, self.minus = by_the_rules(spans, overlap)
        self.texts = [text for text, *_ in prompts] + [NULL] * (len(self.crops) - len(prompts))
        self.weights, self.table, self.guidance = weights, texts, guidance

    def __call__(self, x: np.ndarray, t: int) -> np.ndarray:
        answers = [
            self.guided(x[start:end], t, text) for (start, end), text in zip(self.crops, self.texts, strict=True)
        ]
        whole = np.zeros_like(x)
        for sign, tiles in ((1, self.plus), (-1, self.minus)):
            for part, own in zip(BodyPart, tiles, strict=True):
                for crop, start, end, first, last in own:
                    for column in COLUMNS[part]:
                        whole[start:end, column] += sign * answers[crop][first:last, column]
        return whole

    def guided(self, x: np.ndarray, t: int, text: str) -> np.ndarray:
        null, told = (equations.mdm_smpl(self.weights, 2, x, t, self.table[each]) for each in (NULL, text))
        return null + self.guidance * (told - null)


@torch.no_grad()
def test_a_whole_run_of_stmc_is_its_equations_timeline_by_timeline():
    network, weights = filled(MdmSmpl(10, 4, width=8, feedforward=8, layers=1, heads=2))
    names = [NULL, *(text for prompts in TIMELINES for text, *_ in prompts)]
    texts = {name: drawn(1, 4, seed=10 + number) for number, name in enumerate(names)}
    schedule, overlap, longest = Schedule.cosine(5), 4, 21
    plans = plans_of(*(timeline(*prompts) for prompts in TIMELINES), overlap=overlap)
    x, noises = drawn(2, longest, 10), drawn(5, 2, longest, 10, seed=2)
    stream = iter(noises)
    predict = collage(guided_crops(network, schedule, plans, texts, 2.0), plans, COLUMNS)
    ours = torch.stack(list(ddpm(predict, schedule, x, lambda shape: next(stream), noise_scale="variance")))
    for row, prompts in enumerate(TIMELINES):
        slow = Slow(prompts, overlap, weights, {name: text.numpy() for name, text in texts.items()}, 2.0)
        given = (x[row, : slow.frames].numpy(), noises[:, row, : slow.frames].numpy())
        theirs = formulas.ancestral(slow, schedule.alpha_bar.tolist(), range(5), *given, published=True)
        agree(ours[:, row, : slow.frames], np.stack(theirs))


class SlowFlow(Slow):
    """FlowMDM for one timeline: each body part is a sequence of the texts that it obeys, denoised whole."""

    def __call__(self, x: np.ndarray, t: int) -> np.ndarray:
        whole = np.zeros_like(x)
        for part, own in zip(BodyPart, self.plus, strict=True):
            obeyed = list(dict.fromkeys(crop for crop, *_ in own))
            segment = [obeyed.index(crop) for crop, start, end, *_ in own for _ in range(start, end)]
            null, told = (
                equations.flow_mdm(self.weights, 2, 4, t >= 3, x, t, np.concatenate(words), segment)
                for words in ([self.table[NULL]] * len(obeyed), [self.table[self.texts[crop]] for crop in obeyed])
            )
            columns = list(COLUMNS[part])
            whole[:, columns] = (null + self.guidance * (told - null))[:, columns]
        return whole


@torch.no_grad()
def test_a_whole_run_of_flow_mdm_is_its_equations_part_by_part():
    network, weights = filled(FlowMdm(10, 4, 3, width=8, feedforward=8, layers=1, heads=2, attention_window=4))
    [prompts] = TIMELINES[:1]
    texts = {name: drawn(1, 4, seed=10 + n) for n, name in enumerate([NULL, *(text for text, *_ in prompts)])}
    schedule, plans = Schedule.cosine(5), plans_of(timeline(*prompts), overlap=0)
    x, noises = drawn(1, plans[0].frames, 10), drawn(5, 1, plans[0].frames, 10, seed=2)
    stream = iter(noises)
    predict = compose_tracks(guided_sequences(network, schedule, plans, texts, 2.0), plans, COLUMNS)
    ours = torch.cat(list(ddpm(predict, schedule, x, lambda shape: next(stream), noise_scale="std")))
    slow = SlowFlow(prompts, 0, weights, {name: text.numpy() for name, text in texts.items()}, 2.0)
    theirs = formulas.ancestral(slow, schedule.alpha_bar.tolist(), range(5), x[0].numpy(), noises[:, 0].numpy())
    agree(ours, np.stack(theirs))


# Features -------------------------------------------------------------------------------------------------------------


def test_the_205_features_are_appendix_d_frame_by_frame():
    for seed in (0, 1):
        motion = walk(9, seed=seed)
        features = formulas.smpl_features(motion.rotations.numpy(), motion.joints.numpy())
        np.testing.assert_allclose(SmplRepresentation().encode(motion).numpy(), features, atol=1e-9)


@pytest.mark.parametrize("heading", [0.0, 2.5])
def test_any_205_features_decode_frame_by_frame_as_they_were_made(heading):
    features = drawn(8, 205)
    motion = SmplRepresentation().decode(features, 20.0, heading=heading)
    rotations, joints = formulas.smpl_motion(features.numpy(), heading)
    np.testing.assert_allclose(motion.rotations.numpy(), rotations, atol=1e-9)
    np.testing.assert_allclose(motion.joints.numpy(), joints, atol=1e-9)


def test_the_263_features_are_those_of_quaternions_frame_by_frame():
    lengths = uniform_skeleton().offsets[:22].double().norm(dim=-1).tolist()
    for motion in (walking(1.5, turn=0.9), walk(7)):
        joints = y_up(motion.joints[:, :22])
        features = formulas.humanml3d_features(joints.numpy(), lengths)
        np.testing.assert_allclose(joints_to_features(joints).numpy(), features, atol=1e-6)


# Measures and losses --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(5))
def test_ranks_and_recalls_are_counted_one_by_one_also_among_ties_and_several_right_answers(seed):
    generator = np.random.default_rng(seed)
    table = torch.from_numpy(generator.integers(0, 6, (13, 13)) / 6)
    right = torch.from_numpy(generator.random((13, 13)) < 0.1) | torch.eye(13, dtype=torch.bool)
    for found, each, true in zip(retrieval.t2m_m2t(table, right), (table, table.T), (right, right.T), strict=True):
        expected = np.array(formulas.standing(each.numpy(), true.numpy()))
        assert retrieval.ranks(each, true).tolist() == expected.tolist()
        assert found.recall == pytest.approx({k: 100 * (expected < k).mean() for k in found.recall})
        assert found.median_rank == np.median(expected) + 1


@pytest.mark.parametrize("seed", range(3))
def test_the_frechet_distance_is_that_of_the_root_of_a_matrix(seed):
    first, second = drawn(30, 5, seed=seed) @ drawn(5, 5, seed=9), drawn(40, 5, seed=seed + 20) + 0.5
    expected = formulas.frechet(first.numpy(), second.numpy())
    assert realism.frechet_distance(first, second) == pytest.approx(expected, rel=1e-6)


def test_jerk_its_peak_and_its_area_are_those_of_frames_counted_one_by_one():
    joints = drawn(3, 12, 4, 3)
    expected = np.array([formulas.jerks(each) for each in joints.numpy()])
    jerks = smoothness.jerk(joints)
    np.testing.assert_allclose(jerks.numpy(), expected, rtol=1e-9)
    curve = smoothness.jerk_curve(jerks)
    mean = [float(np.mean(expected[:, frame])) for frame in range(9)]
    assert smoothness.peak_jerk(curve) == pytest.approx(max(mean))
    assert smoothness.area_under_jerk(curve, 0.7) == pytest.approx(sum(abs(value - 0.7) for value in mean))


def test_the_distance_of_a_transition_is_that_of_two_poses_without_the_pelvis():
    poses = [drawn(9, 5, 3), drawn(6, 5, 3, seed=2)]
    points = [(2, 8), (1,)]
    chosen = [(pose.numpy(), point) for pose, each in zip(poses, points, strict=True) for point in each]
    expected = np.mean([formulas.pose_distance(pose[point - 1], pose[point]) for pose, point in chosen])
    assert smoothness.transition_distance(poses, points) == pytest.approx(expected)


def smooth_l1(first: np.ndarray, second: np.ndarray) -> float:
    error = np.abs(first - second)
    return float(np.where(error < 1, error**2 / 2, error - 0.5).mean())


def test_the_terms_of_tmrs_loss_are_those_of_its_paper():
    """Of an encoder that is not variational, whose points are its means; the divergence has closed forms of its own."""
    sizes = {"features": 6, "text_width": 5, "width": 8, "feedforward": 8, "layers": 1, "heads": 2}
    network, weights = filled(Tmr(**sizes, variational=False))
    lengths, words = [7, 4, 5], [2, 4, 1]
    present, told = mask(torch.tensor(lengths)), mask(torch.tensor(words))
    motion, text = drawn(3, 7, 6) * present[..., None], drawn(3, 4, 5, seed=2) * told[..., None]
    alike = torch.eye(3, dtype=torch.bool)
    alike[0, 2] = True

    def encoded(name: str, rows: Tensor, counts: list[int]) -> list[np.ndarray]:
        own = weights.of(f"{name}_encoder")
        return [equations.tmr_encoder(own, 2, each[:n].numpy())[0] for each, n in zip(rows, counts, strict=True)]

    texts, motions = encoded("text", text, words), encoded("motion", motion, lengths)
    rebuilt = 0.0
    for latents in (texts, motions):
        back = np.zeros((3, 7, 6))
        for row, (latent, n) in enumerate(zip(latents, lengths, strict=True)):
            back[row, :n] = equations.tmr_decoder(weights.of("motion_decoder"), 2, latent, n)
        rebuilt += smooth_l1(back, motion.numpy())
    cosine = np.array([[a @ b / np.linalg.norm(a) / np.linalg.norm(b) for b in motions] for a in texts]) / 0.1
    counted = np.where(alike.numpy() & ~np.eye(3, dtype=bool), 0.0, np.exp(cosine))
    contrast = -np.mean([np.log(np.diag(counted) / counted.sum(axis=axis)).mean() for axis in (0, 1)])
    expected = [rebuilt, 0.0, smooth_l1(np.stack(texts), np.stack(motions)), contrast]
    pairs = Pairs(motion.float(), present, text.float(), told, sum(lengths), alike)
    terms = TmrObjective()(network.float(), pairs, torch.Generator()) / sum(lengths)
    np.testing.assert_allclose(terms.numpy(), expected, rtol=1e-4)
