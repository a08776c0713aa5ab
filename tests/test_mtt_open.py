"""MTT's timelines without AMASS: what is counted as shown, as found, and as a whole timeline; the command that asks."""

import json

import pytest
import torch
from helpers.scripts import run
from helpers.tiny_model import tiny
from omegaconf import OmegaConf
from test_mtt_checks import bumps, moved, walking

import stmc
from stmc.cli.evaluate import build_benchmark
from stmc.data.cache import Cache, Clip
from stmc.evaluation.benchmarks import Benchmark, MttOpen, mtt_open, resampling
from stmc.evaluation.benchmarks.mtt_checks import MTT_CHECKS
from stmc.evaluation.results.naming import MEASURES
from stmc.motion.motion import Motion
from stmc.motion.representation import SmplRepresentation
from stmc.settings.records import SettingError
from stmc.timeline import Prompt, Timeline, TimelineError

WALK, RAISE, BOW = "walk forwards", "raise the left arm", "bow"
ASKED = [
    Timeline((Prompt(WALK, 0, 6, ["legs"]), Prompt(RAISE, 1, 6, ["left arm"]))),
    Timeline((Prompt(WALK, 0, 6, ["legs"]), Prompt(BOW, 0, 6, ["head", "spine"]))),
]


class Judge:
    """Finds a walk in whatever moves, and in the rest the text that stands first."""

    fps = 20

    def features(self, motion: Motion) -> torch.Tensor:
        return motion.translation

    def motions(self, features) -> torch.Tensor:
        goes = [float((rows[-1] - rows[0]).norm()) > 1 for rows in features]
        return torch.stack([_one_hot(WALK if going else next(iter(MTT_CHECKS))) for going in goes])

    def texts(self, texts) -> torch.Tensor:
        return torch.stack([_one_hot(text) for text in texts])


def _one_hot(text: str) -> torch.Tensor:
    return torch.tensor([float(text == other) for other in MTT_CHECKS])


def walking_with_an_arm_raised() -> Motion:
    walk, arm = walking(1.2), moved(left_shoulder=("z", -1.3 + 2.4 * bumps(3.0, width=1.0)))
    joints = arm.joints + (walk.translation - arm.translation)[:, None]
    return Motion(arm.rotations, walk.translation, joints, walk.fps)


@pytest.fixture(autouse=True)
def few_draws(monkeypatch) -> None:
    monkeypatch.setattr(resampling, "DRAWS", 5)
    monkeypatch.setattr(resampling, "FEWEST", 2)


def test_crops_and_whole_timelines_that_are_shown_are_counted():
    scores = MttOpen(ASKED, Judge()).measured("stmc", [walking_with_an_arm_raised(), walking(1.2)], seed=0)
    metrics = scores.metrics
    assert (metrics["shown"], metrics["timelines_shown"]) == (75.0, 50.0)
    assert {text: metrics[f"shown/{text}"] for text in (WALK, RAISE, BOW)} == {WALK: 100.0, RAISE: 100.0, BOW: 0.0}
    assert metrics["recall_1"] == 50.0  # both walks; the raise and the bow are found to be walks, too
    assert {"sliding", "transition", "hand_step", "hand_step_99", "m2t"} <= set(metrics)
    assert {"shown", "timelines_shown", "recall_1"} <= set(scores.resampled)
    assert all(len(draws) == 5 for draws in scores.resampled.values())
    assert {"timelines_shown", "sliding"} <= {measure.key for measure in MEASURES}


class Bower(Judge):
    """Finds a bow in whatever moves."""

    def motions(self, features) -> torch.Tensor:
        return torch.stack([_one_hot(BOW) for _ in features])


def test_a_second_judge_is_reported_beside_the_first_and_decides_nothing_else():
    motions = [walking_with_an_arm_raised(), walking(1.2)]
    alone, both = (MttOpen(ASKED, Judge(), judge=judge).measured("stmc", motions, seed=0) for judge in (None, Bower()))
    own = {key: both.metrics[key] for key in both.metrics if key.startswith("judge_")}
    assert both.metrics == alone.metrics | own and (own["judge_recall_1"], own["judge_m2t"]) == (25.0, 0.625)
    assert own.keys() <= {measure.key for measure in MEASURES} and own.keys() <= both.resampled.keys()
    bow = MttOpen(ASKED, Judge(), {BOW: [moved()]}, judge=Bower()).real(seed=0).metrics
    assert (bow["judge_recall_1"], bow["recall_1"]) == (100.0, 0.0)
    faster = Bower()
    faster.fps = 30
    with pytest.raises(SettingError, match="judge: works at 30 fps, but the evaluator at 20"):
        MttOpen(ASKED, Judge(), judge=faster)


def test_prompts_alone_are_no_timelines():
    benchmark = MttOpen(ASKED, Judge())
    assert isinstance(benchmark, Benchmark)
    assert [timeline.duration for timeline in benchmark.timelines("independent")] == [6, 5, 6, 6]
    motions = [walking(1.2), walking(1.2).trimmed(0, 100), walking(1.2), walking(1.2)]
    metrics = benchmark.measured("independent", motions, seed=0).metrics
    assert metrics["shown"] == 50.0 and not {"timelines_shown", "transition", "hand_step"} & set(metrics)


def test_recorded_motions_say_what_real_motion_and_chance_reach():
    benchmark = MttOpen(ASKED, Judge(), {WALK: [walking(1.2)], RAISE: [walking_with_an_arm_raised(), moved()]})
    real = benchmark.real(seed=0).metrics
    assert real["shown"] == pytest.approx(200 / 3) and (real[f"shown/{WALK}"], real[f"shown/{RAISE}"]) == (100.0, 50.0)
    asked = benchmark.measured("stmc", [walking(1.2), walking(1.2)], seed=0).metrics
    assert asked["shown_chance"] == real["shown_chance"] == 25.0  # half of the raises walk, no walk raises, none bows
    with pytest.raises(TimelineError, match="no recordings of MTT's texts"):
        MttOpen(ASKED, Judge()).real(seed=0)


def test_a_text_without_a_check_is_an_error_with_its_name():
    with pytest.raises(TimelineError, match="'swim' is not one of MTT's 60 texts"):
        MttOpen([Timeline((Prompt("swim", 0, 1, ["legs"]),))], Judge())


@pytest.fixture
def texts(tmp_path):
    path = tmp_path / "texts.txt"
    path.write_text("walk forwards # legs\nraise the left arm # left arm\nbow # head # spine\nrun # legs\n")
    return path


def test_timelines_are_drawn_from_the_texts_and_recordings_come_from_prepared_data(texts, tmp_path):
    features = torch.zeros(60, SmplRepresentation.layout.width)
    features[:, SmplRepresentation.layout["rotations"]] = torch.tensor([1.0, 0, 0, 0, 1, 0]).repeat(22)
    clips = (Clip("a", "walk", "normal", "walk", ("legs",), True, False, "train", 0, 60),)
    Cache(20, "smpl", features, clips, {"walk": (("walk", 1.0),)}).write(tmp_path / "data")
    benchmark = mtt_open(Judge(), texts, cache=tmp_path / "data", first=7)
    assert len(benchmark.requested) == 7 and {text: len(each) for text, each in benchmark.recorded.items()} == {WALK: 1}
    assert mtt_open(Judge(), texts).recorded == {}


def test_evaluate_loads_the_judge_that_the_benchmark_names(texts, monkeypatch):
    loaded = []
    monkeypatch.setattr(stmc, "load_evaluator", lambda place, **_: loaded.append(place) or Judge())
    part = {"_target_": "stmc.evaluation.benchmarks.mtt_open", "_partial_": True, "texts": str(texts)}
    config = {"evaluator": "first", "device": "cpu", "trusted": []}
    benchmark = build_benchmark(OmegaConf.create(config | {"benchmark": part | {"judge": "second"}}))
    assert isinstance(benchmark.judge, Judge) and sorted(loaded) == ["first", "second"]
    assert build_benchmark(OmegaConf.create(config | {"benchmark": part | {"judge": None}})).judge is None


def test_a_model_is_asked_for_each_text_alone_and_in_other_words(texts, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(stmc, "load", lambda *_, **__: tiny())
    words = {WALK: "stroll", RAISE: "left arm up", BOW: "bend", "run": "sprint"}
    (tmp_path / "words.json").write_text(json.dumps(words))
    settings = (f"texts={texts}", "samples=3", "steps=2", "batch=5", "seconds=2", f"output={tmp_path / 'out'}")
    run("actions", "actions", *settings, f"paraphrases={tmp_path / 'words.json'}")
    results = json.loads((tmp_path / "out" / "mtt_texts.json").read_text())
    assert {text: row["words"] for text, row in results.items()} == words
    for row in results.values():
        assert 0 <= row["sided"] <= row["shown"] <= 1
    assert "of 4 texts" in capsys.readouterr().out
    (tmp_path / "words.json").write_text("{}")
    with pytest.raises(SettingError, match=r"words\.json: has no sentence for 'walk forwards'"):
        run("actions", "actions", *settings, f"paraphrases={tmp_path / 'words.json'}")
    for content, message in (("[]", "must be an object of text: paraphrase"), ("{", "not JSON")):
        (tmp_path / "words.json").write_text(content)
        with pytest.raises(SettingError, match=message):
            run("actions", "actions", *settings, f"paraphrases={tmp_path / 'words.json'}")
    texts.write_text("swim # legs\n")
    with pytest.raises(SettingError, match="'swim' is not one of MTT's 60 texts"):
        run("actions", "actions", *settings)
