"""FlowMDM's evaluation from files in their published forms, held to the published formulas written anew and slowly."""

import dataclasses
import json
import sys
import types
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers import guo_files
from helpers.guo_formulas import slow_fid, slow_motions, slow_pairs, slow_texts
from helpers.joblib_files import joblib_bytes
from helpers.motions import walking
from helpers.scripts import configured, loaded, run
from helpers.source_folders import Serial, smplh_arrays
from helpers.tiny_model import CONFIG, WIDTH, tiny
from hydra.utils import instantiate
from torch import Tensor

from stmc.data import preparation
from stmc.data.cache import Cache, Clip
from stmc.data.preparation import LayoutError
from stmc.data.sources import caption_tags
from stmc.data.sources.babel.composition_lists import Composition, read_compositions, sample_compositions
from stmc.data.sources.babel.composition_references import References, babel_references, humanml3d_references
from stmc.data.sources.caption_tags import TagError, Tags
from stmc.denoisers import FlowMdm
from stmc.diffusion.statistics import Statistics
from stmc.evaluation.benchmarks import Benchmark, PublishedCompositions
from stmc.evaluation.metrics.smoothness import JERKED
from stmc.evaluation.results import Result, published_results, read_results
from stmc.evaluators import GuoEvaluator, MatchingEvaluator
from stmc.model import Model
from stmc.motion.representation import BabelRepresentation
from stmc.run import save
from stmc.run.published import CheckpointError, read_guo_evaluator

TEXTS = ("a person walks in a circle.", "someone walks 000003", "raises an arm")
SHORT = [[TEXTS[number % 3] for number in range(32)], [40 + number % 5 for number in range(32)]]


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """What a user of the benchmark has, by the names of the settings."""
    folder = tmp_path_factory.mktemp("flow")
    entry = {"id": 7, "text": SHORT[0], "lengths": SHORT[1], "scenario": "short"}
    again = {"id": 8, "text": ["raises an arm"] * 32, "lengths": [40] * 32, "scenario": "long"}
    (folder / "list.json").write_text(json.dumps([entry, again]))
    found = {"folder": guo_files.dataset(folder / "HumanML3D"), "list": folder / "list.json"}
    return found | guo_files.evaluator(folder / "t2m")


@pytest.fixture(scope="module")
def references(files) -> References:
    return humanml3d_references(files["folder"], seed=3)


@pytest.fixture(scope="module")
def evaluator(files) -> MatchingEvaluator:
    return read_guo_evaluator(files["weights"], files["statistics"], files["glove"], longest=200)


@pytest.fixture(scope="module")
def tags(files) -> Tags:
    return Tags.read(files["folder"] / "texts")


def benchmark(files, references, evaluator, tags, scenario="short", **changes) -> PublishedCompositions:
    listed = read_compositions(files["list"], scenario)
    return PublishedCompositions(references, evaluator, tags, listed, **({"diversity_pairs": 20} | changes))


# Lists ----------------------------------------------------------------------------------------------------------------


def test_a_list_is_read_as_published_and_by_scenario(files):
    both = read_compositions(files["list"])
    assert [(each.name, each.scenario, len(each.texts)) for each in both] == [("7", "short", 32), ("8", "long", 32)]
    assert read_compositions(files["list"], "short") == [Composition("7", *map(tuple, SHORT), "short")]


def test_one_object_alone_is_a_list_of_one_and_an_entry_without_a_scenario_is_of_every_one(tmp_path):
    (tmp_path / "one.json").write_text(json.dumps({"lengths": [64, 42], "text": ["turn left", "walk"]}))
    assert read_compositions(tmp_path / "one.json", "short") == [Composition("0", ("turn left", "walk"), (64, 42))]


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("[{]", "not JSON"),
        ("[3]", "entry 0 must be an object"),
        ('[{"text": ["a"], "lengths": [1, 2]}]', "entry 0: text and lengths must be nonempty lists of equal length"),
        ('[{"text": [], "lengths": []}]', "lists of equal length"),
        ('[{"text": ["a"], "lengths": [true]}]', "lengths holds true"),
        ('[{"text": ["a"], "lengths": [99999999]}]', "lengths holds 99999999"),
        ('[{"text": [" "], "lengths": [4]}]', "text holds ' '"),
        ('[{"text": ["a"], "lengths": [4], "scenario": 3}]', "scenario 3 and id"),
        ('[{"text": ["a"], "lengths": [4], "scenario": "long"}]', "no composition of scenario 'short'; it has long"),
        ("[]", "no composition"),
    ],
)
def test_what_is_no_list_of_compositions_is_an_error(content, message, tmp_path):
    (tmp_path / "list.json").write_text(content)
    with pytest.raises(LayoutError, match=message):
        read_compositions(tmp_path / "list.json", "short")


def test_compositions_are_drawn_from_clips_with_their_own_captions_and_frames(references):
    drawn = sample_compositions(references.clips, 4, 32, seed=1)
    known = {(caption.text, len(clip.features)) for clip in references.clips for caption in clip.captions}
    pairs = {pair for each in drawn for pair in zip(each.texts, each.lengths, strict=True)}
    assert len(drawn) == 4 and pairs <= known and len(pairs) > 20
    assert drawn == sample_compositions(references.clips, 4, 32, seed=1) != sample_compositions(references.clips, 4)


# Real motion ----------------------------------------------------------------------------------------------------------


def test_humanml3d_gives_clips_of_the_paper_s_lengths_and_a_window_of_each(files, references):
    """By hand: 36 clips of 71 frames and more; the part of 000001 has 45 frames, too few for a window."""
    assert len(references.clips) == 36 and references.windows.shape == (36, 60, 263)
    assert min(len(clip.features) for clip in references.clips) >= 70
    for clip, window in zip(references.clips, references.windows, strict=True):
        places = range(len(clip.features) - 59)
        assert any(torch.equal(clip.features[place : place + 60], window) for place in places)
    assert len(humanml3d_references(files["folder"], shortest=100).clips) < 36
    with pytest.raises(LayoutError, match="0 clips with texts"):
        humanml3d_references(files["folder"], shortest=198, longest=198)


def babel_cache(folder, seconds: int = 30):
    """One recording with actions that touch each other, a transition between each two."""
    representation, fps = BabelRepresentation(), 30
    rows = representation.encode(walking(float(seconds), 30.0, turn=0.5)).float()
    names, clips, texts = ("walk", "transition", "t pose"), [], {}
    for number in range(seconds // 2):
        name = names[number % 3]
        texts[name] = ((name, 1.0),)
        place = (60 * number, 60 * number + (50 if number == 0 else 60))
        clips.append(Clip(f"{number}", name, "", name, (), False, False, "val", *place, "r", 1, (0, len(rows))))
    Cache(fps, "babel", rows, tuple(clips), texts).write(folder)
    return folder


def test_babel_gives_clips_without_transitions_and_windows_out_of_its_recordings(tmp_path):
    found = babel_references(babel_cache(tmp_path / "cache"), seed=2)
    rows = Cache.read(tmp_path / "cache").features
    assert [caption.text for clip in found.clips for caption in clip.captions] == ["walk", "t-pose"] * 5
    for clip in found.clips:
        start = 60 * int(clip.name)
        assert torch.equal(clip.features, rows[start : start + (50 if start == 0 else 60)])
    assert found.windows.shape == (len(rows) // 30, 30, 135)
    assert all((rows.unfold(0, 30, 1).mT == window).all(dim=(1, 2)).any() for window in found.windows)
    with pytest.raises(LayoutError, match="split test: 0 clips"):
        babel_references(tmp_path / "cache", split="test")


# Tags -----------------------------------------------------------------------------------------------------------------


def test_captions_are_tagged_by_their_files_and_others_by_spacy(tags, monkeypatch):
    words = {"walks": ("walk", "VERB"), "left": ("leave", "VERB"), "tpose": ("tpose", "NOUN"), "3": ("3", "NUM")}

    def pipeline(text):
        return [types.SimpleNamespace(text=word, lemma_=words[word][0], pos_=words[word][1]) for word in text.split()]

    assert tags(["raises  an arm"]) == ["raise/VERB an/DET arm/NOUN"]
    monkeypatch.setitem(sys.modules, "spacy", types.SimpleNamespace(load=lambda name: pipeline))
    caption_tags._load_pipeline.cache_clear()
    assert tags(["walks left t-pose 3"]) == ["walk/VERB left/VERB tpose/NOUN"]
    caption_tags._load_pipeline.cache_clear()


def test_a_caption_without_tags_is_an_error_that_says_where_they_come_from(tags, monkeypatch, tmp_path):
    monkeypatch.setitem(sys.modules, "spacy", None)
    with pytest.raises(TagError, match="the caption 'hop' has no parts of speech; pass a file"):
        tags(["hop"])
    with pytest.raises(TagError, match="does not exist"):
        Tags.read(tmp_path / "none")
    (tmp_path / "tags.txt").write_text("hop#hop/VERB#0.0#0.0\n")
    assert Tags.read(tmp_path / "tags.txt")(["hop"]) == ["hop/VERB"]


# Scores ---------------------------------------------------------------------------------------------------------------


def slow_precision(texts: np.ndarray, motions: np.ndarray, captions: list[str]) -> float:
    """Top 3, of 32 at a time, without captions that come a second time; counts scaled up to 32."""
    found = 0.0
    for start in range(0, len(captions), 32):
        rows = [start + place for place in np.unique(captions[start : start + 32], return_index=True)[1]]
        hits = sum(
            number in np.argsort(np.linalg.norm(motions[rows] - texts[row], axis=1))[:3]
            for number, row in enumerate(rows)
        )
        found += hits * 32 / len(rows)
    return found / len(captions)


def slow_jerk(joints: Tensor, start: int) -> list[float]:
    """Of a window of 60 frames, turned to begin with heading zero: the largest third difference of any joint."""
    rows = joints[start : start + 60, :JERKED].numpy()
    across = (rows[0, 1] - rows[0, 2]) + (rows[0, 16] - rows[0, 17])
    angle = np.arctan2(across[1], across[0]) - np.pi / 2
    turn = np.array([[np.cos(angle), np.sin(angle), 0], [-np.sin(angle), np.cos(angle), 0], [0, 0, 1]])
    rows = rows @ turn.T
    third = rows[3:] - 3 * rows[2:-1] + 3 * rows[1:-2] - rows[:-3]
    return np.abs(third).sum(axis=2).max(axis=1).tolist()


def test_scores_are_the_published_formulas(files, references, evaluator, tags):
    made = benchmark(files, references, evaluator, tags, average_jerk=0.033)
    assert isinstance(made, Benchmark)
    [timeline] = made.timelines("flow_mdm")
    assert [prompt.text for prompt in timeline.prompts] == SHORT[0]
    edges = np.cumsum([0, *SHORT[1]]).tolist()
    assert [start for start, _ in timeline.spans(20)] == edges[:-1]
    motion = walking(edges[-1] / 20, 20.0, speed=1.2, turn=0.1)
    rows = evaluator.features(motion)
    found = made.measured("flow_mdm", [motion], seed=5)
    subsequences = slow_motions([rows[start:end] for start, end in pairwise(edges)], 200)
    windows = slow_motions([rows[edge - 30 : edge + 30] for edge in edges[1:-1]], 200)
    texts = slow_texts(files["glove"], tags(SHORT[0]))
    first, second = slow_pairs(32, 20, 5)
    real = [
        slow_motions([clip.features for clip in references.clips], 200),
        slow_motions(list(references.windows), 200),
    ]
    expected = {
        "r_precision": slow_precision(texts, subsequences, SHORT[0]),
        "mm_dist": np.linalg.norm(texts - subsequences, axis=1).mean(),
        "subsequence_fid": slow_fid(subsequences, real[0]),
        "subsequence_diversity": np.linalg.norm(subsequences[first] - subsequences[second], axis=1).mean(),
        "transition_fid": slow_fid(windows, real[1]),
    }
    first, second = slow_pairs(31, 20, 5)
    expected["transition_diversity"] = np.linalg.norm(windows[first] - windows[second], axis=1).mean()
    assert {name: found.metrics[name] for name in expected} == pytest.approx(expected, rel=2e-3, abs=2e-4)
    curve = np.mean([slow_jerk(motion.joints, edge - 30) for edge in edges[1:-1]], axis=0)
    assert found.curves["jerk"] == pytest.approx(curve.tolist(), rel=0.05, abs=1e-4)
    assert found.metrics["peak_jerk"] == max(found.curves["jerk"])
    assert found.metrics["area_under_jerk"] == pytest.approx(sum(abs(each - 0.033) for each in found.curves["jerk"]))


def test_real_motion_is_what_fid_compares_with(files, references, evaluator, tags):
    made = benchmark(files, references, evaluator, tags)
    scores = made.real(3)
    assert [scores.metrics[f"{name}_fid"] for name in ("subsequence", "transition")] == pytest.approx([0, 0], abs=1e-4)
    assert scores == made.real(3) != made.real(4)
    assert scores.metrics["area_under_jerk"] < 57 * scores.metrics["peak_jerk"]


def test_extrapolations_are_not_asked_what_they_cannot_tell(files, references, evaluator, tags):
    made = benchmark(files, references, evaluator, tags, "long")
    found = made.measured("flow_mdm", [walking(64.0, 20.0)], seed=0).metrics
    assert "subsequence_fid" in found and not {"r_precision", "mm_dist"} & set(found)


def test_a_list_in_frames_of_babel_keeps_its_frames_at_its_rate(tmp_path, files):
    found = babel_references(babel_cache(tmp_path / "cache", 90))
    network = GuoEvaluator(135, (16, 12), 10, guo_files.WIDTH, 8, 7).eval()
    weights = {name: getattr(network, name).state_dict() for name in guo_files.SECTIONS}
    torch.save(weights | {"epoch": 1}, tmp_path / "finest.tar")
    torch.save(torch.zeros(135), tmp_path / "rfeats_mean.pt")
    with pytest.raises(CheckpointError, match=r"rfeats_std\.pt does not exist"):
        read_guo_evaluator(tmp_path / "finest.tar", tmp_path, files["glove"])
    torch.save(torch.ones(135), tmp_path / "rfeats_std.pt")
    judge = read_guo_evaluator(tmp_path / "finest.tar", tmp_path, files["glove"])
    assert judge.fps == 30 and judge.features(walking(2.0, 60.0)).shape == (60, 135)
    lengths = tuple(30 + number % 47 for number in range(33))
    listed = [Composition("0", ("walk",) * 32 + ("raise",), lengths)]
    many = dataclasses.replace(found, clips=found.clips * 2)
    made = PublishedCompositions(many, judge, lambda texts: [f"{text}/VERB" for text in texts], listed, None, 20)
    [timeline] = made.timelines("flow_mdm")
    assert [end - start for start, end in timeline.spans(30)] == list(lengths)
    scores = made.measured("flow_mdm", [walking(sum(lengths) / 30 + 0.1, 30.0)], seed=0)
    assert len(scores.curves["jerk"]) == 27 and 0 < scores.metrics["r_precision"] <= 1


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"diversity_pairs": 40}, "and 40 pairs"),
        ({"compositions": None, "diversity_pairs": 37}, "36 real clips"),
    ],
)
def test_too_little_to_compare_is_an_error(changes, message, files, references, evaluator, tags):
    listed = {"compositions": read_compositions(files["list"], "short")} | changes
    with pytest.raises(ValueError, match=message):
        PublishedCompositions(references, evaluator, tags, **listed)
    short = [Composition("0", tuple("ab" * 20), (29,) * 40)]
    with pytest.raises(ValueError, match="29 frames is shorter than half of a window of 60"):
        PublishedCompositions(references, evaluator, tags, short, diversity_pairs=20)


# Experiments and tables -----------------------------------------------------------------------------------------------


def test_the_papers_protocol_is_the_default():
    for data, table, window, jerk in (("humanml3d", 2, 60, 0.033031363), ("babel", 1, 30, 0.016383045)):
        config = configured("evaluate", f"benchmark=flow_mdm_{data}")
        assert config.experiment.name == f"flowmdm_table_{table}"
        assert (config.benchmark.references.window, config.benchmark.average_jerk) == (window, jerk)
        assert (len(config.seeds), config.benchmark.diversity_pairs) == (10, 300)


def test_sampling_techniques_have_absolute_positions_throughout_and_flow_mdm_its_own():
    experiment = configured("evaluate", "experiment=flowmdm_table_1").experiment
    flow = dataclasses.replace(tiny(), denoiser=FlowMdm(205, WIDTH, 90, 16, 32, 1, 2))
    asked = list(loaded("evaluate").choose_settings(experiment, {"FlowMDM": flow, "MDM": tiny()}, ()))
    shares = {(each.denoiser, each.method): each.sampling.ape_steps for each in asked if each.denoiser}
    rules = ("teach_b", "teach", "double_take", "multi_diffusion", "single_track")
    assert shares == {("FlowMDM", rule): 1.0 for rule in rules} | {("MDM", rule): None for rule in rules} | {
        ("FlowMDM", "flow_mdm"): 0.1
    }


def test_ablations_are_sampled_with_either_encoding_where_they_have_both():
    experiment = configured("evaluate", "experiment=flowmdm_table_3").experiment
    both, one = (
        dataclasses.replace(tiny(), denoiser=FlowMdm(205, WIDTH, 90, 16, 32, 1, 2, positions=positions))
        for positions in ("blended", "relative")
    )
    settings = dict.fromkeys(loaded("evaluate").choose_settings(experiment, {"B": both, "R": one}, ()))
    asked = [each for each in settings if each.denoiser]
    assert [(each.denoiser, each.sampling.ape_steps) for each in asked] == [
        ("B", 0.1),
        ("B", 1.0),
        ("B", 0.0),
        ("R", None),
    ]


@pytest.mark.parametrize(("table", "rows"), [(1, 8), (2, 6), (3, 8), (4, 8)])
def test_tables_have_our_rows_and_the_papers(table, rows):
    theirs = {
        (each.denoiser, each.method, each.sampling.ape_steps): each.metrics
        for each in published_results(f"flowmdm_table_{table}")
    }
    assert len(theirs) == rows
    full = {
        key: metrics
        for key, metrics in theirs.items()
        if key[0] in ("FlowMDM", "PCCAT") and key[1] == "flow_mdm" and key[2] in (None, 0.125, 0.06)
    }
    [(_, metrics)] = full.items()
    assert metrics["area_under_jerk"] == (0.13 if table in (1, 3) else 0.51)
    if table == 1:  # what both readings of the damaged row have in common
        assert theirs["FlowMDM", "single_track", 1.0] == {"mm_dist": 3.71, "peak_jerk": 0.19, "area_under_jerk": 0.84}
    mine = [Result("double_take", seed, {"r_precision": 0.5, "peak_jerk": 0.1 + seed}, "M") for seed in range(3)]
    made = instantiate(configured("evaluate", f"experiment=flowmdm_table_{table}").experiment.table)(mine)
    lines = made.text().splitlines()
    assert "over 3 repetitions" in lines[0] and f"FlowMDM's Table {table}" in lines[0]
    assert sum(line.startswith("published") for line in lines) == rows
    assert {len(row.labels) for block in made.blocks for row in block} == {len(made.headings)}


@pytest.mark.slow
def test_the_command_prints_table_2_with_the_published_rows(files, tmp_path, capsys):
    model = tiny(longest=200)
    save(model, tmp_path / "model", "card")
    settings = [f"benchmark.evaluator.{name}={files[name]}" for name in ("weights", "statistics", "glove")]
    settings += [f"benchmark.references.folder={files['folder']}"]  # its own texts have the captions' tags, too
    settings += [f"benchmark.compositions.path={files['list']}", "benchmark.compositions.scenario=short"]
    settings += ["benchmark.diversity_pairs=20", "benchmark.joints_from=skeleton", "precision=fp32", "device=cpu"]
    settings += [f"models.MDM-SMPL={tmp_path / 'model'}", f"output={tmp_path / 'out'}", "seeds=[0,1]"]
    settings += ["experiment.settings.steps=[1]", "experiment.methods=[multi_diffusion]"]
    run("evaluate", "evaluate", "benchmark=flow_mdm_humanml3d", *settings)
    results = read_results(tmp_path / "out" / "results.jsonl")
    assert {(each.method, each.seed) for each in results} == {
        (name, seed) for name in ("ground_truth", "multi_diffusion") for seed in (0, 1)
    }
    table = (tmp_path / "out" / "flowmdm_table_2.txt").read_text()
    assert table in capsys.readouterr().out
    assert sum(line.startswith("published") for line in table.splitlines()) == 6
    assert (tmp_path / "out" / "flowmdm_table_2.png").stat().st_size > 0


def flow_of_babel() -> Model:
    """FlowMDM's network of 135 features at 30 frames a second, small and untrained."""
    sizes = {"width": 16, "feedforward": 32, "layers": 1, "heads": 2, "attention_window": 20, "absolute_from": 90}
    with torch.random.fork_rng():
        torch.manual_seed(0)
        network = FlowMdm(features=135, text_width=WIDTH, **sizes).eval().requires_grad_(False)
    rows = BabelRepresentation().encode(walking(2.0, 30.0)).float()
    config = {
        "denoiser": {"_target_": "stmc.denoisers.FlowMdm", "features": 135, "text_width": WIDTH} | sizes,
        "schedule": CONFIG["schedule"],
        "text_encoder": CONFIG["text_encoder"] | {"pooling": "mean"},
        "representation": {"_target_": "stmc.motion.representation.BabelRepresentation"},
    }
    return dataclasses.replace(
        tiny(30, 200),
        denoiser=network,
        representation=BabelRepresentation(),
        motion_statistics=Statistics(rows.mean(dim=0), torch.full((135,), 0.05)),
        config=config,
    )


def files_of_babel(folder) -> dict[str, Path]:
    """What FlowMDM's authors share: TEACH's processed recordings, BABEL's labels, a list, and an evaluator."""
    arrays = smplh_arrays(walking(120.0, 30.0, turn=0.5))
    entry = {"poses": arrays["poses"], "trans": arrays["trans"], "fps": 30, "fname": "KIT/KIT/3/walk_poses.npz"}
    (folder / "teach").mkdir()
    (folder / "teach/val.pth.tar").write_bytes(joblib_bytes([entry], None))
    names = [("walk", "transition", "raise slowly")[number % 3] for number in range(60)]
    labels = [
        {"raw_label": name, "proc_label": name, "start_t": 2.0 * number, "end_t": 2.0 * number + 1.9}
        for number, name in enumerate(names)
    ]
    (folder / "labels").mkdir()
    for split, sid in (("train", "1"), ("val", "2")):
        sequence = {"feat_p": "KIT/KIT/3/walk_poses.npz", "frame_ann": {"labels": labels if split == "val" else []}}
        (folder / f"labels/{split}.json").write_text(json.dumps({sid: sequence}))
    listed = {"id": 0, "text": ["walk", "raise slowly"] * 16, "lengths": [40 + number % 7 for number in range(32)]}
    (folder / "list.json").write_text(json.dumps([listed | {"scenario": "in-distribution"}]))
    (folder / "tags.txt").write_text("walk#walk/VERB#0.0#0.0\nraise slowly#raise/VERB slowly/ADV#0.0#0.0\n")
    network = GuoEvaluator(135, (16, 12), 10, guo_files.WIDTH, 8, 7).eval()
    weights = {name: getattr(network, name).state_dict() for name in guo_files.SECTIONS}
    torch.save(weights | {"epoch": 1}, folder / "finest.tar")
    for name, value in (("mean", 0.0), ("std", 1.0)):
        torch.save(torch.full((135,), value), folder / f"rfeats_{name}.pt")
    return {name: folder / name for name in ("teach", "labels", "list.json", "tags.txt", "finest.tar")}


@pytest.mark.slow
def test_table_1_comes_out_of_the_files_that_the_authors_share(files, tmp_path, monkeypatch, capsys):
    """From TEACH's processed recordings by way of the cache to the table: each command as the page has it."""
    monkeypatch.setattr(preparation, "ProcessPoolExecutor", Serial)
    shared, cache = files_of_babel(tmp_path), tmp_path / "cache"
    run("prepare", "prepare", "data=babel_flow_processed", f"source={shared['teach']}",
        f"annotations={shared['labels']}", f"folder={cache}", "workers=1")  # fmt: skip
    assert len(Cache.read(cache).clips) == 61  # each action, and the whole recording
    save(flow_of_babel(), tmp_path / "flow", "card")
    settings = [f"benchmark.compositions.path={shared['list.json']}", f"benchmark.references.cache={cache}"]
    settings += [f"benchmark.evaluator.weights={shared['finest.tar']}", f"benchmark.evaluator.statistics={tmp_path}"]
    settings += [f"benchmark.evaluator.glove={files['glove']}", f"benchmark.tags.path={shared['tags.txt']}"]
    settings += ["benchmark.diversity_pairs=15", "precision=fp32", "device=cpu", "seeds=[0]"]
    settings += ["~models", f"+models.FlowMDM={tmp_path / 'flow'}", f"output={tmp_path / 'out'}"]
    run("evaluate", "evaluate", "benchmark=flow_mdm_babel", *settings, "experiment.settings.steps=[2]")
    methods = ["TEACH_B", "TEACH", "DoubleTake", "MultiDiffusion", "DiffCollage", "FlowMDM"]
    lines = (tmp_path / "out" / "flowmdm_table_1.txt").read_text().splitlines()
    assert all(line in capsys.readouterr().out for line in lines[:1])
    own = [line.split() for line in lines if line.startswith("ours")]
    assert sorted(row[2] for row in own[1:]) == sorted(methods) and own[0][2:4] == ["Ground", "truth"]
    assert {row[2]: row[3] for row in own[1:]} == dict.fromkeys(methods, "100.0%") | {"FlowMDM": "10.0%"}
    found = {each.method: each.metrics for each in read_results(tmp_path / "out" / "results.jsonl")}
    assert found["ground_truth"]["subsequence_fid"] < min(
        metrics["subsequence_fid"] for name, metrics in found.items() if name != "ground_truth"
    )
    assert (tmp_path / "out" / "flowmdm_table_1.png").stat().st_size > 0
