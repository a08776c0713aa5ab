"""MotionDiffuse, its text transformer and its sampling: parity with the published code."""

import numpy as np
import pytest
import torch
from conftest import checked, golden, golden_sets
from helpers.published_networks import close, close_waves, drawn, limit_at, motion_diffuse, watched, waves, words_of
from torch import Tensor

from stmc.diffusion import Schedule, ddpm
from stmc.diffusion.tensors import mask

pytestmark = [pytest.mark.golden, pytest.mark.slow]  # networks of the published sizes
SETS = pytest.mark.parametrize("folder", golden_sets("mdm"))


def texts(folder) -> Tensor:
    """CLIP's words of the three texts, the end of each in front."""
    data = golden(folder, "md_text.npz")
    features = torch.stack([drawn(seed, (77, 1, 512))[:, 0] for seed in data["feat_seeds"]])
    np.testing.assert_array_equal(features[:, 0, :8], data["feats_first8"])
    return words_of(features, data["eot"])


def in_order(words: Tensor, ends) -> Tensor:
    """The words in the order of the text again: the inverse of `words_of`."""
    rows = [torch.cat([row[1 : end + 1], row[:1], row[end + 1 :]]) for row, end in zip(words, ends, strict=True)]
    return torch.stack(rows)


def texts_are_read_as_by_the_published_network(folder):
    data = golden(folder, "md_text.npz")
    network = motion_diffuse(int(data["weight_seed"]))
    encoded = network.encode_text(texts(folder))
    close(network.text_proj(encoded[:, 0]), data["xf_proj"])
    words = in_order(encoded, data["eot"])
    close(words[0], data["xf_out_text0"])
    close(words[:, :4], data["xf_out_first4"])
    close(words[:, -2:], data["xf_out_last2"])


def the_network_answers_as_the_published_one(folder):
    data = golden(folder, "md_forward.npz")
    network = motion_diffuse(int(data["weight_seed"]))
    steps = torch.from_numpy(data["timestep_embedding_t"])
    for table in (network._waves(steps), data["timestep_embedding"]):
        sines, cosines = waves(steps, data["timestep_embedding"].shape[1])
        close_waves(table, torch.cat([cosines, sines], dim=1), steps)
    close(network.time_embed(network._waves(steps)), data["time_embed"], limit_at(steps))
    for i in range(int(data["n_cases"])):
        case = {key.removeprefix(f"c{i}/"): torch.from_numpy(data[key]) for key in data if key.startswith(f"c{i}/")}
        present = mask(case["length"], case["x"].shape[1])
        out = network(case["x"], case["t"], texts(folder)[case["text_index"]], None, present)
        close(out, case["out"], limit_at(case["t"]))


def every_block_is_that_of_the_published_network(folder):
    data = golden(folder, "md_trace.npz")
    network = motion_diffuse(int(data["weight_seed"]))
    blocks = network.temporal_decoder_blocks
    parts = {f"block{i}": block for i, block in enumerate(blocks)} | {"joint_embed": network.joint_embed}
    inner = {f"block0.{name}": getattr(blocks[0], name) for name in ("sa_block", "ca_block", "ffn")}
    x, t, length = (torch.from_numpy(data[key]) for key in ("x", "t", "length"))
    with watched(parts | inner) as seen:
        out = network(x, t, texts(folder)[data["text_index"]], None, mask(length, x.shape[1]))
    before = seen["block0"][0]
    for name in inner:  # the published parts add what stands before them; ours are added outside
        before = before + seen[name][1]
        close(before, data[f"trace/{name}"], limit_at(t))
    for name in parts:
        close(seen[name][1], data[f"trace/{name}"], limit_at(t))
    assert {f"trace/{name}" for name in seen} == {key for key in data if key.startswith("trace/")}
    close(out, data["out"], limit_at(t))


@SETS
def test_motion_diffuse_is_the_published_network(folder, subtests):
    checked(
        subtests,
        [
            texts_are_read_as_by_the_published_network,
            the_network_answers_as_the_published_one,
            every_block_is_that_of_the_published_network,
        ],
        folder,
    )


def posterior_steps_from_noise_are_those_of_the_published_code(folder):
    data = golden(folder, "md_posterior_steps.npz")
    schedule = Schedule.linear(1000)
    for t in data["t_values"].tolist():
        x, eps, noise = (torch.from_numpy(data[f"t{t}/{key}"]) for key in ("x_t", "eps", "noise"))
        x0 = schedule.to_x0(eps, x, t, "eps")
        mean, variance = schedule.posterior(x0, x, t)
        close(x0, data[f"t{t}/pred_xstart"])
        close(mean, data[f"t{t}/mean"])
        np.testing.assert_allclose(variance.item(), data[f"t{t}/variance"], rtol=1e-5)
        close(mean + variance.sqrt() * noise, data[f"t{t}/sample"])


def the_last_ten_steps_are_those_of_the_published_code(folder):
    data = golden(folder, "md_last10_steps.npz")
    network, schedule = motion_diffuse(int(data["weight_seed"])), Schedule.linear(1000)
    x, length = torch.from_numpy(data["x_9"]), torch.from_numpy(data["length"])
    noises = np.random.default_rng(int(data["noise_seed"]))
    encoded = network.encode_text(texts(folder)[data["text_index"]])
    states = []

    def predict(x: Tensor, t: int) -> Tensor:
        states.append(x)
        output = network.denoise(x, torch.full((len(x),), t), encoded, None, mask(length, x.shape[1]))
        return schedule.to_x0(output, x, t, "eps")

    def draw(shape) -> Tensor:
        return torch.from_numpy(noises.standard_normal(tuple(shape)).astype(np.float32))

    last = schedule.respaced(tuple(range(10)))
    final = list(ddpm(predict, last, x, draw, noise_scale="std"))[-1]
    after = {9 - i: state for i, state in enumerate(states[1:])} | {0: final}
    for t in (9, 5, 1, 0):
        close(after[t], data[f"x_after_t{t}"])


@SETS
def test_motion_diffuse_is_sampled_as_by_the_published_code(folder, subtests):
    checked(
        subtests,
        [
            posterior_steps_from_noise_are_those_of_the_published_code,
            the_last_ten_steps_are_those_of_the_published_code,
        ],
        folder,
    )
