"""What FlowMDM attends to, step by step: held to a softmax written out, and to the window and segments it may see."""

import dataclasses

import pytest
import torch
from helpers.tiny_model import WIDTH, tiny
from test_methods import OneWord

from stmc.denoisers import FlowMdm, recorded_attention
from stmc.results import ResultError
from stmc.results.composition_charts import attention_curves


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
    made(*asked(3))
    assert [tuple(each.shape) for each in calls] == [(1, 12, 12)] * 2
    for each in calls:
        torch.testing.assert_close(each.sum(dim=2), torch.ones(1, 12))
        assert not each[0][(frame[:, None] - frame).abs() > window].any()
    assert calls[0][0, 5, 6] > 0 and calls[1][0, 5, 6] == 0


def test_a_sampler_calls_once_a_step_and_the_figure_has_a_curve_for_each():
    with torch.random.fork_rng():
        torch.manual_seed(0)
        denoiser = FlowMdm(205, WIDTH, 90, 16, 32, 1, 2, 20).eval()
    flow = dataclasses.replace(tiny(), denoiser=denoiser, text_encoder=OneWord())
    with recorded_attention(flow.denoiser) as calls:
        flow.generate("walk # 0 # 1", steps=4, method="flow_mdm", ape_steps=1.0)
    assert len(calls) == 4
    [axes] = attention_curves([each[0].numpy() for each in calls], 5).axes
    curves = [line for line in axes.lines if len(line.get_xdata()) == 20]
    assert len(curves) == 4 and curves[0].get_xdata()[0] == -5
    first, last = (curves[place].get_color() for place in (0, -1))
    assert first[2] > first[0] and last[0] > last[2]


def test_what_has_no_such_attention_and_what_is_no_frame_are_errors():
    with pytest.raises(ValueError, match=r"MdmSmpl has no attention of FlowMDM's"), recorded_attention(tiny().denoiser):
        pass
    with pytest.raises(ResultError, match="0 steps, and frame 3 of 0"):
        attention_curves([], 3)
    with pytest.raises(ResultError, match="1 steps, and frame 9 of 9"):
        attention_curves([torch.eye(9).numpy()], 9)
