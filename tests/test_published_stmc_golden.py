"""One step of STMC with MDM and MotionDiffuse, through the collage and guidance of every other network: parity with
their published integrations."""

import numpy as np
import pytest
import torch
from conftest import checked, golden, golden_sets
from helpers.published_networks import close, drawn, frames, limit_at, mdm, motion_diffuse, words_of
from torch import Tensor

from stmc.composing import NULL, canvas_lengths, collage, crop_lengths, guided_crops
from stmc.diffusion import Schedule
from stmc.motion.body import BodyPart
from stmc.motion.representation import HUMANML3D_LAYOUT
from stmc.timeline import Prompt, Timeline
from stmc.timeline.planning import Plan, plan

pytestmark = pytest.mark.golden
SETS = pytest.mark.parametrize("folder", golden_sets("mdm"))
COLUMNS = HUMANML3D_LAYOUT.columns
FPS = 20


def plans(folder, name: str) -> list[Plan]:
    """Those of the timelines A or B, checked against the published crops."""
    found = []
    for entry in golden(folder, "stmc_timelines.json")[name]:
        prompts = [
            Prompt(
                each["text"], each["start"] / FPS, each["end"] / FPS, frozenset(map(BodyPart.parse, each["bodyparts"]))
            )
            for each in entry["timeline"]
        ]
        found.append(plan(Timeline(tuple(prompts)), FPS, entry["overlap"]))
        crops = zip(entry["crop_texts"], entry["crop_starts"], entry["crop_ends"], strict=True)
        assert [(crop.text or NULL, crop.start, crop.end) for crop in found[-1].crops] == list(crops)
        assert found[-1].frames == entry["max_t"]
    return found


def columns_of_the_body_parts_are_those_of_the_published_code(folder):
    published = golden(folder, "stmc_timelines.json")["body_part_indices"]
    assert {BodyPart.parse(part): tuple(own) for part, own in published.items()} == COLUMNS


def a_step_with_given_answers_is_that_of_the_published_integrations(folder, network):
    """MDM's crops all go on for as many frames; of MotionDiffuse each keeps its own length."""
    data, given = golden(folder, f"stmc_{network}_stub_step.npz"), plans(folder, "A")
    eps = network == "md"
    window = None if eps else int(data["max_frames"])
    schedule = Schedule.linear(1000) if eps else Schedule.cosine(1000)
    named = "eps" if eps else "pred"
    answers = drawn(data[f"{named}_seed"], data[f"{named}_shape"]) * torch.from_numpy(data[f"{named}_scale"])
    canvas = drawn(data["x_seed"], data["x_shape"])
    canvas, answers = (canvas, answers) if eps else (frames(canvas), frames(answers))
    x = canvas[:, : max(canvas_lengths(given, window))]
    for t in data["t_values"].tolist():

        def predict(crops: Tensor, t: int) -> Tensor:
            if window is not None:
                sums, sizes = crops.double().sum(dim=(1, 2)), crops.double().abs().sum(dim=(1, 2))
                assert ((sums - torch.from_numpy(data["crops_checksum"])).abs() <= 1e-5 * sizes).all()
            answered = answers[:, : crops.shape[1]]
            return schedule.to_x0(answered, crops, t, "eps") if eps else answered

        x0 = collage(predict, given, COLUMNS, window)(x, t)
        x0 = torch.nn.functional.pad(x0, (0, 0, 0, canvas.shape[1] - x0.shape[1]))
        expected = {name: data[f"t{t}/{name}"] for name in ("pred_xstart", "mean", "sample_first4")}
        expected = {name: torch.from_numpy(each) if eps else frames(each) for name, each in expected.items()}
        close(x0[:, : expected["pred_xstart"].shape[1]], expected["pred_xstart"])
        mean, variance = schedule.posterior(x0, canvas, t)
        close(mean[:, : expected["mean"].shape[1]], expected["mean"])
        noise = drawn(data["noise_seed"], data["x_shape"])
        sample = mean + variance.sqrt() * (noise if eps else frames(noise))
        close(sample[:, : expected["sample_first4"].shape[1]], expected["sample_first4"])


def a_step_with_mdm_is_that_of_the_published_integration(folder):
    data, given = golden(folder, "stmc_mdm_model_step.npz"), plans(folder, "B")
    network, schedule, t = mdm(int(data["weight_seed"])), Schedule.cosine(1000), int(data["t"])
    table = {
        str(key): torch.from_numpy(row)[None]
        for key, row in zip(data["text_table_keys"], data["text_table"], strict=True)
    }
    table[NULL] = torch.zeros_like(table[NULL])
    x = frames(drawn(data["x_seed"], data["x_shape"]))
    close(x[:, :4], frames(data["x_first4"]))
    assert x.shape[1] == max(canvas_lengths(given, network.fixed_length))
    how, seen = {"supports_padding": network.supports_padding, "fixed_length": network.fixed_length}, []
    crops = guided_crops(network, schedule, given, table, float(data["scale"]), **how)
    predict = collage(lambda x, t: seen.append(crops(x, t)) or seen[-1], given, COLUMNS, network.fixed_length)
    x0 = predict(x, t)
    close(seen[0][:, :2], frames(data["crop_preds_first2"]), limit_at(t))
    longest = int(data["max_t"].max())
    close(x0[:, :longest], frames(data["pred_xstart"]), limit_at(t))
    mean, variance = schedule.posterior(x0, x, t)
    expected = frames(data["mean"])
    close(mean[:, : expected.shape[1]], expected, limit_at(t))
    close(mean[:, -4:], frames(data["mean_tail4"]))
    np.testing.assert_allclose(variance.item(), data["variance"], rtol=1e-5)


def a_step_with_motion_diffuse_is_that_of_the_published_integration(folder):
    data, given = golden(folder, "stmc_md_model_step.npz"), plans(folder, "B")
    network, schedule, t = motion_diffuse(int(data["weight_seed"])), Schedule.linear(1000), int(data["t"])
    features = torch.stack([drawn(seed, (77, 1, 512))[:, 0] for seed in data["feat_seeds"]])
    words = words_of(features, data["eot"])
    texts = [crop.text or NULL for plan in given for crop in plan.crops]
    table = {text: words[index] for text, index in zip(texts, data["crop_text_index"], strict=True)}
    assert crop_lengths(given, network.fixed_length) == tuple(data["lengths"])
    x = drawn(data["x_seed"], tuple(data["x_shape"]))
    length = int(data["max_t"].max())
    crops = guided_crops(network, schedule, given, table, 1.0, "eps", supports_padding=network.supports_padding)
    seen = []
    predict = collage(lambda x, t: seen.append((x, crops(x, t))) or seen[-1][1], given, COLUMNS, network.fixed_length)
    x0 = predict(x[:, :length], t)
    noisy, clean = seen[0]
    close(schedule.from_x0(clean, noisy, t, "eps")[:, :2], data["crop_eps_first2"], limit_at(t))
    close(x0, data["pred_xstart"], limit_at(t))
    mean, variance = schedule.posterior(x0, x[:, :length], t)
    close(mean[:, : data["mean"].shape[1]], data["mean"], limit_at(t))
    tail, _ = schedule.posterior(torch.zeros_like(x[:, -4:]), x[:, -4:], t)
    close(tail, data["mean_tail4"])
    np.testing.assert_allclose(variance.item(), data["variance"], rtol=1e-5)


@SETS
def test_a_step_is_that_of_the_published_integrations(folder, subtests):
    checked(
        subtests,
        [
            columns_of_the_body_parts_are_those_of_the_published_code,
            (a_step_with_given_answers_is_that_of_the_published_integrations, "mdm"),
            (a_step_with_given_answers_is_that_of_the_published_integrations, "md"),
        ],
        folder,
    )


@pytest.mark.slow
@SETS
def test_a_step_with_the_published_networks_is_that_of_the_published_integrations(folder, subtests):
    """The networks by themselves, and the steps with given answers, are of the default tier."""
    checked(
        subtests,
        [
            a_step_with_mdm_is_that_of_the_published_integration,
            a_step_with_motion_diffuse_is_that_of_the_published_integration,
        ],
        folder,
    )
