"""A model reads prompts in its own words, and its motions are judged by the test of what was asked for."""

import json
from dataclasses import replace
from importlib.resources import files

import pytest
import torch
from helpers.motions import standing_still, walking
from helpers.scripts import run as in_this_process
from helpers.studio import studio
from helpers.tiny_model import Hashes, tiny

import stmc
from stmc.composing.own_words import in_own_words
from stmc.evaluation.benchmarks.atomic_prompts import read_atomic_prompts
from stmc.evaluation.benchmarks.mtt_checks import MTT_CHECKS
from stmc.evaluation.benchmarks.questions import QUESTIONS
from stmc.evaluation.verification import CHECKS, find_missed
from stmc.motion.body import BodyPart
from stmc.text.vocabulary import Calibration, Content, Sentence, Trial, Vocabulary, build_vocabulary

WALK = Content("walk", frozenset({BodyPart.LEGS}), True)
WAVE = Content("wave-left-hand", frozenset({BodyPart.LEFT_ARM}))
WEIGHTS = {Sentence("walk", WALK): 1.0, Sentence("stroll along", WALK): 1.0, Sentence("wave", WAVE): 1.0}
TEXT = "stroll along # 0 # 1 # legs\nwave # 0.5 # 1 # left arm"


@pytest.fixture(scope="module")
def vocabulary() -> Vocabulary:
    """Two actions, heard through hashes of words."""
    return build_vocabulary(WEIGHTS, Hashes())


@pytest.fixture
def model(vocabulary, monkeypatch) -> stmc.Model:
    monkeypatch.setattr("stmc.text.vocabulary.recogniser.sentence_encoder", lambda own: Hashes())
    return replace(tiny(), vocabulary=vocabulary)


@pytest.mark.parametrize(
    ("confidence", "texts"),
    [(0.5, ["walk", "wave"]), (0, ["walk", "wave"]), (1, ["stroll along", "wave"]), (None, ["stroll along", "wave"])],
)
def test_a_prompt_is_read_as_the_first_sentence_of_its_action_where_that_is_sure(model, confidence, texts):
    [timeline] = in_own_words([stmc.Timeline.parse(TEXT)], model._recognise, confidence)
    assert [prompt.text for prompt in timeline.prompts] == texts
    asked = stmc.Timeline.parse(TEXT).prompts
    assert [(p.start, p.end, p.parts) for p in timeline.prompts] == [(p.start, p.end, p.parts) for p in asked]


def test_unknown_prompts_and_those_that_say_more_stay_as_they_are(vocabulary):
    more = build_vocabulary(WEIGHTS, Hashes(), more={"walk sadly", "walk and wave"})
    for text in ("juggle", "walk sadly", "walk and wave"):
        [recognition] = more.recognise([text], Hashes())
        assert recognition.read_from(0.5) == text


def test_words_that_rarely_work_are_not_read_and_prompts_that_are_proven_are_read_as_they_are(vocabulary):
    def words(**trials: Trial) -> str:
        named = {name.replace("_", " "): trial for name, trial in trials.items()}
        [stroll] = replace(vocabulary, calibration=Calibration(named)).recognise(["stroll along"], Hashes())
        return stroll.read_from(0)

    assert words() == words(walk=Trial("walk", 2, geometry=0.5)) == "walk"
    assert words(walk=Trial("walk", 2, geometry=0.4)) == "stroll along"
    assert words(stroll_along=Trial("walk", 8, geometry=0.75)) == "stroll along"
    assert words(stroll_along=Trial("walk", 8, geometry=0.7)) == "walk"
    assert words(stroll_along=Trial("walk", 7, geometry=1.0)) == "walk", "too few samples to be sure"


def test_a_motion_is_that_of_the_words_that_are_read(model):
    settings = {"steps": 2, "seed": 3}
    [own], [words] = (model.generate(text, **settings) for text in (TEXT, TEXT.replace("stroll along", "walk")))
    [restated] = model.generate(TEXT, restate_from=0.5, **settings)
    assert torch.equal(restated.joints, words.joints) and not torch.equal(restated.joints, own.joints)
    usual = replace(model, sampling=stmc.Sampling(restate_from=0.5))
    assert torch.equal(usual.generate(TEXT, **settings)[0].joints, words.joints)
    assert torch.equal(usual.generate(TEXT, restate_from=1, **settings)[0].joints, own.joints)
    streams = (
        stream.take(20).joints
        for stream in (
            model.stream(TEXT, steps=2, restate_from=0.5),
            model.stream(TEXT.replace("stroll along", "walk"), steps=2),
        )
    )
    assert torch.equal(*streams)


def test_the_studio_s_check_has_the_words_that_the_model_reads(model, tmp_path):
    prompts = [{"text": text, "start": 0, "end": 2, "parts": ["legs"]} for text in ("stroll along", "walk", "juggle")]
    for confidence, expected in ((0.5, ["walk", None, None]), (None, [None, None, None])):
        usual = replace(model, sampling=stmc.Sampling(restate_from=confidence))
        with studio(usual, tmp_path / str(confidence)) as client:
            told = [
                client.post("/api/check", json={"timeline": {"prompts": [prompt]}}).json()["prompts"][0]
                for prompt in prompts
            ]
        assert [each["read_as"] for each in told] == expected


def test_a_stream_reads_what_is_added_in_its_own_words(model):
    taken = []
    for text, confidence in (("stroll along", 0.5), ("walk", 1), ("stroll along", 1)):
        stream = model.stream("wave # 0 # 1 # left arm", steps=2, restate_from=confidence)
        stream.add(stmc.Prompt(text, 0, 2, ["legs"]))
        taken.append(stream.take(30).joints)
    assert torch.equal(taken[0], taken[1]) and not torch.equal(taken[0], taken[2])


@pytest.mark.parametrize(
    "text",
    [
        "an old man takes a seat and gets up again",
        "a man walks forward, turns around and walks back",
        "jump up after a squat",
        "wave while you stroll along",
    ],
)
def test_no_action_of_several_is_lost(text):
    [recognition] = stmc.load().recognise([text])
    assert recognition.known and recognition.read_from(0) == text


def test_the_bundled_models_read_other_people_s_words_as_their_own():
    for model in (stmc.load(), stmc.load("mdm_smpl_wide_fast")):
        found = model.recognise(
            ["a boxer throws a left jab", "walk forwards", "walk sadly", "walk while waving", "swim"]
        )
        assert [each.read_from(model.own_sampling.restate_from) for each in found] == [
            "punch with the left hand",
            *(each.text for each in found[1:]),
        ]
    assert stmc.load("flow_mdm_wide").own_sampling.restate_from == 1


def test_every_text_of_mtt_that_the_model_shows_is_read_as_it_is():
    model = stmc.load()
    trials = model.vocabulary.calibration.trials
    shown = [text for text in MTT_CHECKS if (trials[text].rate or 0) >= 0.75]
    assert len(shown) >= 54
    assert [each.read_from(0) for each in model.recognise(shown)] == shown


@pytest.mark.parametrize("name", ["mdm_smpl_wide", "mdm_smpl_wide_fast"])
def test_texts_of_the_open_benchmark_are_read_as_they_are(name):
    model = stmc.load(name)
    texts = [prompt.text for prompt in read_atomic_prompts(files("stmc") / "assets/open_mtt/prompts.json")]
    confidence = model.own_sampling.restate_from
    assert {each.text: each.read_from(confidence) for each in model.recognise(texts)} == {text: text for text in texts}


def test_a_person_who_stands_does_not_walk_and_one_who_walks_does():
    model, timeline = stmc.load(), stmc.Timeline.parse("a man strolls ahead # 1 # 4")
    [missed] = find_missed(model, timeline, standing_still(100))
    assert (missed.text, missed.action) == ("a man strolls ahead", "walk")
    assert missed.advice == (
        "'a man strolls ahead' does not show from 1 to 4 s by the geometric test of walk; try another seed"
    )
    assert find_missed(model, timeline, walking(5, turn=0.0)) == []


@pytest.mark.parametrize("text", ["swim # 0 # 4", "dance salsa # 0 # 4", "walk # 0 # 0.9"])
def test_what_has_no_test_is_unknown_or_too_short_is_not_judged(text):
    assert find_missed(stmc.load(), stmc.Timeline.parse(text), standing_still(80)) == []


def test_without_a_classifier_nothing_is_judged(vocabulary):
    model, timeline = tiny(), stmc.Timeline.parse("walk # 0 # 2")
    assert find_missed(model, timeline, standing_still(40)) == []
    nearest = replace(vocabulary, classifier=None)
    assert find_missed(replace(model, vocabulary=nearest), timeline, standing_still(40)) == []


def test_mtt_s_strict_tests_come_before_the_questions_and_every_action_with_one_is_judged():
    actions = {action for check in MTT_CHECKS.values() for action in check.actions}
    assert set(CHECKS) == actions | QUESTIONS.keys()
    assert CHECKS["hop"] == [QUESTIONS["hop"]] and CHECKS["run"] != [QUESTIONS["run"]]


def test_sampling_says_what_is_read_and_what_is_not_seen(tmp_path, monkeypatch, capsys):
    still = standing_still(40)
    monkeypatch.setattr(stmc.Model, "sample", lambda self, request, *_: [still for _ in request.timelines])
    (tmp_path / "stroll.txt").write_text("a man strolls ahead # 0 # 2")
    made = [f"timeline={tmp_path / 'stroll.txt'}", f"output={tmp_path}", "formats=[html]"]
    in_this_process("sample", "sample", *made)
    said = capsys.readouterr().out
    assert "'a man strolls ahead' is read as 'walk'" in said and "does not show from 0 to 2 s" in said
    [page] = tmp_path.glob("*.html")
    assert 'class="bar unknown"' in page.read_text("utf-8")
    in_this_process("sample", "sample", *made, "json=true", "seed=1")
    line = json.loads(capsys.readouterr().out)
    assert line["missed"] == ["a man strolls ahead"]
    in_this_process("sample", "sample", *made, "restate_from=1", "seed=2")
    assert "is read as" not in capsys.readouterr().out
