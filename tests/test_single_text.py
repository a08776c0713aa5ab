"""HumanML3D's benchmark of single texts, from files in their published forms, held to the published formulas written
anew and slowly."""

import math
import pickle

import numpy as np
import pytest
import torch
from helpers import guo_files
from helpers.guo_formulas import slow_fid, slow_motions, slow_pairs, slow_texts, slow_words
from helpers.motions import walking
from helpers.scripts import configured, run
from helpers.tiny_model import tiny
from torch.testing import assert_close

import stmc
from stmc.data.preparation import LayoutError
from stmc.data.sources.humanml3d.humanml3d_clips import read_captioned_clips
from stmc.evaluation.benchmarks import Benchmark, SingleText
from stmc.evaluation.results import read_results
from stmc.io.arrays import ArraysError
from stmc.motion.representation import HumanML3DRepresentation
from stmc.run import save
from stmc.run.published import CheckpointError, read_guo_evaluator
from stmc.text.glove import Glove


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """Everything that a user of the benchmark has; the settings that name it."""
    folder = tmp_path_factory.mktemp("single_text")
    return {"folder": guo_files.dataset(folder / "HumanML3D")} | guo_files.evaluator(folder / "t2m")


@pytest.fixture(scope="module")
def evaluator(files):
    return read_guo_evaluator(files["weights"], files["statistics"], files["glove"])


@pytest.fixture(scope="module")
def clips(files):
    return read_captioned_clips(files["folder"])


def small(clips, evaluator, **changes) -> SingleText:
    return SingleText(clips, evaluator, **({"texts": 3, "samples": 4, "pairs": 2, "diversity_pairs": 20} | changes))


# The slow way ---------------------------------------------------------------------------------------------------------


def slow_precision(texts: np.ndarray, motions: np.ndarray, top: int) -> float:
    hits = 0
    for start in range(0, len(texts), 32):
        for place in range(32):
            distances = np.linalg.norm(motions[start : start + 32] - texts[start + place], axis=1)
            hits += place in np.argsort(distances)[:top]
    return hits / len(texts)


def slow_scores(benchmark: SingleText, files, rows, captions, seed: int) -> dict[str, float]:
    order = np.random.default_rng(seed).permutation(len(rows))[:32]
    motions = slow_motions([rows[index] for index in order])
    texts = slow_texts(files["glove"], [captions[index] for index in order])
    real = slow_motions([each.features for each in benchmark._real(seed, 1)])
    first, second = slow_pairs(32, 20, seed)
    return {f"r_precision_{top}": slow_precision(texts, motions, top) for top in (1, 2, 3)} | {
        "motion_fid": slow_fid(motions, real),
        "mm_dist": float(np.mean([np.linalg.norm(a - b) for a, b in zip(texts, motions, strict=True)])),
        "diversity": float(np.linalg.norm(motions[first] - motions[second], axis=1).mean()),
    }


# Words ----------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "caption",
    [
        "a/DET person/NOUN walk/VERB in/ADP a/DET circle/NOUN",
        "someone/PRON raise/VERB slowly/ADV an/DET arm/NOUN",
        "somebody/PRON moonwalk/VERB",
        "walk/PROPN person/X",
        " ".join(["walk/VERB"] * 19),
        " ".join(["walk/VERB"] * 20),
        " ".join(["person/NOUN"] * 30),
    ],
)
def test_words_and_parts_of_speech_are_looked_up_as_published(files, caption):
    words, kinds, length = slow_words(files["glove"], caption)
    found = Glove.read(files["glove"]).encode(["walk/VERB", caption])
    assert_close(found[0][1].double(), torch.from_numpy(words), atol=1e-6, rtol=1e-6)
    assert torch.equal(found[1][1].double(), torch.from_numpy(kinds))
    assert found[2].tolist() == [3, length]


class Malicious:
    def __reduce__(self):
        return print, ("run",)


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("our_vab_idx.pkl", None, "has no our_vab_idx.pkl"),
        ("our_vab_data.npy", None, "has no our_vab_data.npy"),
        ("our_vab_idx.pkl", pickle.dumps(Malicious()), "refused to run"),
        ("our_vab_idx.pkl", pickle.dumps({"walk": 1.5, "sos": 0}), "words and integers only"),
        ("our_vab_idx.pkl", pickle.dumps(["walk"]), "holds a list"),
        ("our_vab_idx.pkl", pickle.dumps({"walk": 0}), "lack sos, eos, unk"),
        ("our_vab_idx.pkl", pickle.dumps({"sos": 0, "eos": 1, "unk": 99}), "beyond the 13 vectors"),
        ("our_vab_idx.pkl", b"no", "damaged"),
    ],
)
def test_a_damaged_glove_folder_is_an_error_and_nothing_of_it_is_run(name, content, message, tmp_path, capsys):
    folder = guo_files.glove(tmp_path / "glove")
    (folder / name).unlink() if content is None else (folder / name).write_bytes(content)
    with pytest.raises(ArraysError, match=message):
        Glove.read(folder)
    assert not capsys.readouterr().out


# The evaluator and the data set ---------------------------------------------------------------------------------------


def test_embeddings_are_those_of_the_network_on_padded_normalised_features(files, evaluator, clips):
    rows, captions = [clip.features for clip in clips[:5]], [clip.captions[0].tagged for clip in clips[:5]]
    assert len({len(row) for row in rows}) > 1
    assert_close(evaluator.motions(rows), torch.from_numpy(slow_motions(rows)), atol=1e-5, rtol=1e-5)
    texts = torch.from_numpy(slow_texts(files["glove"], captions))
    assert_close(evaluator.texts(captions), texts, atol=1e-5, rtol=1e-5)


def test_features_of_a_motion_are_those_of_its_joints_and_the_last_frame_goes_on(evaluator):
    motion = walking(3.0, 20.0)
    features = evaluator.features(motion)
    assert features.shape == (60, 263)
    assert_close(features[:-1], HumanML3DRepresentation().encode(motion).float())
    assert torch.equal(features[-1], features[-2])
    assert len(evaluator.features(walking(3.0, 60.0))) == 60


@pytest.mark.parametrize("name", ["mean.npy", "std.npy"])
def test_statistics_that_are_missing_or_of_another_width_are_errors(files, name, tmp_path):
    given = guo_files.evaluator(tmp_path / "t2m")
    np.save(given["statistics"] / name, np.ones(251))
    with pytest.raises(CheckpointError, match=r"263 numbers, not \[251\]"):
        read_guo_evaluator(**given)
    (given["statistics"] / name).unlink()
    with pytest.raises(CheckpointError, match=f"{name} does not exist"):
        read_guo_evaluator(**given)


def test_clips_count_as_the_published_data_set_counts_them(files, clips):
    """By hand: 36 clips of 71 frames and more with their captions; 000001 has one of its seconds 1 to 3.25, too."""
    assert len(clips) == 37
    by_name = {clip.name: clip for clip in clips}
    assert [caption.text for caption in by_name["000000"].captions] == [
        "a person walks in a circle.",
        "someone walks 000000",
    ]
    assert by_name["000000"].captions[0].tagged == "a/DET person/NOUN walk/VERB in/ADP a/DET circle/NOUN"
    assert len(by_name["000001"].captions) == 1
    part, whole = by_name["000001/0"], by_name["000001"]
    assert [caption.text for caption in part.captions] == ["raises an arm"]
    assert torch.equal(part.features, whole.features[20:65])


def test_a_folder_without_the_split_or_without_clips_is_an_error(tmp_path):
    with pytest.raises(LayoutError, match=r"test\.txt does not exist"):
        read_captioned_clips(tmp_path)
    (tmp_path / "test.txt").write_text("000000\n")
    with pytest.raises(LayoutError, match="no clip can be used; 000000: no file"):
        read_captioned_clips(tmp_path)


# The benchmark --------------------------------------------------------------------------------------------------------


def test_what_is_asked_is_as_long_as_whole_movements_of_the_clips(clips, evaluator):
    benchmark = small(clips, evaluator)
    assert isinstance(benchmark, Benchmark)
    timelines = benchmark.timelines("stmc")
    assert len(timelines) == 37 + 3 * 3
    shorter = 0
    for timeline, request in zip(timelines, benchmark.requests, strict=False):
        [clip] = [
            clip for clip in clips if request.caption in clip.captions and _within(request.features, clip.features)
        ]
        assert timeline.frames(20) == len(request.features)
        lost = len(clip.features) // 4 - len(request.features) // 4
        assert lost in (0, 1) and len(request.features) % 4 == 0
        shorter += lost
    assert 0 < shorter < 37
    assert [timeline.prompts for timeline in timelines[37:40]] == [timeline.prompts for timeline in timelines[:3]]
    assert {timeline.prompts[0].text for timeline in benchmark.timelines("sinc")} == {
        request.caption.text for request in benchmark.requests
    }


def _within(part, whole) -> bool:
    return any(torch.equal(part, whole[start : start + len(part)]) for start in range(len(whole) - len(part) + 1))


def test_scores_are_the_published_formulas(clips, evaluator, files):
    benchmark = small(clips, evaluator)
    motions = [
        walking(len(each.features) / 20, 20.0, speed=1 + 0.02 * number, turn=0.01 * number)
        for number, each in enumerate([*benchmark.requests, *benchmark.requests[:3] * 3])
    ]
    rows = [evaluator.features(motion) for motion in motions]
    captions = [request.caption.tagged for request in benchmark.requests]
    expected = slow_scores(benchmark, files, rows[:37], captions, seed=5)
    first, second = slow_pairs(4, 2, 5)
    samples = slow_motions(rows)
    samples = [samples[[text, 37 + text, 40 + text, 43 + text]] for text in range(3)]
    apart = [np.linalg.norm(each[first] - each[second], axis=1) for each in samples]
    found = benchmark.measured("stmc_paper", motions, seed=5).metrics
    assert found == pytest.approx(expected | {"multimodality": np.mean(apart)}, rel=2e-3, abs=2e-4)


def test_real_motion_is_scored_against_other_draws_of_itself(clips, evaluator, files):
    benchmark = small(clips, evaluator)
    drawn = benchmark._real(3, 2)
    expected = slow_scores(
        benchmark, files, [each.features for each in drawn], [each.caption.tagged for each in drawn], seed=3
    )
    assert benchmark.real(3).metrics == pytest.approx(expected, rel=2e-3, abs=2e-4)
    assert benchmark.real(3) == benchmark.real(3) != benchmark.real(4)


class Knowing:
    """Texts and motions are at the very place that a caption's words and a motion's first frame say: closed forms."""

    fps = 20

    def texts(self, texts):
        return torch.tensor([[float(sum(map(ord, text))), 0.0] for text in texts])

    def motions(self, features):
        return torch.stack([row[0, :2] for row in features])

    def features(self, motion):
        raise AssertionError


def test_of_an_evaluator_that_knows_the_answer_real_motion_is_perfect(clips):
    place, numbered = Knowing(), []
    for number, clip in enumerate(clips):
        caption = type(clip.captions[0])("walks", 0.0, 0.0, chr(100 + number))
        where = place.texts([caption.tagged])[0]
        numbered.append(type(clip)(clip.name, torch.cat([where, torch.zeros(261)]).repeat(60, 1), (caption,)))
    scores = SingleText(numbered, place, texts=0, diversity_pairs=20).real(0).metrics
    assert [scores[f"r_precision_{top}"] for top in (1, 2, 3)] == [1, 1, 1]
    assert scores["mm_dist"] == 0 and "multimodality" not in scores


@pytest.mark.parametrize("changes", [{"first": 31}, {"diversity_pairs": 33}, {"texts": 38}, {"samples": 1}])
def test_less_than_is_compared_is_an_error(clips, evaluator, changes):
    with pytest.raises(ValueError, match="clips are too few for a pool of 32"):
        small(clips, evaluator, **changes)


def test_another_number_of_motions_is_an_error(clips, evaluator):
    with pytest.raises(ValueError, match="1 motions for 46 timelines"):
        small(clips, evaluator).measured("stmc", [walking(3.0)], 0)


# The command ----------------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_the_command_prints_the_fields_table_with_the_published_rows(files, evaluator, clips, tmp_path, capsys):
    save(tiny(longest=200), tmp_path / "model", "card")
    asked = {"folder": "clips.folder"} | {name: f"evaluator.{name}" for name in ("weights", "statistics", "glove")}
    settings = [f"benchmark.{setting}={files[name]}" for name, setting in asked.items()]
    settings += [f"models.MDM-SMPL={tmp_path / 'model'}", f"output={tmp_path / 'out'}", "seeds=[0,1]", "device=cpu"]
    settings += [f"benchmark.{name}={value}" for name, value in (("texts", 3), ("samples", 4), ("pairs", 2))]
    settings += ["benchmark.diversity_pairs=20", "benchmark.joints_from=skeleton", "precision=fp32"]
    settings += ["experiment.settings.steps=[2]"]
    run("evaluate", "evaluate", "benchmark=humanml3d", *settings)
    results = read_results(tmp_path / "out" / "results.jsonl")
    assert [(result.method, result.seed) for result in results] == [
        ("ground_truth", 0), ("stmc_paper", 0), ("ground_truth", 1), ("stmc_paper", 1)
    ]  # fmt: skip
    model, benchmark = stmc.load(tmp_path / "model", device="cpu"), small(clips, evaluator)
    timelines = benchmark.timelines("stmc_paper")
    for result in results[1::2]:
        seeds = [result.seed * len(timelines) + number for number in range(len(timelines))]
        motions = model.generate(timelines, seed=seeds, method="stmc_paper", steps=2, clean_feet=False)
        rows = [evaluator.features(motion) for motion in motions]
        captions = [request.caption.tagged for request in benchmark.requests]
        expected = slow_scores(benchmark, files, rows[:37], captions, result.seed)
        for name, value in expected.items():
            assert result.metrics[name] == pytest.approx(value, rel=5e-3, abs=5e-3), name
        assert result.metrics["multimodality"] > 0
    table = (tmp_path / "out" / "single_text.txt").read_text()
    values = [result.metrics["mm_dist"] for result in results[1::2]]
    half = 1.96 * abs(values[0] - values[1]) / 2 / math.sqrt(2)  # the standard deviation of two is half their distance
    assert f"{np.mean(values):.3f} ± {half:.3f}" in table
    assert "means over 2 repetitions" in table
    lines = [line for line in table.splitlines() if line.startswith("published")]
    assert [line.split()[1] for line in lines] == ["–", "MDM", "MDM-SMPL", "MotionDiffuse"]
    assert "0.740" in lines[2] and "9.67" in lines[2] and "0.380" in lines[2]


def test_the_published_protocol_is_the_default():
    config = configured("evaluate", "benchmark=humanml3d")
    asked = {name: config.benchmark[name] for name in ("first", "texts", "samples", "pairs", "diversity_pairs")}
    assert asked == {"first": None, "texts": 100, "samples": 30, "pairs": 10, "diversity_pairs": 300}
    assert list(config.seeds) == list(range(20))
