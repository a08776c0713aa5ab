"""MDM's two architectures and its sampling: parity with the published code."""

import numpy as np
import pytest
import torch
from conftest import GOLDEN, checked, golden, golden_sets
from helpers.published_networks import (
    close,
    close_waves,
    drawn,
    entries,
    frames,
    interleaved,
    limit_at,
    mdm,
    mdm_decoder,
    watched,
    waves,
    weight,
)

from stmc.denoisers import MdmDecoder, MdmEncoder, MotionDiffuse
from stmc.diffusion import Schedule, ddpm, guide
from stmc.diffusion.tensors import mask

pytestmark = [pytest.mark.golden, pytest.mark.slow]  # networks of the published sizes
SETS = pytest.mark.parametrize("folder", golden_sets("mdm"))
NAMES = ["mdm_trans_enc", "mdm_trans_dec_clip", "mdm_trans_dec_clip_emb", "mdm_trans_dec_bert", "motiondiffuse_t2m"]


def cases(data: dict) -> list[dict]:
    """The cases of a file, each with its keys without "cN/"; none is forgotten."""
    found = [
        {key.removeprefix(f"c{i}/"): value for key, value in data.items() if key.startswith(f"c{i}/")}
        for i in range(int(data["n_cases"]))
    ]
    assert all(found)
    return found


def words(case: dict) -> torch.Tensor:
    return torch.from_numpy(case["text_embed"])[:, None]


def present(case: dict) -> torch.Tensor:
    return mask(torch.from_numpy(case["lengths"]), case["x"].shape[-1])


def names_and_shapes_are_those_of_the_published_checkpoints(name):
    if name == "motiondiffuse_t2m":
        network = MotionDiffuse(263, 512)
    elif name == "mdm_trans_enc":
        network = MdmEncoder(263, 512)
    else:
        network = MdmDecoder(263, 768 if name.endswith("bert") else 512)
    expected = {key: tuple(entry["shape"]) for key, entry in entries(name).items() if entry["kind"] == "parameter"}
    assert {key: tuple(value.shape) for key, value in network.state_dict().items()} == expected
    tables = [tuple(entry["shape"]) for entry in entries(name).values() if entry["kind"] == "buffer"]
    assert all(shape == (len(network.positions), 1, network.positions.shape[1]) for shape in tables)


def the_recipe_of_weights_is_understood():
    for probe in golden(GOLDEN / "mdm", "weights_convention_probe.json"):
        values = weight(probe["name"], tuple(probe["shape"]), probe["layernorm_weight"], probe["seed"]).flatten()
        assert values[:4].tolist() == probe["first4"] and values[-1].item() == probe["last"]


@pytest.mark.skipif(not GOLDEN.exists(), reason=f"no golden numbers at {GOLDEN} (set STMC_GOLDEN)")
def test_weights_have_the_names_and_shapes_of_the_published_checkpoints(subtests):
    names = ((names_and_shapes_are_those_of_the_published_checkpoints, name) for name in NAMES)
    with torch.device("meta"):
        checked(subtests, names)
    checked(subtests, [the_recipe_of_weights_is_understood])


def the_encoder_answers_as_the_published_network(folder):
    data = golden(folder, "mdm_enc_forward.npz")
    network = mdm(int(data["weight_seed"]))
    for case in cases(data):
        x, t, text = frames(case["x"]), torch.from_numpy(case["t"]), words(case)
        conditional, null = network(x, t, text), network(x, t, torch.zeros_like(text))
        limit = limit_at(t)
        close(network._step(t)[:, 0], case["time_emb"][0], limit)
        close(conditional, frames(case["out_cond"]), limit)
        close(null, frames(case["out_uncond"]), limit)
        expected = frames(case.get("out_cfg", case.get("out_cfg_first8")))
        guided = [
            guide(one[None], other[None], float(scale))
            for one, other, scale in zip(conditional, null, case["scale"], strict=True)
        ]
        close(torch.cat(guided)[:, : expected.shape[1]], expected, limit)


def every_layer_of_the_encoder_is_that_of_the_published_network(folder):
    data = golden(folder, "mdm_enc_trace.npz")
    network = mdm(int(data["weight_seed"]))
    x, t, text = frames(data["x"]), torch.from_numpy(data["t"]), words(data)
    layers = {f"layer{i}": layer for i, layer in enumerate(network.seqTransEncoder.layers)}
    with watched(layers) as seen:
        out = network(x, t, text)
    close(seen["layer0"][0], data["trace/encoder_in"].swapaxes(0, 1), limit_at(t))
    for name in layers:
        close(seen[name][1], data[f"trace/{name}"].swapaxes(0, 1), limit_at(t))
    close(network._step(t)[0], data["trace/embed_timestep"][0], limit_at(t))
    close(network.encode_text(text), data["trace/embed_text"])
    close(network.input_process["poseEmbedding"](x), data["trace/input_process"].swapaxes(0, 1))
    close(out, frames(data["out"]), limit_at(t))
    rows = torch.from_numpy(data["pe_rows_index"])
    for table in (network.positions[rows], data["pe_rows"]):
        close_waves(table, interleaved(*waves(rows, network.positions.shape[1])), rows)
    steps = torch.from_numpy(data["time_emb_index"])
    close(network._step(steps)[:, 0], data["time_emb"], limit_at(steps))


def frames_that_are_masked_are_not_attended_to(folder):
    data = golden(folder, "mdm_enc50_maskframes.npz")
    network = mdm(int(data["weight_seed"]))
    for case in cases(data):
        x, t, text = frames(case["x"]), torch.from_numpy(case["t"]), words(case)
        assert (present(case).numpy() == case["mask"][:, 0, 0]).all()
        close(network(x, t, text, None, present(case)), frames(case["out_cond_masked"]), limit_at(t))
        close(
            network(x, t, torch.zeros_like(text), None, present(case)), frames(case["out_uncond_masked"]), limit_at(t)
        )
        close(network(x, t, text)[:, :1], frames(case["out_cond_nomask_frame0"]), limit_at(t))


@SETS
def test_mdm_s_encoder_is_the_published_network(folder, subtests):
    checked(
        subtests,
        [
            the_encoder_answers_as_the_published_network,
            every_layer_of_the_encoder_is_that_of_the_published_network,
            frames_that_are_masked_are_not_attended_to,
        ],
        folder,
    )


def the_decoder_answers_as_the_published_network(folder):
    data = golden(folder, "mdm_dec_clip.npz")
    network = mdm_decoder("mdm_trans_dec_clip", int(data["weight_seed"]))
    for case in cases(data):
        x, t, text = frames(case["x"]), torch.from_numpy(case["t"]), words(case)
        close(network(x, t, text), frames(case["out_cond"]), limit_at(t))
        close(network(x, t, torch.zeros_like(text)), frames(case["out_uncond"]), limit_at(t))


def both_rules_of_the_decoders_leading_token_are_those_of_the_published_network(folder, leading, suffix):
    data = golden(folder, "mdm_dec_clip_emb.npz")
    network = mdm_decoder("mdm_trans_dec_clip_emb", int(data["weight_seed"]), leading=leading)
    for case in cases(data):
        x, t, text = frames(case["x"]), torch.from_numpy(case["t"]), words(case)
        for kind, told in (("cond", text), ("uncond", torch.zeros_like(text))):
            expected = frames(case[f"out_{kind}_{suffix}"])
            torch.testing.assert_close(network(x, t, told), expected, atol=1e-4, rtol=0)


def the_decoder_reads_the_words_of_distilbert_as_the_published_network(folder):
    data = golden(folder, "mdm_dec_bert.npz")
    network = mdm_decoder("mdm_trans_dec_bert", int(data["weight_seed"]), text_width=768)
    for case in cases(data):
        x, t = frames(case["x"]), torch.from_numpy(case["t"])
        text = torch.from_numpy(case["tokens"]).transpose(0, 1)
        exists = ~torch.from_numpy(case["token_pad_mask"])
        close(network(x, t, text, exists, present(case)), frames(case["out_cond"]), limit_at(t))
        none = text.new_zeros(len(text), 1, text.shape[-1])
        close(network(x, t, none, None, present(case)), frames(case["out_uncond"]), limit_at(t))


@SETS
def test_mdm_s_decoders_are_the_published_networks(folder, subtests):
    checked(
        subtests,
        [
            the_decoder_answers_as_the_published_network,
            (both_rules_of_the_decoders_leading_token_are_those_of_the_published_network, "step", "head"),
            (both_rules_of_the_decoders_leading_token_are_those_of_the_published_network, "step_and_text", "8139dda"),
            the_decoder_reads_the_words_of_distilbert_as_the_published_network,
        ],
        folder,
    )


def schedules_are_those_of_the_published_code(folder):
    data = golden(folder, "diffusion_tables.npz")
    for name in {key.split("/")[0] for key in data}:
        table = {key.split("/")[1]: value for key, value in data.items() if key.startswith(f"{name}/")}
        kind, steps = next(part for part in name.split("_") if part in ("cosine", "linear")), name.split("_T")[1]
        schedule = getattr(Schedule, kind)(int(steps.split("_")[0]))
        if name.startswith("spaced"):
            times = tuple(table["timestep_map"].tolist())
            if "_to" in name:
                assert schedule.spaced(len(times)) == times
            schedule = schedule.respaced(times)
        compare_tables(schedule, table)


def compare_tables(schedule: Schedule, table: dict) -> None:
    bar, before, beta = schedule.alpha_bar, schedule.alpha_bar_before, schedule.beta
    again = (1 - beta).cumprod(dim=0)  # as published, where a respaced table has rounding errors that ours has not
    actual = {
        "betas": beta,
        "alphas_cumprod": bar,
        "alphas_cumprod_prev": before,
        "sqrt_alphas_cumprod": bar.sqrt(),
        "sqrt_one_minus_alphas_cumprod": (1 - bar).sqrt(),
        "sqrt_recip_alphas_cumprod": (1 / again).sqrt(),
        "sqrt_recipm1_alphas_cumprod": (1 / again - 1).sqrt(),
    }
    for name, values in actual.items():
        np.testing.assert_allclose(values.numpy(), table[name], rtol=3e-13, atol=3e-13, err_msg=name)
    one, zero = torch.ones(1, dtype=torch.float64), torch.zeros(1, dtype=torch.float64)
    for t in range(schedule.steps):
        clean, variance = schedule.posterior(one, zero, t)
        noisy, _ = schedule.posterior(zero, one, t)
        found = (clean.item(), noisy.item(), variance.item())
        names = ("posterior_mean_coef1", "posterior_mean_coef2", "posterior_variance")
        np.testing.assert_allclose(found, [table[name][t] for name in names], rtol=0, atol=3e-13)


def posterior_steps_are_those_of_the_published_code(folder):
    data = golden(folder, "mdm_posterior_steps.npz")
    schedule = Schedule.cosine(1000)
    for t in data["t_values"].tolist():
        step = {key: value for key, value in data.items() if key.startswith(f"t{t}/")}
        x, x0, noise = (frames(step[f"t{t}/{key}"]) for key in ("x_t", "x0", "noise"))
        mean, variance = schedule.posterior(x0, x, t)
        close(mean, frames(step[f"t{t}/mean"]))
        np.testing.assert_allclose(variance.item(), step[f"t{t}/variance"], rtol=1e-5)
        close(mean + variance.sqrt() * noise, frames(step[f"t{t}/sample"]))


def fifty_steps_of_ancestral_sampling_are_those_of_the_published_code(folder):
    data = golden(folder, "mdm_enc50_sampling.npz")
    network, text, scale = mdm(int(data["weight_seed"])), words(data), float(data["scale"][0])
    states, noises = [], np.random.default_rng(int(data["noise_seed"]))

    def predict(x: torch.Tensor, t: int) -> torch.Tensor:
        states.append(x)
        step = torch.full((len(x),), t)
        return guide(network(x, step, text), network(x, step, torch.zeros_like(text)), scale)

    def draw(shape) -> torch.Tensor:
        published = noises.standard_normal((shape[0], shape[2], 1, shape[1])).astype(np.float32)
        return frames(published)

    schedule = Schedule.cosine(50)
    x_last = frames(data["x_T"])
    x0 = list(ddpm(predict, schedule, x_last, draw, noise_scale="std"))
    assert len(x0) == int(data["n_noise_draws"])
    for t in data["snapshot_t"].tolist():
        at = len(x0) - 1 - t
        close(x0[at], frames(data[f"x0_at_t{t}"]), 2e-5)
        after = states[at + 1] if t else x0[-1]
        close(after, frames(data[f"x_after_t{t}"]), 2e-5)
    assert torch.equal(x_last, frames(drawn(data["xT_seed"], data["x_T"].shape)))


@SETS
@pytest.mark.filterwarnings("ignore:The given NumPy array is not writable")
def test_mdm_is_sampled_as_by_the_published_code(folder, subtests):
    checked(
        subtests,
        [
            schedules_are_those_of_the_published_code,
            posterior_steps_are_those_of_the_published_code,
            fifty_steps_of_ancestral_sampling_are_those_of_the_published_code,
        ],
        folder,
    )
