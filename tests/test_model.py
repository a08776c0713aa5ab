"""A tiny random model: every method and sampler gives motions of the right length that belong to their seeds."""

import dataclasses
import subprocess
import sys
import warnings
from functools import partial

import pytest
import torch
from helpers.strategies import quietly, timelines
from helpers.tiny_model import Hashes, tiny
from hypothesis import Phase, given, settings

import stmc
from stmc.composing.sampling import Sampling
from stmc.denoisers import Network
from stmc.diffusion import Noise, ddim, ddpm, dpm_solver
from stmc.model import Model
from stmc.motion.body import JOINTS, BodyPart
from stmc.motion.motion import Motion
from stmc.run.precision import advise_precision
from stmc.timeline import Timeline
from stmc.timeline.planning import cross_fade

WALK_WAVE = Timeline.parse("walk forwards # 0 # 4 # legs\nwave # 1 # 3 # right arm\nsit down # 4 # 5.5 # legs # spine")
NOD = Timeline.parse("nod # 0 # 1.3 # head")
GAP = Timeline.parse("turn left # 0 # 1 # legs\nturn left # 2 # 3 # legs")
THREE = [WALK_WAVE, NOD, GAP]
METHODS = ("stmc", "stmc_paper", "sinc", "sinc_lerp", "single_track", "one_text")
SAMPLERS = {
    "ddpm": ddpm,
    "ddpm, variance": partial(ddpm, noise_scale="variance"),
    "ddim": ddim,
    "ddim, eta": partial(ddim, eta=1.0),
    "dpm_solver": dpm_solver,
}


@pytest.fixture(scope="module")
def model() -> Model:
    return tiny()


def apart(one: Motion, other: Motion) -> float:
    return float((one.joints - other.joints).abs().max())


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("sampler", SAMPLERS)
def test_every_method_and_sampler_gives_each_timeline_its_motion(model, sampler, method):
    motions = model.generate(THREE, steps=2, sampler=SAMPLERS[sampler], method=method)
    for timeline, motion in zip(THREE, motions, strict=True):
        if method == "one_text":
            assert motion.frames <= model.longest
        assert motion.frames == min(timeline.frames(20), model.longest if method == "one_text" else 10**6)
        assert motion.fps == model.fps
        assert motion.duration == pytest.approx(motion.frames / 20)
        posed = model.skeleton.pose(motion.rotations, motion.translation)
        torch.testing.assert_close(motion.joints, posed, msg="bones keep their length")


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("sampler", ["ddpm", "dpm_solver"])
def test_a_motion_is_the_same_alone_and_in_any_batch(model, sampler, method):
    generate = partial(model.generate, steps=3, sampler=SAMPLERS[sampler], method=method)
    together = generate(THREE, seed=[7, 8, 9])
    backwards = generate(THREE[::-1], seed=[9, 8, 7])[::-1]
    for timeline, seed, motion, other in zip(THREE, (7, 8, 9), together, backwards, strict=True):
        [alone] = generate(timeline, seed=seed)
        assert apart(motion, alone) < 1e-4
        assert apart(motion, other) < 1e-4


def test_a_number_of_steps_that_is_not_said_is_that_of_training(model):
    seen = []

    def counted(steps, total):
        assert total == 100
        for x0 in steps:
            seen.append(x0.shape)
            yield x0

    model.generate(NOD, progress=counted)
    assert seen == [(1, 26, 205)] * 100


def test_seeds_are_consecutive_from_the_first_and_decide_alone(model):
    generate = partial(model.generate, steps=2)
    first, second = generate([NOD, NOD], seed=3)
    listed = generate([NOD, NOD], seed=[3, 4])
    assert apart(first, listed[0]) == apart(second, listed[1]) == 0
    assert apart(first, second) > 1e-3
    torch.manual_seed(123)
    assert apart(first, generate([NOD, NOD], seed=3)[0]) == 0


def test_sampling_leaves_the_global_generator_alone(model):
    torch.manual_seed(5)
    before = torch.get_rng_state()
    for method in METHODS:
        model.generate(THREE, steps=2, method=method)
    assert torch.equal(torch.get_rng_state(), before)


def test_the_text_guidance_and_overlap_change_the_motion(model):
    [plain] = model.generate(WALK_WAVE, steps=4)
    other_words = dataclasses.replace(
        WALK_WAVE, prompts=[dataclasses.replace(prompt, text="jump") for prompt in WALK_WAVE.prompts]
    )
    assert apart(plain, model.generate(other_words, steps=4)[0]) > 1e-3
    assert apart(plain, model.generate(WALK_WAVE, steps=4, guidance=1.0)[0]) > 1e-3
    assert apart(plain, model.generate(WALK_WAVE, steps=4, overlap=1.0)[0]) > 1e-3
    silent = model.generate([WALK_WAVE, other_words], seed=[0, 0], steps=4, guidance=0.0)
    assert apart(*silent) < 1e-5


def test_without_overlap_and_simultaneous_texts_all_methods_of_one_track_agree_with_a_single_crop(model):
    """One prompt for the whole body is one crop: nothing is left that the methods could do differently."""
    one = Timeline.parse("jump # 0 # 3")
    motions = [model.generate(one, steps=3, method=method)[0] for method in ("stmc", "single_track", "one_text")]
    assert apart(motions[0], motions[1]) < 1e-5
    assert apart(motions[0], motions[2]) < 1e-5


def test_sinc_takes_each_part_from_one_crop_and_its_lerp_changes_only_the_seams(model):
    timeline = Timeline.parse("walk # 0 # 2 # legs\nrun # 2 # 4 # legs")
    plain, smooth = (model.generate(timeline, steps=3, method=method)[0].rotations for method in ("sinc", "sinc_lerp"))
    plain, smooth = plain[:, 1:], smooth[:, 1:]  # the root's heading is a sum: it keeps what it gained at the seam
    changed = (plain - smooth).abs().amax(dim=(1, 2, 3)) > 1e-4
    assert changed[36:44].any(), "half a second around the seam at frame 40"
    assert not changed[:35].any()
    assert not changed[45:].any()


@pytest.mark.parametrize("start", [0.25, 0.5, 0.9])
def test_late_stitching_goes_on_from_the_crops_as_they_are(model, start):
    """Of a single crop there is nothing to stitch: whenever it begins, it is what it would be alone."""
    settings = {"steps": 4, "sampler": ddim}
    alone = model.generate([NOD], method="sinc", **settings)[0]
    assert apart(model.generate([NOD], stitch_from=start, **settings)[0], alone) < 1e-6
    first, second = model.generate([NOD, WALK_WAVE], stitch_from=start, **settings)
    assert apart(first, alone) < 1e-5
    assert second.frames == WALK_WAVE.frames(20)


def test_stitching_later_is_neither_stitching_from_the_start_nor_at_the_end(model):
    made = [model.generate([WALK_WAVE], steps=4, sampler=ddim, stitch_from=start)[0] for start in (0.0, 0.1, 0.5)]
    assert apart(made[0], made[1]) == 0, "less than one step of four"
    sinc = model.generate([WALK_WAVE], steps=4, sampler=ddim, method="sinc")[0]
    assert min(apart(made[2], made[0]), apart(made[2], sinc)) > 1e-3


def test_a_prompt_longer_than_the_model_knows_is_sampled_in_pieces(model):
    crops = []
    long = Timeline.parse("walk # 0 # 12 # legs")

    class Watched(Network):
        def __init__(self, network):
            super().__init__()
            self.network = network

        def encode_text(self, *text):
            return self.network.encode_text(*text)

        def denoise(self, x, *rest):
            crops.append(x.shape[1])
            return self.network.denoise(x, *rest)

    watched = dataclasses.replace(model, denoiser=Watched(model.denoiser))
    [motion] = watched.generate(long, steps=2)
    assert motion.frames == 240
    assert max(crops) <= model.longest


def test_each_distinct_text_is_encoded_once():
    model = tiny()
    assert isinstance(model.text_encoder, Hashes)
    model.generate([GAP, GAP, NOD], steps=2)
    assert sorted(model.text_encoder.encoded) == ["", "nod", "turn left"]


def test_embeddings_are_normalised_and_as_long_as_their_texts(model):
    embedded = model.embed(["walk forwards", "", "walk forwards"])
    assert {text: len(words) for text, words in embedded.items()} == {"walk forwards": 2, "": 1}
    words, _ = model.text_encoder.encode(["walk forwards"])
    torch.testing.assert_close(embedded["walk forwards"], (words[0] - 0.1) / 2.0)


def test_the_pieces_of_generate_give_what_generate_gives(model):
    """As in the documentation: plans, guided crops, the collage, arms in transitions, a sampler, decoding."""
    bare, layout = model.plans(THREE, overlap=0.5), model.representation.layout
    plans = [cross_fade(plan) for plan in bare]
    predict = stmc.collage(model.guided(plans, guidance=2.5), plans, layout.columns)
    predict = stmc.composing.time_warp(predict, bare, layout, model.motion_statistics)
    draw = Noise([0, 1, 2], [plan.frames for plan in plans], model.representation.width)
    with torch.inference_mode():
        for x0 in stmc.ddim(predict, model.schedule, draw(), draw, steps=5):  # noqa: B007
            pass
    pieces = model.decode(x0, [plan.frames for plan in plans])
    for one, other in zip(pieces, model.generate(THREE, seed=0, steps=5, sampler=ddim, clean_feet=False), strict=True):
        assert apart(one, other) == 0


def test_a_body_part_obeys_its_own_prompt_alone(model):
    """What the right arm is told changes the right arm's columns, and no other's, in the first prediction."""
    wave, salute = (Timeline.parse(f"walk # 0 # 3 # legs\n{text} # 0 # 3 # right arm") for text in ("wave", "salute"))
    predictions = []
    for timeline in (wave, salute):
        plans = model.plans([timeline])
        predict = stmc.collage(model.guided(plans), plans, model.representation.columns)
        x = Noise([0], [60], 205)()
        with torch.inference_mode():
            predictions.append(predict(x, 99))
    changed = (predictions[0] - predictions[1]).abs().amax(dim=(0, 1)) > 0
    assert set(changed.nonzero().flatten().tolist()) == set(model.representation.columns[BodyPart.RIGHT_ARM])


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"seed": [1]}, "1 seeds for 3 timelines"),
        ({"method": "magic"}, "magic"),
        ({"joints_from": "mesh"}, "mesh"),
        ({"seed": -5}, "seed=-5: must be at least 0"),
        ({"overlap": -1.0}, r"overlap=-1\.0: must be at least 0"),
        ({"steps": 101}, "101"),
        ({"steps": 0}, "0"),
        ({"stitch_from": 1.0}, r"stitch_from=1\.0: must be"),
        ({"stitch_from": 0.5, "method": "sinc"}, "SINC w/o Lerp has no such setting"),
    ],
)
def test_what_cannot_be_meant_is_refused(model, arguments, message):
    with pytest.raises((ValueError, TypeError), match=message):  # in tests, types are checked first
        model.generate(THREE, **({"steps": 2} | arguments))


def test_guidance_noise_scale_and_sampler_are_the_models_own_unless_told(model):
    own = dataclasses.replace(model, sampling=Sampling(guidance=1.5, noise_scale="std"))
    [expected] = model.generate(NOD, steps=3, guidance=1.5, sampler=partial(ddpm, noise_scale="std"))
    assert apart(own.generate(NOD, steps=3)[0], expected) == 0
    assert apart(model.generate(NOD, steps=3)[0], expected) > 1e-3
    [usual] = model.generate(NOD, steps=3, guidance=2.5, sampler=partial(ddpm, noise_scale="variance"))
    assert apart(model.generate(NOD, steps=3)[0], usual) == 0


def test_a_model_that_stitches_late_does_so_unless_told_and_its_baselines_do_not(model):
    own, settings = dataclasses.replace(model, sampling=Sampling(stitch_from=0.5)), {"steps": 4, "sampler": ddim}
    [late] = model.generate([WALK_WAVE], stitch_from=0.5, **settings)
    [at_once] = model.generate([WALK_WAVE], **settings)
    assert apart(own.generate([WALK_WAVE], **settings)[0], late) == 0
    assert apart(own.generate([WALK_WAVE], stitch_from=0.0, **settings)[0], at_once) == 0
    for method in ("single_track", "sinc", "stmc_paper"):
        expected = model.generate([WALK_WAVE], method=method, **settings)[0]
        assert apart(own.generate([WALK_WAVE], method=method, **settings)[0], expected) == 0


def test_a_text_is_read_once_and_not_at_every_step(model):
    read = []

    class Reader(Network):
        def __init__(self, network):
            super().__init__()
            self.network = network

        def encode_text(self, text, text_mask=None):
            read.append(text.shape)
            return self.network.encode_text(text, text_mask)

        def denoise(self, *given):
            return self.network.denoise(*given)

    dataclasses.replace(model, denoiser=Reader(model.denoiser)).generate([NOD, GAP, NOD], steps=3)
    assert len(read) == 3  # "nod", "turn left" and no text


def test_no_timelines_are_no_motions(model):
    assert model.generate([]) == []


def test_a_model_in_training_mode_samples_without_dropout():
    model = tiny()
    [expected] = model.generate(NOD, steps=2)
    model.denoiser.train()
    assert apart(model.generate(NOD, steps=2)[0], expected) == 0


def test_another_device_is_another_record_of_the_same_model(model):
    moved = model.to("cpu")
    assert moved.device == torch.device("cpu")
    assert moved.schedule is model.schedule
    assert apart(moved.generate(NOD, steps=2)[0], model.generate(NOD, steps=2)[0]) == 0


# A thousand timelines ---------------------------------------------------------------------------------------------


def thousand() -> list[Timeline]:
    drawn = []

    @settings(max_examples=1000, deadline=None, database=None, derandomize=True, phases=[Phase.generate])
    @given(timelines())
    def draw(timeline: Timeline) -> None:
        drawn.append(timeline)

    draw()
    return drawn


@quietly
@pytest.mark.slow
def test_a_thousand_random_legal_timelines_are_sampled():
    """At 10 frames a second and at most 4 seconds at once: everything happens, quickly."""
    model, drawn = tiny(fps=10, longest=40), thousand()
    assert len(drawn) >= 1000
    assert {len(timeline.prompts) for timeline in drawn} == set(range(1, 9))
    for start in range(0, len(drawn), 50):
        batch = drawn[start : start + 50]
        motions = model.generate(batch, seed=start, steps=2, sampler=ddim)
        for timeline, motion in zip(batch, motions, strict=True):
            assert motion.joints.shape == (timeline.frames(10), len(JOINTS), 3)


# The package ------------------------------------------------------------------------------------------------------


def test_importing_the_package_imports_neither_torch_nor_anything_slow():
    code = """
import sys, stmc
assert stmc.Timeline.parse("walk # 0 # 1").duration == 1.0
assert stmc.plan and stmc.assign
print(sorted({"torch", "transformers", "hydra", "matplotlib", "scipy"} & set(sys.modules)))
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_an_unknown_name_of_the_package_is_an_attribute_error():
    with pytest.raises(AttributeError, match="magic"):
        stmc.magic  # noqa: B018


def test_the_last_step_of_bf16_is_fp32_so_that_nothing_trembles_by_rounding():
    """The features are what the network answers in full precision to the last noisy motion, to the last bit; the other
    steps are in half precision."""
    model = dataclasses.replace(tiny(), precision="bf16")
    denoise, seen = model.denoiser.denoise, []

    def watched(x, t, *others, **settings):
        seen.append((int(t[0]), torch.is_autocast_enabled("cpu"), denoise(x, t, *others, **settings)))
        return seen[-1][-1]

    model.denoiser.denoise = watched
    [motion] = model.generate("walk # 0 # 2", steps=4, guidance=1.0, stitch_from=0.0, clean_feet=False)
    assert [(t, half) for t, half, _ in seen] == [(99, True), (66, True), (33, True), (0, False)]
    assert [answer.dtype for *_, answer in seen] == [torch.bfloat16] * 3 + [torch.float32]
    [expected] = model.decode(seen[-1][-1], [40])
    assert apart(motion, expected) == 0


@pytest.mark.parametrize(
    ("capability", "machine", "precision", "device", "warned"),
    [
        ("AVX2", "x86_64", "bf16", "cpu", True),
        ("DEFAULT", "AMD64", "bf16", "cpu", True),
        ("AVX512", "x86_64", "bf16", "cpu", False),
        ("DEFAULT", "arm64", "bf16", "cpu", False),
        ("AVX2", "x86_64", "fp32", "cpu", False),
        ("AVX2", "x86_64", "bf16", "cuda:0", False),
    ],
)
def test_bf16_warns_where_the_processor_imitates_it(capability, machine, precision, device, warned, monkeypatch):
    monkeypatch.setattr(torch.backends.cpu, "get_cpu_capability", lambda: capability)
    monkeypatch.setattr("platform.machine", lambda: machine)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        advise_precision(precision, device)
    assert [str(each.message).startswith("precision=bf16 is very slow") for each in caught] == [True] * warned
    assert all(each.filename == __file__ for each in caught)


def test_loading_a_model_for_bf16_warns_of_a_processor_that_imitates_it(monkeypatch):
    monkeypatch.setattr(torch.backends.cpu, "get_cpu_capability", lambda: "AVX2")
    monkeypatch.setattr("platform.machine", lambda: "x86_64")
    with pytest.warns(UserWarning, match="precision=bf16 is very slow on this processor"):
        stmc.load("mdm_smpl_cmu", precision="bf16")
