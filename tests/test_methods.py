"""Every other rule of composing through a tiny random model: lengths, seeds, and what each leaves alone."""

import dataclasses
import inspect
import sys
from collections.abc import Sequence
from functools import partial

import pytest
import torch
from helpers.tiny_model import WIDTH, Hashes, tiny
from test_model import GAP, NOD, THREE, WALK_WAVE, apart
from torch import Tensor

import stmc
from stmc.composing import Run, find_method
from stmc.composing.methods import stitch
from stmc.composing.sampling import Sampling
from stmc.denoisers import FlowMdm
from stmc.diffusion import Schedule, ddim, ddpm, dpm_solver
from stmc.diffusion.statistics import Statistics
from stmc.model import Model
from stmc.motion.body import BodyPart
from stmc.motion.geometry import matrix_to_rows
from stmc.settings.records import SettingError, field_infos
from stmc.timeline import Timeline, single_track
from stmc.timeline.planning import cross_fade

RULES = ("stmc_paper", "multi_diffusion", "double_take", "sinc_slerp", "teach_b", "teach", "flow_mdm")


class OneWord(Hashes):
    """The mean of a text's words."""

    def encode(self, texts: Sequence[str]) -> tuple[Tensor, Tensor]:
        words, lengths = super().encode(texts)
        return words.sum(dim=1, keepdim=True) / lengths[:, None, None], torch.ones_like(lengths)


@pytest.fixture(scope="module")
def flow() -> Model:
    with torch.random.fork_rng():
        torch.manual_seed(0)
        network = FlowMdm(
            205, WIDTH, absolute_from=90, width=16, feedforward=32, layers=1, heads=2, attention_window=20
        )
    return dataclasses.replace(tiny(), denoiser=network.eval().requires_grad_(False), text_encoder=OneWord())


@pytest.mark.parametrize("method", RULES)
@pytest.mark.parametrize("sampler", [ddpm, ddim, dpm_solver])
def test_every_rule_and_sampler_gives_each_timeline_its_motion(flow, sampler, method):
    motions = flow.generate(THREE, steps=2, sampler=sampler, method=method)
    assert [motion.frames for motion in motions] == [timeline.frames(20) for timeline in THREE]


@pytest.mark.parametrize("method", RULES)
def test_a_motion_belongs_to_its_seed_and_not_to_its_batch(flow, method):
    generate = partial(flow.generate, steps=3, method=method)
    batch, others = generate(THREE, seed=[5, 6, 7]), generate(THREE, seed=8)
    for seed, timeline, motion, other in zip([5, 6, 7], THREE, batch, others, strict=True):
        assert apart(motion, generate(timeline, seed=seed)[0]) < 1e-4
        assert apart(motion, other) > 1e-3


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
            flow.generate(WALK_WAVE, steps=10, method="double_take")[0],
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
        return model.generate(timeline, steps=10, method="double_take")[0]


def test_the_second_take_goes_without_the_noisiest_tenth_of_the_steps(flow):
    """DoubleTake's own share (Shafir et al. 2024)."""
    totals = []

    def progress(steps, total):
        totals.append(total)
        return steps

    flow.generate(WALK_WAVE, steps=20, method="double_take", progress=progress)
    assert totals == [20, 18]


def test_the_second_take_has_a_noise_of_its_own(flow, monkeypatch):
    """With the first take's, what it makes anew would begin where that began."""
    drawn, noise = [], Run.noise

    def watched(self, plans, seeds=None):
        drawn.append(noise(self, plans, seeds)())
        return noise(self, plans, seeds)

    monkeypatch.setattr(Run, "noise", watched)
    flow.generate(WALK_WAVE, steps=2, method="double_take")
    first, second = drawn
    assert first.shape == second.shape and abs(float((first * second).mean())) < 0.05


def test_what_is_behind_the_end_is_as_noisy_as_the_crops_when_composition_begins():
    """A network that sees 60 frames sees noise behind the end of a shorter timeline: that of the step before."""

    def still(x, t, text, text_mask=None, mask=None):
        return torch.zeros_like(x)

    still.fixed_length = 60
    first, model = [], dataclasses.replace(tiny(), denoiser=still)

    def sample(run: Run) -> Tensor:
        plans = run.plans()
        predict = run.collage(plans)
        x0 = stitch(run, plans, lambda x, t: first.append((x, t)) or predict(x, t))
        level = run.schedule.alpha_bar[run.times[len(run.times) - run.steps_before(0.5) - 1]]
        expected = (1 - level).sqrt().float() * run.noise(plans)()
        x, t = first[0]
        assert t == run.times[len(run.times) // 2 - 1]
        torch.testing.assert_close(x[:, 40:], expected[:, 40:])
        return x0

    model.generate("walk # 0 # 2", method=stmc.Method(sample, "Watched"), steps=8, stitch_from=0.5)
    assert len(first) == 4


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
    with pytest.raises(ValueError, match="MdmSmpl takes one text for all frames"):
        tiny().generate(NOD, steps=1, method="flow_mdm")


@pytest.mark.parametrize("method", ["flow_mdm", "sinc_slerp", "teach"])
def test_what_does_not_stitch_cannot_begin_later(flow, method):
    with pytest.raises(SettingError, match=r"stitch_from=0\.5: .* has no such setting"):
        flow.generate(NOD, steps=2, stitch_from=0.5, method=method)


# Methods of one's own ---------------------------------------------------------------------------------------------


def test_a_rule_of_ones_own_is_a_method_and_stitches_from_any_moment(flow):
    for start in (0.0, 0.5):
        [bare] = flow.generate(WALK_WAVE, steps=4, stitch_from=start, method=stmc.stitched())
        [own] = flow.generate(WALK_WAVE, steps=4, stitch_from=start, method=stmc.stitched(cross_fade))
        [rule] = flow.generate(WALK_WAVE, steps=4, stitch_from=start, method=cross_fade)
        assert apart(own, rule) == 0 < apart(own, bare)


def test_a_method_is_any_function_of_a_run(flow):
    still = stmc.Method(lambda run: torch.zeros(len(run.timelines), 110, run.layout.width), "Still")
    first, second = flow.generate([WALK_WAVE, NOD], method=still)
    assert (first.frames, second.frames) == (110, 26)
    assert apart(first, flow.generate(WALK_WAVE, seed=7, method=still)[0]) == 0


FIXED_BY_THE_PAPER = {"stitch_from": 0.0, "guidance_from": 0.0}


def test_the_paper_s_algorithm_is_hard_edges_from_the_first_step_on_whatever_the_model_says(flow):
    sampling = Sampling(stitch_from=0.5, noise_scale="std", guidance=2.5, guidance_from=0.5)
    own = dataclasses.replace(flow, sampling=sampling)
    [paper] = own.generate(WALK_WAVE, steps=4, method="stmc_paper")
    [spelled] = own.generate(WALK_WAVE, steps=4, method=stmc.stitched(), **FIXED_BY_THE_PAPER)
    assert apart(paper, spelled) == 0
    with pytest.raises(SettingError, match=r"stitch_from=0\.2: STMC \(paper\) fixes it at 0\.0"):
        own.generate(WALK_WAVE, method="stmc_paper", stitch_from=0.2)


@pytest.mark.parametrize("scale", ["std", "variance"])
def test_the_paper_s_algorithm_has_the_model_s_noise_or_the_one_asked_for(flow, scale):
    """Publishers of other denoisers than MDM-SMPL scale it by the standard deviation."""
    own = dataclasses.replace(flow, sampling=Sampling(noise_scale=scale))
    assert own.settings("stmc_paper").noise_scale == scale
    other = "std" if scale == "variance" else "variance"
    assert own.settings("stmc_paper", noise_scale=other).noise_scale == other


def arms(guidance: float, guidance_from: float) -> tuple[Tensor, Schedule]:
    """What two arms, of a prompt that wants 1 and one that wants -1, are when composition begins, after 4 of 8 steps;
    and the schedule of the steps."""
    wanted = {"raise": 1.0, "lower": -1.0, "": 0.0}

    def encode(texts: Sequence[str]) -> tuple[Tensor, Tensor]:
        return torch.tensor([wanted[text] for text in texts])[:, None, None], torch.ones(len(texts), dtype=torch.long)

    def wish(x: Tensor, t: Tensor, text: Tensor, text_mask: Tensor | None, mask: Tensor | None) -> Tensor:
        return text[:, :1].expand_as(x)

    def begun(run: Run) -> Tensor:
        x = run.sample_independent_start(run.steps_before(0.5))
        found.append((x[0, :, list(run.columns[BodyPart.RIGHT_ARM])], run.schedule.respaced(run.times)))
        return x

    plain, found = Statistics(torch.zeros(1), torch.ones(1)), []
    model = dataclasses.replace(tiny(), denoiser=wish, text_encoder=encode, text_statistics=plain)
    timeline = "raise # 0 # 2 # right arm\nlower # 2 # 4 # right arm"
    model.generate(
        timeline, method=stmc.Method(begun, ""), sampler=ddim, steps=8, guidance=guidance, guidance_from=guidance_from
    )
    return found[0]


def test_arms_whose_texts_want_them_apart_are_composed_as_far_apart_as_the_texts_say_and_no_further():
    """Guided from the first step on they are `guidance` times as far; DDIM's steps are affine in what is predicted."""
    plain, schedule = arms(1.0, 0.0)
    signal, noise = schedule.alpha_bar.sqrt(), (1 - schedule.alpha_bar).sqrt()
    gain = float(signal[3] - noise[3] * signal[7] / noise[7])
    more = (arms(2.5, 0.0)[0] - plain).mean(dim=1)
    torch.testing.assert_close(more, torch.tensor([1.5 * gain] * 40 + [-1.5 * gain] * 40), atol=1e-4, rtol=0)
    torch.testing.assert_close(arms(2.5, 0.5)[0], plain, atol=1e-5, rtol=0)
    part = (arms(2.5, 0.25)[0] - plain).mean(dim=1)
    assert (part[:40] > 0.1).all() and (part[:40] < more[:40] - 0.1).all()


@pytest.mark.parametrize("guidance", [0.0, 1.0])
def test_guidance_that_exaggerates_nothing_may_begin_at_any_time(flow, guidance):
    made = [flow.generate(WALK_WAVE, steps=4, guidance=guidance, guidance_from=start)[0] for start in (0.0, 0.5)]
    assert apart(*made) == 0


def test_a_dotted_name_is_imported_of_trusted_packages_alone(tmp_path, monkeypatch):
    (tmp_path / "mylab").mkdir()
    (tmp_path / "mylab" / "rules.py").write_text(
        "import stmc\ndef mine(plan):\n    return plan\nown = stmc.Method(print, 'Own')\nnumber = 3\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(SettingError, match="'mylab' is not among the trusted packages"):
        find_method("mylab.rules.mine")
    assert "mylab" not in sys.modules
    assert find_method("mylab.rules.mine", ["mylab"]).label == "mine"
    assert find_method("mylab.rules.own", ["mylab"]).label == "Own"
    for name, message in (("mylab.rules.none", "no attribute 'none'"), ("mylab.no.mine", "No module named")):
        with pytest.raises(SettingError, match=message):
            find_method(name, ["mylab"])
    with pytest.raises(SettingError, match="method=3: pass a name, a Method or a rule"):
        find_method("mylab.rules.number", ["mylab"])


def test_the_name_that_cross_fading_had_is_answered_with_todays():
    with pytest.raises(SettingError, match="it is now called stmc"):
        find_method("stmc_soft")


def test_independent_prompts_are_timelines_of_one_prompt_each(flow):
    [alone] = flow.generate(NOD, steps=2, method="independent")
    assert apart(alone, flow.generate(NOD, steps=2, stitch_from=0.0)[0]) < 1e-6
    with pytest.raises(ValueError, match="3 prompts; this method needs one prompt per timeline"):
        flow.generate(WALK_WAVE, steps=2, method="independent")


# Denoisers and encoders of one's own --------------------------------------------------------------------------------


def test_a_plain_function_is_a_denoiser_and_one_that_encodes_a_text_encoder(flow):
    seen = []

    def shrink(x, t, text, text_mask, mask):
        seen.append((len(x), text.shape[-1]))
        return 0.5 * x

    plain = dataclasses.replace(tiny(), denoiser=shrink, text_encoder=Hashes().encode)
    [motion] = plain.generate(NOD, steps=2)
    assert motion.frames == 26
    assert seen == [(2, WIDTH)] * 2
    assert plain.to("cpu").generate(NOD, steps=2)[0].frames == 26
    assert plain.network.fixed_length is None and plain.network.supports_padding


def test_what_a_denoiser_of_ones_own_can_do_are_its_attributes(flow):
    network = flow.denoiser

    class Mine:
        fixed_length = 60
        per_frame_text = True

        def __call__(self, x, t, text, text_mask, mask, segment=None):
            assert x.shape[1] == 60 or segment is not None
            return network(x, t, text, text_mask, mask, segment)

    mine = dataclasses.replace(flow, denoiser=Mine(), longest=60)
    assert mine.generate(WALK_WAVE, steps=1)[0].frames == 110
    assert mine.generate(NOD, steps=1, method="flow_mdm")[0].frames == 26
    with pytest.raises(SettingError, match=r"ape_steps=0\.5: the model has no such setting"):
        mine.generate(NOD, ape_steps=0.5)


def test_the_share_of_absolute_steps_is_the_sampling_s_and_leaves_the_network_alone(flow):
    assert flow.own_sampling.ape_steps == 0.1
    [usual, same, all_absolute] = (
        flow.generate(WALK_WAVE, steps=4, method="flow_mdm", **settings)[0]
        for settings in ({}, {"ape_steps": 0.1}, {"ape_steps": 1.0})
    )
    assert apart(usual, same) == 0
    assert apart(usual, all_absolute) > 1e-5
    assert flow.denoiser.absolute_from == 90


# Settings -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "settings",
    [
        {"steps": 101},
        {"steps": True},
        {"steps": 2.5},
        {"guidance": float("nan")},
        {"overlap": "half"},
        {"overlap": 1e9},
        {"noise_scale": "std", "sampler": "ddim"},
        {"stitch_from": 0.2, "method": "sinc_lerp"},
        {"seed": -1},
        {"seed": True},
        {"seed": [0, -1]},
        {"stepps": 3},
        {"method": "magic"},
    ],
)
def test_whatever_does_not_fit_is_one_short_sentence(settings):
    with pytest.raises(SettingError) as caught:
        tiny().generate(NOD, **settings)
    assert len(str(caught.value)) < 300 and "\n" not in str(caught.value)


@pytest.mark.parametrize("seed", [1.5, "x", None, [0.5], {}])
def test_seeds_that_are_no_whole_numbers_are_refused_in_a_sentence(seed):
    with pytest.raises(SettingError, match="seed"):
        stmc.GenerateRequest.read({"timelines": NOD, "seeds": seed})


def test_a_timeline_may_be_its_text():
    model = tiny()
    [read] = model.generate("nod # 0 # 1.3 # head", steps=1)
    assert apart(read, model.generate([NOD], steps=1)[0]) == 0
    assert len(model.generate(["nod # 0 # 1.3 # head", NOD], steps=1)) == 2


def test_the_settings_are_in_the_signature_of_generate():
    named = inspect.signature(stmc.Model.generate).parameters
    assert {"timelines", "seed", "method", "progress", *field_infos(Sampling)} <= set(named)


def test_a_model_and_its_parts_fit_a_screen(flow):
    assert len(repr(flow)) < 600
    assert "FlowMdm of" in repr(flow)
