"""Every other rule of composing through a tiny random model: lengths, seeds, and what each leaves alone."""

import dataclasses
from collections.abc import Sequence

import pytest
import torch
from test_model import GAP, NOD, THREE, WALK_WAVE, apart
from tiny import WIDTH, Hashes, tiny
from torch import Tensor

from stmc.denoisers import FlowMdm
from stmc.diffusion import ddim, ddpm, dpm_solver
from stmc.geometry import matrix_to_rows
from stmc.model import Model
from stmc.settings import SettingError
from stmc.statistics import Statistics
from stmc.timeline import Timeline, single_track

RULES = ("stmc_paper", "multi_diffusion", "double_take", "sinc_slerp", "flow_mdm")


class OneWord(Hashes):
    """The mean of a text's words."""

    def encode(self, texts: Sequence[str]) -> tuple[Tensor, Tensor]:
        words, lengths = super().encode(texts)
        return words.sum(dim=1, keepdim=True) / lengths[:, None, None], torch.ones_like(lengths)


@pytest.fixture(scope="module")
def flow() -> Model:
    with torch.random.fork_rng():
        torch.manual_seed(0)
        network = FlowMdm(205, WIDTH, absolute_from=90, width=16, feedforward=32, layers=1, heads=2, horizon=20)
    return dataclasses.replace(tiny(), denoiser=network.eval().requires_grad_(False), text_encoder=OneWord())


@pytest.mark.parametrize("method", RULES)
@pytest.mark.parametrize("sampler", [ddpm, ddim, dpm_solver])
def test_every_rule_and_sampler_gives_each_timeline_its_motion(flow, sampler, method):
    motions = flow.generate(THREE, steps=4, sampler=sampler, method=method)
    assert [motion.frames for motion in motions] == [timeline.frames(20) for timeline in THREE]


@pytest.mark.parametrize("method", RULES)
def test_a_motion_belongs_to_its_seed_and_not_to_its_batch(flow, method):
    batch = flow.generate(THREE, seed=[5, 6, 7], steps=4, method=method)
    for seed, timeline, motion in zip([5, 6, 7], THREE, batch, strict=True):
        alone = flow.generate(timeline, seed=seed, steps=4, method=method)[0]
        assert apart(motion, alone) < 1e-4
        assert apart(alone, flow.generate(timeline, seed=8, steps=4, method=method)[0]) > 1e-3


def test_every_rule_makes_another_motion_of_the_same_seed(flow):
    lively = Statistics(flow.motion_statistics.mean, 40 * flow.motion_statistics.std)
    flow = dataclasses.replace(flow, motion_statistics=lively)
    made = [flow.generate(WALK_WAVE, steps=5, method=method)[0] for method in ("stmc", "sinc_lerp", *RULES)]
    for i, motion in enumerate(made):
        assert all(apart(motion, other) > 1e-5 for other in made[:i])


def test_a_second_take_changes_only_the_ways_to_transitions_and_from_them(flow):
    """At overlap 0.5 s a transition has 10 frames, its ramps 5 on either side; the legs change at 4 s alone."""
    rotations = [
        matrix_to_rows(motion.rotations)
        for motion in (
            flow.generate(WALK_WAVE, steps=20, method="double_take")[0],
            first_take(flow, WALK_WAVE),
        )
    ]
    knees = (rotations[0] - rotations[1])[:, 4].abs().amax(dim=-1)
    changed = (knees > 1e-5).nonzero().flatten().tolist()
    assert changed
    assert set(changed) <= {*range(70, 75), *range(85, 90)}


def first_take(model: Model, timeline: Timeline):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("stmc.composing.methods.inpaint", lambda predict, content, kept: lambda x, t: content)
        return model.generate(timeline, steps=20, method="double_take")[0]


def test_without_overlap_there_is_nothing_to_take_twice(flow):
    long = Timeline.parse("walk # 0 # 8 # legs")
    assert flow.generate(long, steps=2, overlap=0.0, method="double_take")[0].frames == 160


def test_one_track_is_one_sequence_and_a_gap_belongs_to_it(flow):
    shapes = []
    denoise = flow.denoiser.denoise

    def watched(x, *others, **settings):
        shapes.append(tuple(x.shape[:2]))
        return denoise(x, *others, **settings)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(flow.denoiser, "denoise", watched)
        flow.generate(single_track(WALK_WAVE, 20), steps=1, method="flow_mdm")
        flow.generate(GAP, steps=1, method="flow_mdm", guidance=1.0)
    assert shapes == [(2, 110), (1, 60)]


def test_a_denoiser_of_crops_cannot_make_sequences():
    with pytest.raises(ValueError, match="MdmSmpl knows one text for all frames"):
        tiny().generate(NOD, steps=1, method="flow_mdm")


@pytest.mark.parametrize("method", ["flow_mdm", "sinc_slerp"])
def test_what_does_not_stitch_cannot_begin_later(flow, method):
    with pytest.raises(SettingError, match=r"stitch_from=0\.5: .* has no such setting"):
        flow.generate(NOD, steps=2, stitch_from=0.5, method=method)
