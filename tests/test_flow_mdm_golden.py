"""FlowMDM: parity with the published code, in both modes, with and without texts, and in the layout of training."""

from itertools import pairwise

import numpy as np
import pytest
import torch
from conftest import GOLDEN, checked, golden, golden_sets
from helpers.collages import plans_of, timeline
from helpers.flow_mdm import close, entries, flow_mdm, parameters, segments
from helpers.published_networks import drawn, frames, watched
from torch import Tensor

from stmc.composing import NULL, compose_tracks, guided_sequences
from stmc.denoisers import FlowMdm
from stmc.denoisers.flow_mdm import _positions
from stmc.denoisers.flow_mdm_layers import ROTARY_DIM, frequencies
from stmc.diffusion import Schedule, ddpm, guide
from stmc.diffusion.tensors import mask
from stmc.motion.body import BodyPart
from stmc.training.loss import Batch, squared_errors

pytestmark = pytest.mark.golden
SETS = pytest.mark.parametrize("folder", golden_sets("flow"))
NAMES = ("humanml", "babel")
STEPS = 1000
HORIZON = {"humanml": 150, "babel": 100}
ABSOLUTE_FROM = {"humanml": STEPS - 60 + 1, "babel": STEPS - 125 + 1}
"""The README, section 1: S absolute steps as published are S - 1."""
SHORT_WINDOW = {"humanml": 6, "babel": 5}


class Case:
    """One golden file of a small or full network: its inputs, and the network with its weights."""

    def __init__(self, folder, size: str, name: str, attention_window: int) -> None:
        self.data = golden(folder, f"flowmdm_{size}_{name}.npz")
        self.lengths = self.data["lengths"].tolist()
        self.segment = segments(self.lengths)
        if size == "small":
            self.x, text = frames(self.data["x"]), torch.from_numpy(self.data["text_embeddings"])
        else:
            self.x = frames(drawn(self.data["x_seed"], tuple(self.data["x_shape"])))
            text = drawn(self.data["text_seed"], tuple(self.data["text_shape"]))
        self.text = text.transpose(0, 1)
        self.network = self.with_window(f"{size}_{name}", attention_window, ABSOLUTE_FROM[name])

    def with_window(self, name: str, attention_window: int, absolute_from: int) -> FlowMdm:
        return flow_mdm(name, int(self.data["weight_seed"]), absolute_from, attention_window)

    def asked(self, t: int, text: Tensor, network: FlowMdm | None = None) -> Tensor:
        return (network or self.network)(self.x, torch.tensor([t]), text, None, None, self.segment)


def names_and_shapes_are_those_of_the_published_checkpoints(name, features):
    with torch.device("meta"):
        network = FlowMdm(features, 512, 0)
    assert {key: tuple(value.shape) for key, value in network.state_dict().items()} == parameters(name)
    tables = {key: tuple(entry["shape"]) for key, entry in entries(name).items() if key not in parameters(name)}
    rows, width = network.positions.shape
    assert tables == {
        "sequence_pos_encoder.pe": (rows, 1, width),
        "embed_timestep.sequence_pos_encoder.pe": (rows, 1, width),
        "seqTransEncoder.attn_layers.rotary_pos_emb.relative.inv_freq": tuple(frequencies(ROTARY_DIM // 2).shape),
    }


@pytest.mark.skipif(not GOLDEN.exists(), reason=f"no golden numbers at {GOLDEN} (set STMC_GOLDEN)")
def test_weights_have_the_names_and_shapes_of_the_published_checkpoints(subtests):
    sizes = (("full_humanml", 263), ("full_babel", 135))
    checked(subtests, [(names_and_shapes_are_those_of_the_published_checkpoints, *each) for each in sizes])


def the_small_network_answers_as_published_in_both_modes(folder, name):
    case = Case(folder, "small", name, SHORT_WINDOW[name])
    modes = {t: t >= case.network.absolute_from for t in case.data["timesteps"].tolist()}
    assert list(modes.values()) == [True, True, False, False, False]
    for t in modes:
        text, null = case.asked(t, case.text), case.asked(t, 0 * case.text)
        close(text, frames(case.data[f"cond_t{t}"]))
        close(null, frames(case.data[f"uncond_t{t}"]))
        close(guide(text, null, float(case.data["guidance"])), frames(case.data[f"cfg_t{t}"]))


def what_stands_between_the_layers_is_as_published(folder, name):
    case = Case(folder, "small", name, SHORT_WINDOW[name])
    assert np.array_equal(_positions(case.segment, len(case.lengths)).numpy(), case.data["pos_pe_abs"])
    same = case.segment[0][:, None] == case.segment[0]
    assert np.array_equal(same.numpy(), case.data["pe_bias_is_zero"])
    encoder = case.network.seqTransEncoder
    modules = {"tokens_in": encoder.attn_layers, "project_in_out": encoder.project_in}
    modules |= {f"layer_{i}": layer[0][0] for i, layer in enumerate(encoder.attn_layers.layers)}
    modules |= {"final_norm": encoder.attn_layers.final_norm}
    for mode, t in zip(["ape", "rpe"], case.data["timesteps"].tolist()[1:3], strict=True):
        with watched(modules) as seen:
            case.asked(t, case.text)
        close(seen["project_in_out"][1], torch.from_numpy(case.data[f"{mode}_project_in_out"]))
        close(seen["layer_0"][0], torch.from_numpy(case.data[f"{mode}_tokens_in"]))
        for i in (0, 1, 2):
            close(seen[f"layer_{i + 1}"][0], torch.from_numpy(case.data[f"{mode}_after_sublayer_{i}"]))
        close(seen["final_norm"][0], torch.from_numpy(case.data[f"{mode}_after_sublayer_3"]))
        close(seen["final_norm"][1], torch.from_numpy(case.data[f"{mode}_final_norm"]))


def a_long_window_and_either_mode_at_any_step_are_as_published(folder, name):
    case = Case(folder, "small", name, SHORT_WINDOW[name])
    small = f"small_{name}"
    _, absolute, relative = case.data["timesteps"].tolist()[:3]
    far = case.with_window(small, 150, ABSOLUTE_FROM[name])
    for t in (absolute, relative):
        close(case.asked(t, case.text, far), frames(case.data[f"cond_h150_t{t}"]))
    close(case.asked(relative, case.text), frames(case.data[f"cond_chunked_t{relative}"]))
    always, never = (case.with_window(small, SHORT_WINDOW[name], step) for step in (0, STEPS))
    close(case.asked(0, case.text, always), frames(case.data["cond_allape_t0"]))
    close(case.asked(STEPS - 1, case.text, never), frames(case.data["cond_allrpe_t999"]))


def the_network_of_the_published_size_answers_as_published(folder, name):
    case = Case(folder, "full", name, HORIZON[name])
    assert sum(parameter.numel() for parameter in case.network.parameters()) == pytest.approx(18.39e6, rel=0.02)
    for t in case.data["timesteps"].tolist():
        close(case.asked(t, case.text), frames(case.data[f"cond_t{t}"]))
        close(case.asked(t, 0 * case.text), frames(case.data[f"uncond_t{t}"]))


class Fixed:
    """A denoiser of a golden batch: each row in the mode that was drawn for it."""

    def __init__(self, network: FlowMdm, relative) -> None:
        self.network, self.absolute = network, ~torch.from_numpy(relative)

    def __call__(self, x, t, text, text_mask, mask, segment=None) -> Tensor:
        return self.network.blended(x, t, self.network.encode_text(text), self.absolute, mask, segment)


def the_layout_of_training_and_its_loss_are_as_published(folder, name):
    data = golden(folder, f"flowmdm_train_{name}.npz")
    network = flow_mdm(f"small_{name}", int(data["weight_seed"]), STEPS, SHORT_WINDOW[name])
    motion, noise, text = frames(data["x"]), frames(data["noise"]), torch.from_numpy(data["text_embeddings"])
    present = torch.from_numpy(data["mask"]).squeeze(1).squeeze(1)
    if name == "babel":
        text = text.transpose(0, 1)
        lengths = [[length for length in row if length] for row in data["all_lengths"].tolist()]
        segment = segments(*lengths)
        assert np.array_equal(
            _positions(segment, text.shape[1])[present].numpy(), data["pos_pe_abs"][data["mask"][:, 0, 0]]
        )
    else:
        text, segment = text[:, None], None
        assert torch.equal(present, mask(torch.from_numpy(data["lengths"])))
    batch = Batch(motion, present, text, None, int(present.sum()), segment=segment)
    t, denoiser, schedule = (
        torch.from_numpy(data["timesteps"]),
        Fixed(network, data["is_relative"]),
        Schedule.cosine(STEPS),
    )
    x_t = schedule.q_sample(motion, t, noise)
    close(x_t[present], frames(data["x_t"])[present])
    out = batch.denoise(denoiser, x_t, t)
    close(out[present], frames(data["out_on_x_t"])[present])
    if "out_direct" in data:
        close(batch.denoise(denoiser, motion, t)[present], frames(data["out_direct"])[present])
    losses = [(out - motion)[row][present[row]].square().mean() for row in range(len(motion))]
    close(torch.stack(losses), torch.from_numpy(data["loss"]))
    errors = squared_errors(denoiser, schedule, batch, t, noise)
    per_row = torch.from_numpy(data["loss"]).double() * present.sum(dim=1)
    assert float(errors.double().mean()) == pytest.approx(float(per_row.sum()), rel=1e-4)


@SETS
def test_flow_mdm_is_the_published_network(folder, subtests):
    checks = (
        the_small_network_answers_as_published_in_both_modes,
        what_stands_between_the_layers_is_as_published,
        a_long_window_and_either_mode_at_any_step_are_as_published,
        the_network_of_the_published_size_answers_as_published,
        the_layout_of_training_and_its_loss_are_as_published,
    )
    checked(subtests, [(check, name) for check in checks for name in NAMES], folder)


@SETS
def test_a_whole_chain_over_three_texts_is_as_published(folder):
    """By the library's own way: a timeline, its plan, guided sequences composed, and `ddpm`."""
    data = golden(folder, "flowmdm_chain50.npz")
    steps, absolute = int(data["num_steps"]), int(data["bpe_denoising_step"])
    network = flow_mdm("chain24", int(data["weight_seed"]), steps - absolute + 1, int(data["rpe_horizon"]))
    edges = np.concatenate([[0], np.cumsum(data["lengths"])]).tolist()
    plans = plans_of(timeline(*[(str(i), *span) for i, span in enumerate(pairwise(edges))]), overlap=0)
    texts = torch.from_numpy(data["text_embeddings"])
    embeddings = {NULL: torch.zeros(1, texts.shape[2])} | {str(i): text for i, text in enumerate(texts)}
    schedule, rng = Schedule.cosine(steps), np.random.default_rng(int(data["noise_seed"]))
    columns = dict.fromkeys(BodyPart, range(0)) | {BodyPart.LEGS: range(data["x_T"].shape[1])}
    sequences = guided_sequences(network, schedule, plans, embeddings, float(data["guidance"]))
    predict, states = compose_tracks(sequences, plans, columns), []

    def draw(shape: torch.Size) -> Tensor:
        batch, count, features = shape
        return frames(rng.standard_normal((batch, features, 1, count)).astype(np.float32))

    def watched_predict(x: Tensor, t: int) -> Tensor:
        states.append((x, t))
        return predict(x, t)

    x = frames(data["x_T"])
    assert torch.equal(draw(x.shape), x)
    x0 = list(ddpm(watched_predict, schedule, x, draw, noise_scale="std"))
    for i, (iteration, t) in enumerate(zip(data["kept_iterations"], data["kept_t"], strict=True)):
        assert states[iteration][1] == t
        close(x0[iteration], frames(data["pred_xstart"][i]))
        after = states[iteration + 1][0] if t else x0[iteration]
        close(after, frames(data["samples"][i]))
