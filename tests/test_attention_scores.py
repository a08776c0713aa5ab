"""What FlowMDM attends to, step by step: held to a softmax written out, and to the window and segments it may see."""

import dataclasses

import numpy as np
import pytest
import torch
from helpers.scripts import run
from helpers.tiny_model import CONFIG, WIDTH, tiny
from test_methods import OneWord

from stmc.denoisers import FlowMdm, recorded_attention
from stmc.evaluation.results import ResultError
from stmc.evaluation.results.composition_charts import attention_curves
from stmc.run import load, save
from stmc.settings.records import SettingError


def network(layers: int = 1, window: int = 5, **settings) -> FlowMdm:
    with torch.random.fork_rng():
        torch.manual_seed(0)
        return FlowMdm(6, 4, 10, 8, 8, layers, 2, window, **settings).eval()


def asked(t: int, frames: int = 12):
    draw = torch.Generator().manual_seed(1)
    x, text = torch.randn(1, frames, 6, generator=draw), torch.randn(1, 2, 4, generator=draw)
    return x, torch.tensor([t]), text, None, None, torch.arange(frames)[None] // 6


@torch.no_grad()
def test_scores_are_a_softmax_over_what_a_frame_may_see():
    """In an absolute step, where keys are not turned."""
    made, seen = network(), []
    block = made.seqTransEncoder.attn_layers.layers[0][1]
    handle = block.register_forward_pre_hook(lambda _, given: seen.append(given[:2]))
    with recorded_attention(made) as calls:
        made(*asked(15))
    handle.remove()
    (poses, condition), frame = seen[0], torch.arange(12)
    query = block.to_q(block.custom_query_fn(torch.cat([poses, condition], dim=-1)))[0].unflatten(1, (2, 64))
    key = block.to_k(poses)[0].unflatten(1, (2, 64))
    table = torch.einsum("qhc,khc->hqk", query, key) / 8
    near = (frame[:, None] - frame).abs() <= 5
    expected = table.masked_fill(~(near & (frame[:, None] // 6 == frame // 6)), -torch.inf).softmax(dim=2).mean(dim=0)
    torch.testing.assert_close(calls[0][0], expected, atol=1e-5, rtol=0)


@torch.no_grad()
@pytest.mark.parametrize("window", [2, 40])
def test_rows_sum_to_one_within_the_window_and_nothing_is_recorded_afterwards(window):
    made, frame = network(3, window, conditioning="cat"), torch.arange(12)
    plain = made(*asked(3))
    with recorded_attention(made) as calls:
        assert torch.equal(made(*asked(3)), plain)
        made(*asked(15))
    with recorded_attention(made, slice(7, 8)) as chosen:
        made(*asked(3))
    made(*asked(3))
    assert len(chosen) == 1
    torch.testing.assert_close(chosen[0], calls[0][:, 7:8])
    assert [tuple(each.shape) for each in calls] == [(1, 12, 12)] * 2
    for each in calls:
        torch.testing.assert_close(each.sum(dim=2), torch.ones(1, 12))
        assert not each[0][(frame[:, None] - frame).abs() > window].any()
    assert calls[0][0, 5, 6] > 0 and calls[1][0, 5, 6] == 0


def flow():
    """A model of FlowMDM's network that reads bundled words."""
    sizes = {"width": 16, "feedforward": 32, "layers": 1, "heads": 2, "attention_window": 20, "absolute_from": 90}
    with torch.random.fork_rng():
        torch.manual_seed(0)
        denoiser = FlowMdm(features=205, text_width=WIDTH, **sizes).eval()
    described = {"_target_": "stmc.denoisers.FlowMdm", "features": 205, "text_width": WIDTH} | sizes
    text_encoder = CONFIG["text_encoder"] | {"pooling": "mean"}
    config = CONFIG | {"denoiser": described, "text_encoder": text_encoder}
    return dataclasses.replace(tiny(), denoiser=denoiser, text_encoder=OneWord(), config=config)


def test_a_sampler_calls_once_a_step_and_the_figure_has_a_curve_for_each():
    model = flow()
    with recorded_attention(model.denoiser) as calls:
        model.generate("walk # 0 # 1", steps=4, method="flow_mdm", ape_steps=1.0)
    assert len(calls) == 4
    [axes] = attention_curves(torch.cat([each[0, 5:6] for each in calls]).numpy(), 5).axes
    curves = [line for line in axes.lines if len(line.get_xdata()) == 20]
    assert len(curves) == 4 and curves[0].get_xdata()[0] == -5
    first, last = (curves[place].get_color() for place in (0, -1))
    assert first[2] > first[0] and last[0] > last[2]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A run directory of such a model."""
    place = tmp_path_factory.mktemp("run") / "flow"
    save(flow(), place, "card")
    return place


def test_the_command_draws_what_the_middle_frame_attends_to_and_says_how_far_away_it_is(folder, tmp_path, capsys):
    """Held to the scores of all frames, and to a mean of distances written out."""
    run("attention", "attention", f"model={folder}", "timeline='walk # 0 # 1.5'", "steps=6", f"output={tmp_path}")
    told = capsys.readouterr().out
    found = np.load(tmp_path / "attention.npz")
    model = load(folder)
    with recorded_attention(model.denoiser) as calls:
        model.generate("walk # 0 # 1.5", steps=6, method="flow_mdm", ape_steps=1.0)
    expected = torch.stack([each[0, 15] for each in calls])
    assert (int(found["frame"]), found["scores"].shape) == (15, (6, 30))
    torch.testing.assert_close(torch.from_numpy(found["scores"]), expected, atol=1e-6, rtol=0)
    far = [sum(abs(other - 15) * float(row[other]) for other in range(30)) for row in expected]
    np.testing.assert_allclose(found["distance"], far, rtol=1e-5)
    assert "Attention of frame 15" in told and f"{far[0]:.1f}" in told and "6 of 6" in told
    assert (tmp_path / "attention.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        (["frame=20", "timeline='walk # 0 # 1'"], "frame=20: the last frame of the timeline is 19"),
        (["timeline='walk # 0 # 1 # legs\nwave # 0 # 1 # left arm'"], "timeline has 2 tracks"),
    ],
)
def test_what_the_command_cannot_draw_is_one_sentence(settings, message, folder, tmp_path):
    with pytest.raises(SettingError, match=message):
        run("attention", "attention", f"model={folder}", f"output={tmp_path / 'out'}", *settings)
    assert not (tmp_path / "out").exists()


def test_the_command_refuses_a_model_without_such_attention(tmp_path):
    save(tiny(), tmp_path / "model", "card")
    with pytest.raises(ValueError, match="MdmSmpl has no FlowMDM attention"):
        run("attention", "attention", f"model={tmp_path / 'model'}", f"output={tmp_path / 'out'}")


def test_what_has_no_such_attention_and_what_is_no_frame_are_errors():
    with pytest.raises(ValueError, match=r"MdmSmpl has no FlowMDM attention"), recorded_attention(tiny().denoiser):
        pass
    with pytest.raises(ResultError, match="0 steps and frame 3 of 9"):
        attention_curves(np.zeros((0, 9)), 3)
    with pytest.raises(ResultError, match="1 steps and frame 9 of 9"):
        attention_curves(np.eye(9)[:1], 9)
