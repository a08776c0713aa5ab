"""FlowMDM's ablations (Tables 3 and 4): one encoding of time alone, and two other ways in for the condition. That each
is its equations stands in test_equations."""

import dataclasses

import pytest
import torch
from helpers.motions import walking
from helpers.scripts import run
from helpers.tiny_model import CONFIG, WIDTH, tiny
from torch import Tensor

from stmc.data.cache import Cache, Clip
from stmc.denoisers import FlowMdm
from stmc.denoisers.flow_mdm_layers import Attention, AttentionMask, CrossAttention, RotaryEmbedding
from stmc.diffusion.tensors import mask
from stmc.motion.representation import SmplRepresentation
from stmc.run import PARTS, RunError, build, load, save
from stmc.settings.records import SettingError

SIZES = {"width": 16, "feedforward": 32, "layers": 1, "heads": 2, "attention_window": 20}
ABLATIONS = (
    {"positions": "absolute"},
    {"positions": "relative"},
    {"conditioning": "sat"},
    {"conditioning": "cat"},
    {"positions": "relative", "conditioning": "cat"},
)


def network(**settings) -> FlowMdm:
    with torch.random.fork_rng():
        torch.manual_seed(0)
        made = FlowMdm(10, 4, 10, **SIZES | settings)
        with torch.no_grad():
            made.seqTransEncoder.pos_emb["absolute"].scale.fill_(2.0)
            for parameter in made.parameters():
                parameter.mul_(2.0)
    return made.eval()


def asked(t: int = 3, frames: int = 30) -> tuple[Tensor, Tensor, Tensor, None, None, Tensor]:
    draw = torch.Generator().manual_seed(1)
    x, text = torch.randn(1, frames, 10, generator=draw), torch.randn(1, 2, 4, generator=draw)
    return x, torch.tensor([t]), text, None, None, torch.arange(frames)[None] // (frames // 2)


@torch.no_grad()
@pytest.mark.parametrize(("alone", "absolute_from"), [("absolute", 0), ("relative", 1000)])
@pytest.mark.parametrize("t", [3, 15])
def test_positions_alone_are_those_of_the_blended_network_at_every_step_and_in_training(alone, absolute_from, t):
    blended, one = network(), network(positions=alone)
    blended.absolute_from = absolute_from
    expected = blended(*asked(t))
    assert torch.equal(one(*asked(t)), expected)
    one.seqTransEncoder.dropout.p, one.seqTransEncoder.attn_layers.stochastic_depth = 0.0, 0.0
    rows = one.train()(*repeated(20, asked(t)))
    torch.testing.assert_close(rows, expected.expand(20, -1, -1), atol=1e-4, rtol=0)


def repeated(count: int, given: tuple) -> list:
    return [None if each is None else each.repeat(count, *[1] * (each.ndim - 1)) for each in given]


def test_a_model_of_positions_alone_has_no_share_of_absolute_steps():
    flow = dataclasses.replace(tiny(), denoiser=FlowMdm(205, WIDTH, 90, **SIZES, positions="absolute"))
    assert flow.own_sampling.ape_steps is None
    with pytest.raises(SettingError, match=r"ape_steps=0\.1: the model has no such setting"):
        flow.generate("walk # 0 # 1", steps=1, ape_steps=0.1)
    both = dataclasses.replace(tiny(), denoiser=FlowMdm(205, WIDTH, 90, **SIZES))
    assert both.own_sampling.ape_steps == pytest.approx(0.1)


def test_the_condition_in_keys_and_values_needs_no_other_weights():
    shapes = [
        {key: value.shape for key, value in network(conditioning=kind).state_dict().items()}
        for kind in ("pccat", "sat")
    ]
    assert shapes[0] == shapes[1]


@torch.no_grad()
@pytest.mark.parametrize(("kind", "leaks"), [("pccat", False), ("sat", True), ("cat", True)])
def test_another_segment_s_text_comes_through_keys_and_values_alone(kind, leaks):
    """With one layer, a frame's answer depends on the text of its neighbours where the condition makes their keys."""
    x, t, text, _, _, segment = asked()
    other = torch.cat([text[:, :1], text[:, 1:] + 1], dim=1)
    before, after = (network(conditioning=kind)(x, t, each, None, None, segment) for each in (text, other))
    assert torch.equal(before[:, :15], after[:, :15]) is not leaks
    absolute = torch.tensor([15])
    before, after = (network(conditioning=kind)(x, absolute, each, None, None, segment) for each in (text, other))
    assert torch.equal(before[:, :15], after[:, :15])


@torch.no_grad()
def test_cross_attention_within_one_segment_is_the_value_of_its_condition():
    """A mean of equal values, whatever the queries and keys are."""
    with torch.random.fork_rng():
        torch.manual_seed(0)
        block = CrossAttention(16, 2)
        poses, told = torch.randn(2, 9, 16), torch.randn(2, 1, 16)
    rows = torch.tensor([True, False])
    seen = AttentionMask(9, 4, mask(torch.tensor([9, 6])), None, rows)
    mixed = block(poses, told.expand(-1, 9, -1), RotaryEmbedding.of(9, ~rows), seen.attention())
    torch.testing.assert_close(mixed, block.to_out(block.to_v(told)).expand(-1, 9, -1), atol=1e-5, rtol=0)


@pytest.mark.parametrize("conditioning", ["sat", "cat"])
def test_every_weight_learns(conditioning):
    flow = network(conditioning=conditioning).train()
    flow.seqTransEncoder.attn_layers.stochastic_depth = 0.0
    flow(*repeated(8, asked())).square().mean().backward()
    assert [name for name, each in flow.named_parameters() if each.grad is None or not each.grad.abs().max() > 0] == []
    kinds = [type(block) for _, block in flow.seqTransEncoder.attn_layers.layers if isinstance(block, Attention)]
    assert len(kinds) == (2 if conditioning == "cat" else 1)


@pytest.mark.parametrize(("setting", "value"), [("positions", "rotary"), ("conditioning", "film")])
def test_an_unknown_ablation_is_an_error_with_the_choices(setting, value):
    described = {"_target_": "stmc.denoisers.FlowMdm", "features": 205, "text_width": 4, "absolute_from": 90}
    with pytest.raises(RunError, match=rf"denoiser.{setting}='{value}': must be one of (blended|pccat), \w+, \w+"):
        build({"denoiser": described | {setting: value}}, {"denoiser": PARTS["denoiser"]})


@pytest.mark.parametrize("ablation", ABLATIONS, ids=str)
def test_an_ablation_loads_as_what_it_was(ablation, tmp_path):
    described = {"_target_": "stmc.denoisers.FlowMdm", "features": 205, "text_width": WIDTH, "absolute_from": 90}
    flow = dataclasses.replace(
        tiny(),
        denoiser=FlowMdm(205, WIDTH, 90, **SIZES, **ablation),
        config=CONFIG | {"denoiser": described | SIZES | ablation},
    )
    save(flow, tmp_path / "run", "card")
    again = load(tmp_path / "run").denoiser
    given = (torch.randn(1, 30, 205), torch.tensor([3]), torch.randn(1, 2, WIDTH))
    given = (*given, None, None, torch.arange(30)[None] // 15)
    torch.testing.assert_close(again(*given), flow.denoiser.eval()(*given), atol=1e-6, rtol=0)


@pytest.mark.slow
@pytest.mark.parametrize("ablation", ABLATIONS[2:], ids=str)
def test_an_ablation_is_trained_by_its_setting_and_samples(ablation, tmp_path):
    rows, clips = SmplRepresentation().encode(walking(2.0, 20.0)).float(), []
    for number in range(6):
        start, split = number * len(rows), "val" if number == 5 else "train"
        clips.append(Clip(f"{number}", "walk", "", "walk", (), False, False, split, start, start + len(rows)))
    Cache(20, "smpl", rows.repeat(6, 1), tuple(clips), {"walk": (("walk", 1.0),)}).write(tmp_path / "cache")
    sizes = SIZES | ablation
    settings = [f"denoiser.{name}={value}" for name, value in sizes.items()]
    settings += [f"run={tmp_path / 'run'}", f"data.folder={tmp_path / 'cache'}", f"text_cache={tmp_path / 'texts'}"]
    settings += [
        "device=cpu",
        "threads=1",
        "training.steps=2",
        "training.warmup=1",
        "validation=1",
        "draw=['w # 0 # 1']",
    ]
    settings += [f"data.sampling.{name}=1" for name in ("pool", "pieces")] + ["data.sampling.rows=4"]
    run("train", "train", "denoiser=flow_mdm_small", *settings)
    model = load(tmp_path / "run")
    [motion] = model.generate("walk # 0 # 1\nwalk # 1 # 2", steps=2, method="flow_mdm")
    assert motion.frames == 40
