"""TMR and the evaluator of Guo et al.: parity with the published code."""

import zlib

import numpy as np
import pytest
import torch
from conftest import GOLDEN, checked, golden, golden_sets
from torch import Tensor, nn

from stmc.diffusion.tensors import mask, pad
from stmc.evaluators import GuoEvaluator, Posterior, Tmr
from stmc.training import TmrObjective
from stmc.training.contrastive_batches import Pairs
from stmc.training.data.pair_batches import similar
from stmc.training.tmr_objective import info_nce, kl_terms

pytestmark = pytest.mark.golden

RELATIVE = 2e-5
"""Of the largest number: what the golden numbers' README allows the outputs of networks."""


def tensors(folder, name: str) -> dict[str, Tensor]:
    return {key: torch.from_numpy(np.asarray(value)) for key, value in golden(folder, name).items()}


def entries(file: str, network: str) -> list[dict]:
    return golden(GOLDEN / "flow", file)[network]


def filled(network: nn.Module, listed: list[dict], seed: int) -> nn.Module:
    """`network` with the golden weights; its names and shapes must be those of the published file."""
    assert {name: list(value.shape) for name, value in network.state_dict().items()} == {
        entry["name"]: entry["shape"] for entry in listed
    }
    weights = {}
    for entry in listed:
        rng = np.random.default_rng(zlib.crc32(f"{seed}:{entry['name']}".encode()))
        weight = rng.standard_normal(tuple(entry["shape"])).astype(np.float32) * np.float32(0.05)
        weights[entry["name"]] = torch.from_numpy(weight + (entry["kind"] == "norm_weight"))
    network.load_state_dict(weights)
    return network.eval().requires_grad_(False)


def tmr(name: str, seed: int) -> Tmr:
    listed = entries("tmr_state_dicts.json", name)
    shapes = {entry["name"]: entry["shape"] for entry in listed}
    tokens, width = shapes["motion_encoder.tokens"]
    layers = sum("motion_encoder" in key and key.endswith("norm1.weight") for key in shapes)
    network = Tmr(
        shapes["motion_encoder.projection.weight"][1],
        shapes["text_encoder.projection.weight"][1],
        width,
        shapes["motion_encoder.seqTransEncoder.layers.0.linear1.weight"][0],
        layers,
        heads=4 if width == 256 else 2,  # the one number that the golden files do not tell
        variational=tokens == 2,
    )
    return filled(network, listed, seed)


def assert_golden(actual: Tensor, expected: Tensor) -> None:
    torch.testing.assert_close(actual, expected, atol=RELATIVE * float(expected.abs().max()), rtol=0)


def tmr_of_the_published_size_is_the_published_code(folder):
    data = tensors(folder, "tmr_full.npz")
    network = tmr("tmr_full", int(data["weight_seed"]))
    rng = np.random.default_rng(int(data["seed"]))

    def drawn(lengths: Tensor, width: int) -> tuple[Tensor, Tensor]:
        rows = [rng.standard_normal((length, width)).astype(np.float32) for length in lengths.tolist()]
        padded, lengths = pad([torch.from_numpy(row) for row in rows])
        return padded, mask(lengths)

    motions = drawn(data["motion_lengths"], network.motion_encoder.projection.in_features)
    texts = drawn(data["text_lengths"], network.text_encoder.projection.in_features)
    torch.testing.assert_close(motions[0][0, 0, :5], data["motion_x_head"])
    torch.testing.assert_close(texts[0][0, 0, :5], data["text_x_head"])
    motion, text = network.motion_encoder(*motions), network.text_encoder(*texts)
    for posterior, name in ((motion, "motion"), (text, "text")):
        assert_golden(posterior.mean, data[f"{name}_mu"])
        assert_golden(posterior.log_variance, data[f"{name}_logvar"])
    assert_golden(network.motion_decoder(motion.mean, motions[1]), data["decoded_motion_from_motion_mu"])


def the_losses_of_tmr_are_those_of_the_published_code(folder, variational):
    data = tensors(folder, f"tmr_small_vae{variational}.npz")
    network = tmr(f"tmr_small_vae{variational}", int(data["weight_seed"]))
    text = network.text_encoder(data["text_x"], data["text_mask"])
    motion = network.motion_encoder(data["motion_x"], data["motion_mask"])
    assert_golden(text.mean, data["t_latents"])
    assert_golden(motion.mean, data["m_latents"])
    for posterior, name in ((motion, "m_motions"), (text, "t_motions")):
        assert_golden(network.motion_decoder(posterior.mean, data["motion_mask"]), data[name])
    for name, value in zip(("t_m", "m_t", "m_ref", "t_ref"), kl_terms(text, motion), strict=True):
        if f"kl_{name}" in data:
            assert_golden(value, data[f"kl_{name}"])
    pairs = Pairs(
        data["motion_x"],
        data["motion_mask"],
        data["text_x"],
        data["text_mask"],
        int(data["motion_mask"].sum()),
        similar(data["sent_emb"]),
    )
    objective, draw = TmrObjective(), Posterior.rsample
    Posterior.rsample = lambda posterior, generator: posterior.mean
    try:
        means = objective(network, pairs, torch.Generator()) / pairs.frames
    finally:
        Posterior.rsample = draw
    losses = objective.losses(means)
    expected = {"reconstruction": "recons", "kl": "kl", "latent": "latent", "contrastive": "contrastive"}
    for name, published in expected.items():
        if f"loss_{published}" in data:
            assert losses[f"loss_{name}"] == pytest.approx(float(data[f"loss_{published}"]), rel=RELATIVE)
    assert losses["loss"] == pytest.approx(float(data["loss_loss"]), rel=RELATIVE)


def the_contrastive_loss_and_its_filter_are_those_of_the_published_code(folder):
    data = tensors(folder, "tmr_infonce.npz")
    x, y, sentences = data["x"], data["y"], data["sent_emb"]
    for temperature, threshold, name in (
        (0.1, 0.8, "loss_T01_thr080"),
        (0.7, 0.8, "loss_T07_thr080"),
        (0.1, 0.95, "loss_T01_thr095"),
    ):
        assert_golden(info_nce(x, y, similar(sentences, threshold), temperature), data[name])
    assert_golden(info_nce(x, y), data["loss_T01_nofilter"])
    alike = similar(sentences, 0.8) & ~torch.eye(len(x), dtype=torch.bool)
    assert alike.nonzero().tolist() == data["filtered_pairs_thr080"].tolist()


@pytest.mark.golden
@pytest.mark.parametrize("folder", golden_sets("flow"))
def test_tmr_is_the_published_code(folder, subtests):
    checked(
        subtests,
        [
            tmr_of_the_published_size_is_the_published_code,
            (the_losses_of_tmr_are_those_of_the_published_code, 0),
            (the_losses_of_tmr_are_those_of_the_published_code, 1),
            the_contrastive_loss_and_its_filter_are_those_of_the_published_code,
        ],
        folder,
    )


def guo(name: str, seed: int) -> GuoEvaluator:
    listed = entries("evaluator_state_dicts.json", name)
    shapes = {entry["name"]: entry["shape"] for entry in listed}
    hidden, seen, _ = shapes["movement_encoder.main.0.weight"]
    network = GuoEvaluator(
        seen,
        (hidden, shapes["movement_encoder.main.3.weight"][0]),
        shapes["motion_encoder.hidden"][2],
        shapes["text_encoder.pos_emb.weight"][0],
        shapes["text_encoder.hidden"][2],
        shapes["motion_encoder.output_net.3.weight"][0],
    )
    return filled(network, listed, seed)


def the_guo_evaluator_of_the_published_size_is_the_published_code(folder):
    data = tensors(folder, "evaluator_full.npz")
    network = guo("full", int(data["weight_seed"]))
    rng = np.random.default_rng(int(data["seed"]))
    shapes = [tuple(data[f"{name}_shape"].tolist()) for name in ("motions", "words")]
    motions, words = (torch.from_numpy(rng.standard_normal(shape).astype(np.float32)) for shape in shapes)
    kinds = torch.from_numpy(rng.integers(0, 15, data["pos_ids"].shape))
    assert torch.equal(kinds, data["pos_ids"])
    torch.testing.assert_close(motions[0, 0, :5], data["motions_head"])
    lengths = data["motion_lengths"]
    order = data["official_order"]
    assert_golden(network.motions(motions, lengths)[order], data["motion_embedding_official_order"])
    assert_golden(network.movement_encoder(motions[:1, :, : network.seen])[0], data["movements_first_item"])
    one_hot = torch.nn.functional.one_hot(kinds, 15).float()
    texts = network.texts(words, one_hot, data["caption_lengths"])
    assert_golden(texts, data["text_embedding_input_order"])
    assert_golden(texts[order], data["text_embedding_official_order"])


def a_small_guo_evaluator_is_the_published_code(folder):
    data = tensors(folder, "evaluator_small.npz")
    network = guo("small", int(data["weight_seed"]))
    assert_golden(network.movement_encoder(data["motions"]), data["movements"])
    assert_golden(network.motions(data["motions"], data["motion_lengths"]), data["motion_embedding"])
    texts = network.texts(data["words"], data["pos_onehot"], data["caption_lengths"])
    assert_golden(texts, data["text_embedding"])


def the_evaluator_of_babel_is_the_published_code(folder):
    data = tensors(folder, "evaluator_babel.npz")
    network = guo("babel_full", int(data["weight_seed"]))
    assert_golden(network.motions(data["motions"], data["motion_lengths"]), data["motion_embedding"])


@pytest.mark.golden
@pytest.mark.parametrize("folder", golden_sets("flow"))
def test_guo_s_evaluators_are_the_published_code(folder, subtests):
    checked(
        subtests,
        [
            the_guo_evaluator_of_the_published_size_is_the_published_code,
            a_small_guo_evaluator_is_the_published_code,
            the_evaluator_of_babel_is_the_published_code,
        ],
        folder,
    )
