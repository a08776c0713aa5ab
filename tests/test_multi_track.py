"""The multi-track benchmark: which frames should show which text, by every method; its bundled files; its scripts."""

import dataclasses
import functools
import json
import os
import shutil
from collections.abc import Sequence
from importlib.resources import files
from multiprocessing import get_context
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers.bandai_files import about, posed
from helpers.pose_evaluator import REPRESENTATION, Oracle
from helpers.scripts import ROOT, configured, loaded, run
from helpers.tiny_model import tiny
from hydra.utils import instantiate
from test_evaluators import evaluator
from torch import Tensor

import stmc
from stmc.data.cache import HELD_OUT, Cache, CacheError, Clip
from stmc.data.sources.contents import CONTENTS, describe
from stmc.data.sources.segments import splits
from stmc.denoisers import FlowMdm
from stmc.evaluation.benchmarks import Benchmark, MultiTrack, resampling
from stmc.evaluation.benchmarks.atomic_prompts import LONGEST, AtomicPrompt, read_atomic_prompts, sample_timelines
from stmc.evaluation.benchmarks.ground_truth import cache_reference_motions
from stmc.evaluation.benchmarks.multi_track import open_mtt
from stmc.evaluation.metrics.retrieval import cosines
from stmc.evaluation.metrics.timeline_metrics import GroundTruth
from stmc.evaluation.results import Result, read_results
from stmc.evaluation.results.naming import MEASURES
from stmc.motion.body import BodyPart
from stmc.motion.motion import Motion
from stmc.run import save, save_evaluator
from stmc.settings.records import SettingError
from stmc.timeline import Prompt, Timeline, TimelineError

BUNDLED = Path(str(files("stmc") / "assets" / "open_mtt"))
FPS = 20.0
ANGLES = {
    "raise the left arm": ("left_shoulder", 1.2),
    "raise the right arm": ("right_shoulder", -1.2),
    "bow": ("spine1", 0.4),
}
PARTS = {"raise the left arm": ["left arm"], "raise the right arm": ["right arm"], "bow": ["spine"]}


@functools.cache
def still(text: str, frames: int = 60) -> Motion:
    """A pose that says which text it shows, held."""
    joint, angle = ANGLES[text]
    pelvis = torch.tensor([[0.0, 0.0, 1.0]], dtype=torch.float64).repeat(frames, 1)
    motion = posed({joint: about("z", torch.full((frames,), angle, dtype=torch.float64))}, pelvis, pelvis[:, 0])
    return Motion(motion.rotations, motion.translation, motion.joints, FPS)


def joined(*motions: Motion) -> Motion:
    return Motion(
        *(torch.cat([getattr(each, name) for each in motions]) for name in ("rotations", "translation", "joints")), FPS
    )


ORACLE = Oracle(FPS, lambda text: still(text, 9))
ATOMIC_PROMPTS = [AtomicPrompt(text, frozenset(map(BodyPart, PARTS[text])), text, 0.0, 3.0) for text in ANGLES]
ASKED = [
    Timeline((Prompt("raise the left arm", 0, 3, PARTS["raise the left arm"]), Prompt("bow", 3, 6, PARTS["bow"]))),
    Timeline((Prompt("bow", 0, 2, PARTS["bow"]), Prompt("raise the right arm", 2, 6, PARTS["raise the right arm"]))),
]
SHOWN = [joined(still("raise the left arm"), still("bow")), joined(still("bow", 40), still("raise the right arm", 80))]


def benchmark(**settings) -> MultiTrack:
    return MultiTrack.of(ASKED, ATOMIC_PROMPTS, ORACLE, lambda clip, start, end: still(clip), **settings)


@pytest.fixture(autouse=True)
def few_draws(monkeypatch) -> None:
    """Of the bootstrap: what it measures is what is tested."""
    monkeypatch.setattr(resampling, "DRAWS", 6)


def test_motions_that_show_every_prompt_in_its_span_are_as_good_as_real_ones():
    assert isinstance(benchmark(), Benchmark)
    scores = benchmark().measured("stmc", SHOWN, seed=0).metrics
    assert scores["recall_1"] == scores["recall_3"] == 100
    assert scores["m2t"] == pytest.approx(1, abs=1e-5)
    assert scores["m2m"] == pytest.approx(1, abs=1e-5)


def test_motions_that_show_the_prompts_in_each_others_spans_are_not_found():
    swapped = [
        joined(still("bow"), still("raise the left arm")),
        joined(still("raise the right arm", 40), still("bow", 80)),
    ]
    assert benchmark().measured("stmc", swapped, seed=0).metrics["recall_1"] == 0


def test_one_text_is_measured_over_its_whole_motion_for_each_prompt():
    one = [still("bow", 60), still("bow", 60)]
    assert benchmark().measured("one_text", one, seed=0).metrics["recall_1"] == 50


def test_prompts_alone_are_timelines_of_their_own_and_only_their_crops_are_measured():
    alone = benchmark().timelines("independent")
    assert [(each.prompts[0].text, each.duration) for each in alone] == [
        ("raise the left arm", 3), ("bow", 3), ("bow", 2), ("raise the right arm", 4)
    ]  # fmt: skip
    motions = [still(each.prompts[0].text, int(each.duration * FPS)) for each in alone]
    scores = benchmark().measured("independent", motions, seed=0).metrics
    assert scores["recall_1"] == 100
    assert set(scores) == {"recall_1", "recall_3", "m2t", "m2m", "fid"}


def test_the_transition_distance_is_that_of_the_jump_between_two_poses():
    jump = (still("raise the left arm", 1).joints - still("bow", 1).joints)[0]
    expected = 100 * float((jump - jump[:1]).norm(dim=-1).mean())
    scores = benchmark().measured("stmc", [SHOWN[0], SHOWN[0]], seed=0).metrics
    assert scores["transition"] == pytest.approx(expected / 2, rel=1e-4)  # the second one's prompts change elsewhere


def test_hand_steps_are_those_of_the_furthest_jump_of_a_wrist():
    poses = [(motion.joints[0, 20:22] - motion.joints[0, 0]) for motion in map(still, ("raise the left arm", "bow"))]
    expected = 100 * float((poses[0] - poses[1]).norm(dim=-1).max())
    scores = benchmark().measured("stmc", [SHOWN[0], still("bow", 120)], seed=0).metrics
    assert scores["hand_step"] == pytest.approx(expected, rel=1e-4)
    assert scores["hand_step_99"] == pytest.approx(0.99 * expected, rel=1e-4)  # between the two motions' own
    assert benchmark().real(0).metrics["hand_step"] == pytest.approx(0, abs=1e-3)


def test_the_jerk_around_transitions_is_that_of_the_jump_beside_real_motions():
    steps = still("bow", 1).joints[0, :22] - still("raise the left arm", 1).joints[0, :22]
    jump = float(steps.abs().sum(dim=-1).amax())
    scores, real = benchmark().measured("stmc", [SHOWN[0]] * 2, seed=0), benchmark().real(0)
    assert len(scores.curves["jerk"]) == 17  # a second but three frames, of which the middle ones see the jump
    half = jump / 2  # the second timeline's prompts change elsewhere
    assert scores.curves["jerk"] == pytest.approx([0] * 7 + [half, 2 * half, half] + [0] * 7, rel=1e-4, abs=1e-6)
    assert scores.metrics["peak_jerk"] == pytest.approx(2 * half, rel=1e-4)
    assert scores.metrics["area_under_jerk"] == pytest.approx(4 * half, rel=1e-4)
    assert real.metrics["peak_jerk"] == pytest.approx(0, abs=1e-6)


def test_what_geometry_can_tell_is_asked_of_the_crops_that_should_show_it():
    asked = {"raise the left arm": lambda motion: len(motion) == 60, "bow": lambda motion: len(motion) == 40}
    assert "shown" not in benchmark().measured("stmc", SHOWN, seed=0).metrics
    measured = benchmark(questions=asked)
    scores = measured.measured("stmc", SHOWN, seed=0).metrics
    assert scores["shown"] == pytest.approx(200 / 3)  # one bow lasts 60
    assert scores["shown_chance"] == pytest.approx(100 / 3)  # all real motions last 60; two of three are asked to bow
    assert measured.real(0).metrics["shown"] == 50


@pytest.mark.parametrize("method", ["stmc", "one_text", "independent"])
def test_draws_of_timelines_are_measured_like_a_benchmark_of_the_drawn_ones(method, monkeypatch):
    """The oracle: a benchmark that asks for the drawn timelines, measured as a whole."""
    monkeypatch.setattr(resampling, "FEWEST", 2)
    questions = {"raise the left arm": lambda motion: len(motion) == 60, "bow": lambda motion: len(motion) == 40}
    whole = benchmark(questions=questions)
    frames = [[int(each.duration * FPS) for each in MultiTrack.timelines(whole, method)]]
    shown = SHOWN if method != "independent" else [
        still(each.prompts[0].text, count) for each, count in zip(whole.timelines(method), *frames, strict=True)
    ]  # fmt: skip
    found = whole.measured(method, shown, seed=0).resampled
    per = len(shown) // len(ASKED)
    assert {"shown", "recall_1", "m2t", "fid"} <= set(found) and all(
        len(values) == resampling.DRAWS for values in found.values()
    )
    for draw, units in enumerate(np.random.default_rng(0).integers(2, size=(resampling.DRAWS, 2))):
        some = MultiTrack.of(
            [ASKED[unit] for unit in units], ATOMIC_PROMPTS, ORACLE, lambda clip, *_: still(clip), questions=questions
        )
        motions = [motion for unit in units for motion in shown[per * unit : per * (unit + 1)]]
        expected = some.measured(method, motions, seed=0).metrics
        for name in set(found) - {"fid_plus"}:  # whose crops are drawn anew
            assert found[name][draw] == pytest.approx(expected[name], rel=1e-4, abs=1e-6), name


def test_every_number_of_motions_has_draws_but_the_largest_hand_step():
    scores = benchmark().measured("stmc", SHOWN, seed=0)
    assert set(scores.metrics) - set(scores.resampled) == {"hand_step"}


def test_real_motion_finds_itself_and_is_compared_with_as_much_of_itself():
    scores = benchmark().real(0).metrics
    assert scores["recall_1"] == 100
    assert (scores["fid"], scores["transition"]) == pytest.approx((0, 0), abs=1e-9)
    others = [still(text, frames) for text in ANGLES for frames in (30, 40, 50, 60)]
    measured = benchmark(others=others)
    assert measured.real(0).metrics["fid"] > 0
    assert measured.real(0) == measured.real(0) != measured.real(1)


def test_a_text_that_no_atomic_prompt_has_is_named():
    strange = Timeline((Prompt("fly", 0, 2),), "0007")
    with pytest.raises(TimelineError, match="timeline 0007: 'fly' is not one of the 3 texts"):
        MultiTrack.of([strange], ATOMIC_PROMPTS, ORACLE, lambda clip, start, end: still(clip))


# What is bundled ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("count", [60, pytest.param(500, marks=pytest.mark.slow)])
def test_the_bundled_timelines_are_those_that_the_bundled_prompts_make(count):
    prompts, timelines = read_atomic_prompts(BUNDLED / "prompts.json"), Timeline.read_all(BUNDLED / "timelines.json")
    assert len(timelines) == 500
    assert sample_timelines(prompts, count, np.random.default_rng(0)) == timelines[:count]
    assert {prompt.text for timeline in timelines for prompt in timeline.prompts} == {each.text for each in prompts}


def test_the_bundled_prompts_are_contents_of_both_data_sets_told_by_their_first_sentences():
    atomic_prompts, contents = read_atomic_prompts(BUNDLED / "prompts.json"), {}
    for content in reversed(CONTENTS.values()):
        contents[content.sentences[0]] = content
    assert len(atomic_prompts) >= 40
    for prompt in atomic_prompts:
        content = contents[prompt.text]
        assert (prompt.parts, prompt.cyclic) == (content.parts, content.cyclic)
        assert prompt.end - prompt.start <= LONGEST or not prompt.cyclic
        if not prompt.clip.startswith("dataset-"):
            assert splits()[prompt.clip.split("/")[0]] in HELD_OUT


def test_the_bundled_evaluator_finds_what_the_bundled_model_was_asked_for():
    atomic_prompts, ear, model = read_atomic_prompts(BUNDLED / "prompts.json"), stmc.load_evaluator(), stmc.load()
    atomic_prompts = [
        prompt for prompt in atomic_prompts if prompt.clip.startswith("dataset-")
    ]  # of the data that both have learnt
    asked = [
        prompt
        for prompt in atomic_prompts
        if prompt.text in ("walk", "turn left", "raise the right arm", "raise both arms")
    ]
    timelines = [Timeline((Prompt(prompt.text, 0, 4, prompt.parts),)) for prompt in asked]
    motions = model.generate(timelines, seed=0, steps=5, sampler=stmc.ddim)
    table = cosines(
        ear.motions([ear.features(motion) for motion in motions]), ear.texts([prompt.text for prompt in atomic_prompts])
    )
    assert [atomic_prompts[best].text for best in table.argmax(dim=1).tolist()] == [prompt.text for prompt in asked]


def prepared(texts: Sequence[str]) -> Cache:
    """A data set whose test split shows each text twice, in clips that the bundled atomic prompts name."""
    named = {prompt.text: prompt.clip for prompt in read_atomic_prompts(BUNDLED / "prompts.json")}
    clips, bow = [], REPRESENTATION.encode(still("bow", 190)).float()
    for text in texts:
        for copy in range(2):
            start = 190 * len(clips)
            name = named[text] if copy == 0 else f"{text} again"
            clips.append(Clip(name, text, "", text, (), True, False, "test", start, start + 190))
    return Cache(20, "smpl", bow.repeat(len(clips), 1), tuple(clips), {text: ((text, 1.0),) for text in texts})


class AnyText(Oracle):
    def __init__(self) -> None:
        super().__init__(FPS, still)

    def texts(self, texts: Sequence[str]) -> Tensor:
        return torch.ones(len(texts), 132)


def test_the_open_benchmark_takes_its_real_motion_from_held_out_clips_of_several_caches(tmp_path, monkeypatch):
    monkeypatch.setattr("stmc.evaluation.benchmarks.multi_track.PER_TEXT", 2)
    texts = [prompt.text for prompt in read_atomic_prompts(BUNDLED / "prompts.json")]
    for name, some in (("one", texts[::2]), ("other", texts[1::2])):
        prepared(some).write(tmp_path / name)
    opened = open_mtt(AnyText(), [tmp_path / "one", tmp_path / "other"], first=3)
    assert len(opened.requested) == 3
    assert len(opened.truth.real) == 2 * len(texts)


def test_a_paraphrased_benchmark_asks_and_ranks_in_sentences_that_no_training_has_seen(tmp_path, monkeypatch):
    monkeypatch.setattr("stmc.evaluation.benchmarks.multi_track.PER_TEXT", 0)
    truth = GroundTruth(torch.ones(1, 1), torch.ones(1, 1))
    monkeypatch.setattr(
        MultiTrack,
        "of",
        lambda asked, prompts, ear, *_, questions: MultiTrack(asked, prompts, ear, truth, [], questions=questions),
    )
    prepared([prompt.text for prompt in read_atomic_prompts(BUNDLED / "prompts.json")]).write(tmp_path / "cache")
    built = {number: open_mtt(AnyText(), tmp_path / "cache", 20, number) for number in (None, 3)}
    texts = {number: [prompt.text for prompt in opened.atomic_prompts] for number, opened in built.items()}
    assert len(set(texts[3])) == len(texts[None])
    assert not set(texts[3]) & {text for content in CONTENTS.values() for text in content.sentences}
    words = dict(zip(texts[None], texts[3], strict=True))
    for timeline, before in zip(built[3].requested, built[None].requested, strict=True):
        assert timeline.prompts == tuple(dataclasses.replace(each, text=words[each.text]) for each in before.prompts)
    assert built[3].questions == {words[text]: each for text, each in built[None].questions.items()}
    with pytest.raises(SettingError, match="paraphrase=4: must be null, 1, 2 or 3"):
        open_mtt(AnyText(), tmp_path / "cache", paraphrase=4)


def test_a_text_that_no_held_out_clip_shows_is_named(tmp_path, work, quick):
    texts = [prompt.text for prompt in read_atomic_prompts(work / "assets" / "open_mtt" / "prompts.json")]
    prepared(texts[1:]).write(tmp_path / "cache")
    with pytest.raises(CacheError, match=f"no held-out clip shows '{texts[0]}'"):
        open_mtt(AnyText(), tmp_path / "cache")


def test_footage_says_what_it_does_not_have():
    shown = cache_reference_motions(prepared(["bow"]), REPRESENTATION)
    assert len(shown("dataset-1_bow_normal_001", 1.0, 2.0)) == 20
    with pytest.raises(CacheError, match="no clip 'jump' among 2"):
        shown("jump", 0.0, 1.0)
    with pytest.raises(
        ValueError, match=r"dataset-1_bow_normal_001: seconds 2 to 20 exceed the motion of 9\.5 seconds"
    ):
        shown("dataset-1_bow_normal_001", 2.0, 20.0)


# The script ---------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def work(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("evaluation")
    save(tiny(), folder / "model", "card")
    save_evaluator(evaluator(), folder / "tmr", "card")
    assets = folder / "assets" / "open_mtt"
    assets.mkdir(parents=True)
    entries = [json.loads((BUNDLED / name).read_text("utf-8")) for name in ("timelines.json", "prompts.json")]
    timelines = entries[0][:2]
    asked = {prompt["text"] for timeline in timelines for track in timeline["tracks"] for prompt in track}
    (assets / "timelines.json").write_text(json.dumps(timelines))
    (assets / "prompts.json").write_text(json.dumps([each for each in entries[1] if each["text"] in asked]))
    prepared(sorted(asked)).write(folder / "cache")
    return folder


SHOTS = (
    ("walk", "normal", "train", 60, False),
    ("walk", "normal", "test", 240, False),
    ("walk-left", "normal", "test", 120, False),
    ("sit-down", "normal", "train", 40, False),
    ("sit-down", "normal", "test", 40, True),
    ("sit-down", "normal", "val", 50, False),
    ("bow", "tired", "test", 120, False),
    ("bow", "normal", "test", 20, False),
    ("bow", "normal", "test", 80, False),
    ("jump-up", "normal", "test", 30, True),
    ("kick", "normal", "train", 60, False),
)
"""Content, style, split, frames and whether it is a mirror image."""


def shots() -> Cache:
    features, clips, start = [], [], 0
    for number, (content, style, split, frames, mirrored) in enumerate(SHOTS):
        key, cyclic, end = f"{content}/{style}", CONTENTS[content].cyclic, start + frames
        parts = tuple(sorted(CONTENTS[content].parts))
        clips.append(Clip(f"clip-{number}", content, style, key, parts, cyclic, mirrored, split, start, end))
        features.append(REPRESENTATION.encode(still("bow", frames)).float())
        start = end
    return Cache(20, "smpl", torch.cat(features), tuple(clips), {c.texts: describe(c.content, c.style) for c in clips})


def test_ground_truth_is_held_out_and_contents_without_any_are_named():
    script, cache = loaded("open_mtt"), shots()
    prompts = script.atomic_prompts(cache)
    assert [(each.text, each.clip, each.end) for each in prompts] == [
        ("bow", "clip-8", 4.0),  # neither the one in a style nor the brief one
        ("sit down", "clip-5", 2.5),
        ("walk", "clip-1", 9.2),  # any of its pieces is a walk
    ]
    assert [(each.longest, each.cyclic) for each in prompts] == [(9.0, False), (4.0, False), (9.2, True)]
    assert script.find_omitted(cache, prompts) == ["jump-up", "kick"]


def test_each_of_two_clips_at_once_is_asked_about_and_all_of_what_happens_once_is_there():
    script, cache = loaded("open_mtt"), shots()
    prompts = script.atomic_prompts(cache)
    bow, sit, walk = (each.text for each in prompts)
    alone, composed = script.single_motions(cache, prompts), script.composed_motions(cache, prompts)
    assert sorted(map(len, alone[walk])) == [120, 184]
    assert {len(motion) for motion in composed[walk]} == {120, 184}
    assert {len(motion) for motion in composed[sit]} <= {40, 50}  # on legs: as long as the sitting itself
    assert {len(motion) for motion in composed[bow]} <= {20, 80, 120}
    whole = dataclasses.replace(prompts[0], parts=frozenset(BodyPart))
    assert script.composed_motions(cache, [whole, prompts[2]])[bow] == []


def test_the_open_benchmark_is_the_same_for_its_seed_and_says_how_its_prompts_are_heard(work, tmp_path, capsys):
    shots().write(tmp_path / "cache")
    for name, seed in (("one", 3), ("same", 3), ("other", 4)):
        settings = (f"cache=[{tmp_path / 'cache'}]", f"output={tmp_path / name}", f"seed={seed}", "count=5")
        run("open_mtt", "open_mtt", *settings, f"evaluator={work / 'tmr'}")
    made = {name: (tmp_path / name / "timelines.json").read_text("utf-8") for name in ("one", "same", "other")}
    assert made["one"] == made["same"] != made["other"]
    assert len(Timeline.read_all(tmp_path / "one" / "timelines.json")) == 5
    printed = capsys.readouterr().out
    assert "no held-out clip shows jump-up, kick" in printed and "R@1" in printed


def evaluated(work: Path, *settings: str) -> None:
    """The script's main job, in this process."""
    run(
        "evaluate",
        "evaluate",
        f"models.MDM-SMPL={work / 'model'}",
        f"evaluator={work / 'tmr'}",
        f"benchmark.cache={work / 'cache'}",
        "benchmark.first=2",
        "device=cpu",
        "precision=fp32",
        "batch=1",
        *settings,
    )


@pytest.fixture
def quick(monkeypatch, work) -> None:
    quicken(monkeypatch, work)


def quicken(patch: pytest.MonkeyPatch, work: Path) -> None:
    """Two of the bundled timelines and their prompts, FID with few real clips: they are not what is tested."""
    patch.setattr("stmc.evaluation.benchmarks.multi_track.PER_TEXT", 2)
    patch.setattr("stmc.evaluation.benchmarks.multi_track.files", lambda package: work)


@pytest.mark.slow
def test_the_script_compares_goes_on_and_refuses_what_does_not_compare(work, quick):
    output = f"output={work / 'out'}"
    few = (
        "experiment.settings.steps=[2]",
        "experiment.methods=[one_text, sinc, stmc, independent]",
        "experiment.settings.stitch_from=[0, 0.5]",
    )
    evaluated(work, output, "seeds=[0]", *few)
    results = read_results(work / "out" / "results.jsonl")
    assert [(each.method, each.sampling.stitch_from) for each in results] == [
        ("ground_truth", None), ("one_text", None), ("sinc", None), ("stmc", 0), ("stmc", 0.5), ("independent", None)
    ]  # fmt: skip
    assert not list((work / "out" / "unfinished").iterdir())
    assert {"about.json", "comparison.txt", "comparison.tex", "comparison.png"} <= {
        path.name for path in (work / "out").iterdir()
    }
    table = (work / "out" / "comparison.txt").read_text()
    assert "STMC (cross-faded), from 50% on" in table
    evaluated(work, output, "seeds=[0, 1]", *few, "experiment.figure=null")
    again = read_results(work / "out" / "results.jsonl")
    assert again[: len(results)] == results
    assert [each.seed for each in again] == [0] * 6 + [1] * 6
    assert "means over 2 seeds" in (work / "out" / "comparison.txt").read_text()
    with pytest.raises(ValueError, match=r"method='walk': choose from one_text, single_track"):
        evaluated(work, output, "experiment.methods=[walk]")
    with pytest.raises(ValueError, match="holds results of another benchmark"):
        evaluated(work, output, "seeds=[0]", *few, "benchmark.first=1")
    about = json.loads((work / "out" / "about.json").read_text())
    assert about["versions"]["stmc"] == stmc.__version__


def test_a_killed_run_keeps_the_motions_it_had_made(work, quick, monkeypatch):
    settings = (
        f"output={work / 'killed'}",
        "seeds=[3]",
        "experiment.settings.steps=[2]",
        "experiment.methods=[stmc]",
        "experiment.settings.stitch_from=[0]",
        "experiment.figure=null",
    )
    generate, calls = stmc.Model.generate, []

    def dying(self, timelines, *others, **settings):
        calls.append(timelines)
        if len(calls) == 2:
            raise KeyboardInterrupt
        return generate(self, timelines, *others, **settings)

    monkeypatch.setattr(stmc.Model, "generate", dying)
    with pytest.raises(KeyboardInterrupt):
        evaluated(work, *settings)
    evaluated(work, *settings)
    assert len(calls) == 3
    monkeypatch.setattr(stmc.Model, "generate", generate)
    evaluated(work, f"output={work / 'whole'}", *settings[1:])
    killed, whole = (read_results(work / name / "results.jsonl") for name in ("killed", "whole"))
    assert killed == whole


def few(output: Path) -> tuple[str, ...]:
    methods, figure = "experiment.methods=[stmc]", "experiment.figure=null"
    return (f"output={output}", "seeds=[3]", "experiment.settings.steps=[2]", methods, figure)


def test_shares_make_what_one_process_makes_and_the_last_one_measures(work, quick, tmp_path, capsys):
    evaluated(work, *few(tmp_path / "whole"))
    assert not (tmp_path / "shares" / "results.jsonl").exists()
    evaluated(work, *few(tmp_path / "shares"), "shard=2/2")
    assert "shard 2/2 is complete" in capsys.readouterr().out
    assert {each.method for each in read_results(tmp_path / "shares" / "results.jsonl")} == {"ground_truth"}
    with pytest.raises(ValueError, match=r"motions are missing of shard 1/2 \(1\); run these shards"):
        evaluated(work, *few(tmp_path / "shares"), "shard=all/2")
    evaluated(work, *few(tmp_path / "shares"), "shard=1/2")
    one, two = (read_results(tmp_path / name / "results.jsonl") for name in ("whole", "shares"))
    assert one == two  # a timeline at a time: bit for bit
    assert (tmp_path / "whole" / "comparison.txt").read_text() == (tmp_path / "shares" / "comparison.txt").read_text()


def test_shares_made_in_different_folders_are_one_run_once_they_are_in_one(work, quick, tmp_path):
    for number in (1, 2):
        evaluated(work, *few(tmp_path / str(number)), f"shard={number}/2")
    shutil.copytree(tmp_path / "1" / "unfinished", tmp_path / "2" / "unfinished", dirs_exist_ok=True)
    evaluated(work, *few(tmp_path / "2"), "shard=all/2")
    assert {each.method for each in read_results(tmp_path / "2" / "results.jsonl")} == {"ground_truth", "stmc"}


def share(rank: int, work: Path, *settings: str) -> None:
    """What one of two processes does that `accelerate launch` started."""
    os.environ |= {"RANK": str(rank), "WORLD_SIZE": "2"}
    with pytest.MonkeyPatch.context() as patch:
        quicken(patch, work)
        evaluated(work, "threads=1", *settings)


def test_an_output_folder_of_before_a_setting_existed_goes_on_unless_the_setting_is_used(tmp_path):
    begin, conditions = loaded("evaluate").begin, {"models": {}, "benchmark": {"cache": "c", "first": None}}
    begin(tmp_path, conditions)
    begin(tmp_path, conditions | {"benchmark": {"cache": "c", "first": None, "paraphrase": None}})
    with pytest.raises(ValueError, match="holds results of another benchmark"):
        begin(tmp_path, conditions | {"benchmark": {"cache": "c", "first": None, "paraphrase": 1}})


@pytest.mark.slow
def test_two_processes_at_once_evaluate_without_losing_a_record(work, tmp_path):
    several = (
        "experiment.settings.steps=[2,3,4]",
        "experiment.table._target_=stmc.evaluation.results.sweep_table",
        "+experiment.table.varied=[steps]",
    )
    fresh = get_context("spawn")  # a fork of a process whose threads have computed may wait for them for ever
    arguments = (work, *few(tmp_path / "out"), *several)
    processes = [fresh.Process(target=share, args=(rank, *arguments), daemon=True) for rank in (0, 1)]
    for process in processes:
        process.start()
    for process in processes:
        process.join(timeout=600)
    assert [process.exitcode for process in processes] == [0, 0]
    results = read_results(tmp_path / "out" / "results.jsonl")
    assert sorted(each.sampling.steps or 0 for each in results) == [0, 2, 3, 4]
    assert (tmp_path / "out" / "comparison.txt").exists()
    assert not list((tmp_path / "out" / "unfinished").iterdir())


EXPERIMENTS = sorted({path.stem for path in (ROOT / "configs" / "experiment").glob("*.yaml")} - {"base"})


@pytest.mark.parametrize("name", EXPERIMENTS)
def test_whatever_an_experiment_asks_for_can_be_shown(name):
    """Its table and its figure, of records without any sampling: nobody should learn at the end that they cannot."""
    experiment = configured("evaluate", f"experiment={name}").experiment
    models = {"MDM-SMPL": tiny()}
    if "flow_mdm" in experiment.methods:
        models["FlowMDM"] = dataclasses.replace(tiny(), denoiser=FlowMdm(205, 384, 90, 16, 32, 1, 2))
    settings = list(dict.fromkeys(loaded("evaluate").choose_settings(experiment, models, ())))
    keys = [measure.key for measure in MEASURES]
    results = [
        Result(seed=seed, metrics=dict.fromkeys(keys, 1.0 + seed), curves={"jerk": [1.0] * 17}, **vars(setting))
        for setting in settings
        for seed in (0, 1)
    ]
    table = instantiate(experiment.table)(results)
    assert sum(len(block) for block in table.blocks) >= len(settings) - experiment.real
    if experiment.figure:
        assert instantiate(experiment.figure)(results).axes
