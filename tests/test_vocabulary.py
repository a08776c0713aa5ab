"""What a model was trained to hear: whether it knows a prompt, body parts for prompts, and the file of both."""

import json
import math
import warnings
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from conftest import DATA
from helpers.scripts import ROOT
from helpers.tiny_model import Hashes, tiny
from safetensors import safe_open
from safetensors.torch import save_file

import stmc
from stmc.data.sources.contents import CONTENTS
from stmc.motion.body import BodyPart
from stmc.run import VOCABULARY, RunError, bundled
from stmc.text.vocabulary import (
    Content,
    Sentence,
    Vocabulary,
    VocabularyError,
    build_vocabulary,
    building,
    read_vocabulary,
    recogniser,
    sentence_encoder,
    suggest,
    write_vocabulary,
)
from stmc.text.vocabulary import vocabulary as vocabulary_module
from stmc.text.vocabulary.classifier import Classifier, fit_classifier, log_odds
from stmc.timeline import UnknownPromptWarning

PROMPTS = json.loads((ROOT / "tests/helpers/prompts.json").read_text("utf-8"))
WALK, WAVE = Content("walk", frozenset({BodyPart.LEGS}), True), Content("wave", frozenset({BodyPart.RIGHT_ARM}))
WEIGHTS = {Sentence("walk", WALK): 3.0, Sentence("stroll along", WALK): 2.0, Sentence("wave", WAVE): 1.0}


@pytest.fixture(scope="module")
def small() -> Vocabulary:
    """Two contents, heard through hashes of words."""
    return build_vocabulary(WEIGHTS, Hashes())


def flagged(vocabulary: Vocabulary, texts: list[str]) -> float:
    """The share of the texts that are not known."""
    found = vocabulary.recognise(texts, sentence_encoder())
    return sum(not each.known for each in found) / len(texts)


def test_the_bundled_model_knows_what_it_was_trained_with_and_nothing_else():
    model = stmc.load()
    assert len(model.vocabulary.contents) == 119
    assert all(
        each.known
        for each in model.recognise(
            ["walk slowly", "lift your left arm", "a woman jogs along", "bow", "sit down", "jump", "wave", "wave hello"]
        )
    )
    asked = ["swim", "play the drums", "climb a ladder", "ride a bicycle", "lie down", "gehe vorwärts", "asdf"]
    assert [each.text for each in model.recognise(asked) if each.known] == []


def test_a_prompt_that_is_not_known_warns_with_the_nearest_that_are_and_is_made_all_the_same():
    model = stmc.load()
    with pytest.warns(
        UnknownPromptWarning, match="hardly knows 'swim' and may do something else; it knows nothing near$"
    ) as told:
        [motion] = model.generate("walk # 0 # 0.5\nswim # 0.5 # 1\nswim # 1 # 1.2", steps=1)
    assert motion.frames == 24 and len(told) == 1 and told[0].filename == __file__
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        model.generate("walk # 0 # 0.5", steps=1)
        replace(model, vocabulary=None).generate("swim # 0 # 0.5", steps=1)


def test_only_what_is_near_is_named(bundled_recognitions):
    drums, german, walk = bundled_recognitions
    assert [sentence.text for sentence in drums.near] == ["play the guitar"] and len(drums.nearest) == 3
    assert drums.advice.endswith("the nearest it knows: 'play the guitar'")
    assert not german.near and german.advice.endswith("it knows nothing near")
    assert walk.near == walk.nearest


@pytest.fixture
def bundled_recognitions() -> list:
    return stmc.load().recognise(["play the drums", "gehe vorwärts", "walk"])


def test_a_text_is_compared_once_and_no_encoder_is_made_for_none(small, monkeypatch):
    made = []
    monkeypatch.setattr(recogniser, "sentence_encoder", lambda own: made.append(Hashes()) or made[-1])
    model, timeline = replace(tiny(longest=60), vocabulary=small), stmc.Timeline.parse("walk # 0 # 4\njuggle # 4 # 5")
    assert model.recognise([]) == [] and not made
    model.plans([timeline])
    assert [each.text for each in model.doubtful([timeline, timeline])] == ["juggle"]
    for _ in range(2):
        with pytest.warns(UnknownPromptWarning, match="hardly knows 'juggle'"):
            model.generate(timeline, steps=1)
    assert [each.encoded for each in made] == [["walk", "juggle"]]


def test_a_prompt_too_long_for_one_crop_is_asked_for_once_where_it_happens_once():
    model = replace(tiny(longest=60), vocabulary=build_vocabulary(WEIGHTS, sentence_encoder()))
    timelines = [stmc.Timeline.parse("walk # 0 # 5 # legs\nwave # 0 # 5 # right arm")]
    [once] = model.plans(timelines)
    [run] = model._run(timelines, [0], model.settings(), iter).plans()
    [asked] = replace(model, vocabulary=None).plans(timelines)
    assert once.crops == run.crops
    for plan, waves in ((once, 1), (asked, 2)):
        texts = [crop.text for crop in plan.crops]
        assert (texts.count("walk"), texts.count("wave")) == (2, waves)


def test_sentences_are_kept_by_weight_until_they_tell_nothing_new(small, monkeypatch):
    assert [each.text for each in small.known] == ["walk", "wave", "stroll along"]  # the first of each, then by weight
    near = WEIGHTS | {Sentence("walk walk", WALK): 0.5}  # its mean word is that of "walk"
    assert build_vocabulary(near, Hashes()).known == small.known
    other = WEIGHTS | {Sentence("walk walk", WAVE): 0.5}  # near to a sentence of another content alone
    assert len(build_vocabulary(other, Hashes()).known) == 4
    monkeypatch.setattr(building, "KEPT", 2)
    assert build_vocabulary(WEIGHTS, Hashes()).known == small.known[:2]  # one of each content
    with pytest.raises(ValueError, match="at least one sentence"):
        build_vocabulary({Sentence(" ", WALK): 1.0}, Hashes())


def test_everyday_actions_that_the_model_knows_are_not_others(small):
    everyday = {each.text for each in building.everyday_actions()}
    dropped = everyday - {each.text for each in small.others}
    assert "walk" in dropped and not dropped & {"juggle", "swim", "raise the arm"}


def test_a_prompt_is_as_known_as_it_is_nearer_to_the_known_than_to_the_others(small):
    walk, other = small.recognise(["walk", "juggle"], Hashes())
    assert walk.known and walk.score > 1 and walk.nearest[0].text == "walk"
    assert not other.known and other.score < -0.5  # an everyday action word for word


def test_a_content_is_told_by_what_most_say_of_it_and_not_by_the_odd_word_out(monkeypatch):
    walks = {Sentence(f"walk {where}", WALK): 2.0 for where in ("to the door", "in the park", "home")}
    monkeypatch.setattr(vocabulary_module, "EXAMPLES", 3)
    vocabulary = build_vocabulary(walks | {Sentence("adios", WALK): 1.0}, Hashes())
    [examples] = vocabulary.examples.values()
    assert [each.text for each in examples] == ["walk home", "walk in the park", "walk to the door"]
    assert vocabulary.recognise(["adios"], Hashes())[0].nearest == examples[:1]


def test_contents_without_names_are_known_by_their_sentences():
    vocabulary = build_vocabulary({Sentence("a man walks", Content()): 1.0}, Hashes())
    assert vocabulary.contents == () and "1 sentences, such as 'a man walks'" in repr(vocabulary)
    assert vocabulary.recognise(["a man walks"], Hashes())[0].nearest[0].text == "a man walks"


def test_the_repr_fits_a_screen():
    lines = repr(stmc.load().vocabulary).splitlines()
    assert len(lines) < 30 and max(map(len, lines)) <= 120 and "legs: " in repr(lines)


def test_a_file_gives_back_what_was_written(small, tmp_path):
    path = tmp_path / VOCABULARY
    write_vocabulary(small, path)
    read = read_vocabulary(path)
    assert (read.known, read.others, read.threshold) == (small.known, small.others, small.threshold)
    assert torch.cosine_similarity(read.embeddings.float(), small.embeddings.float()).min() > 0.998  # of eight bits
    assert torch.equal(read.classifier.weights, small.classifier.weights)
    again = tmp_path / "again.safetensors"
    write_vocabulary(read, again)
    assert again.read_bytes() == path.read_bytes()


def test_a_file_in_half_precision_is_read_too(small, tmp_path):
    write_vocabulary(small, tmp_path / VOCABULARY)
    with safe_open(tmp_path / VOCABULARY, "pt") as file:
        table = file.metadata()["vocabulary"]
    damaged(tmp_path / VOCABULARY, table, small.embeddings)
    assert torch.allclose(read_vocabulary(tmp_path / VOCABULARY).embeddings, small.embeddings, atol=2e-3)


def damaged(path: Path, table: object, embeddings: torch.Tensor) -> None:
    save_file({"embeddings": embeddings}, path, {"vocabulary": table if isinstance(table, str) else json.dumps(table)})


CHANGES = {
    "not JSON": lambda table: "{",
    "must be an object of": lambda table: [],
    "contents: must be a list": lambda table: table | {"contents": "many"},
    "the index of a content": lambda table: table | {"known": [["walk", 99]]},
    "printable": lambda table: table | {"known": [["walk\u0007", 0]]},
    "must have body parts": lambda table: table | {"contents": [["walk", ["tail"], True]] * 99},
    "must be rows of 2": lambda table: table | {"others": [["walk"]]},
    "threshold": lambda table: table | {"threshold": "low"},
    "embeddings of": lambda table: table | {"known": table["known"][:1]},
    "duplicated": lambda table: '{"known": 1, "known": 2}',
}


@pytest.mark.parametrize("message", CHANGES)
def test_a_file_that_is_none_is_refused_in_a_line(message, small, tmp_path):
    path = tmp_path / VOCABULARY
    write_vocabulary(small, path)
    with safe_open(path, "pt") as file:
        table = json.loads(file.metadata()["vocabulary"])
    damaged(path, CHANGES[message](table), small.embeddings)
    with pytest.raises(VocabularyError, match=message):
        read_vocabulary(path)


@pytest.mark.parametrize("change", [torch.Tensor.float, lambda rows: rows * 3, lambda rows: rows * float("nan")])
def test_embeddings_that_cannot_be_meant_are_refused(change, small, tmp_path):
    write_vocabulary(replace(small, embeddings=small.embeddings), tmp_path / VOCABULARY)
    with safe_open(tmp_path / VOCABULARY, "pt") as file:
        table = file.metadata()["vocabulary"]
    damaged(tmp_path / VOCABULARY, table, change(small.embeddings))
    with pytest.raises(VocabularyError, match="length 1, in eight bits"):
        read_vocabulary(tmp_path / VOCABULARY)


@pytest.mark.parametrize("change", [lambda rows: rows[1:], torch.Tensor.float, lambda rows: rows / 0])
def test_a_classifier_of_other_actions_or_without_sense_is_refused(change, small, tmp_path):
    write_vocabulary(small, tmp_path / VOCABULARY)
    with safe_open(tmp_path / VOCABULARY, "pt") as file:
        table, rows = file.metadata()["vocabulary"], file.get_tensor("embeddings").clone()
    numbers = {"embeddings": rows, "classifier": change(small.classifier.weights)}
    save_file(numbers, tmp_path / VOCABULARY, {"vocabulary": table})
    with pytest.raises(VocabularyError, match="the classifier must be 4 by 385 finite numbers in half precision"):
        read_vocabulary(tmp_path / VOCABULARY)
    with pytest.raises(ValueError, match="a classifier of 3 classes for 2 actions, more and none"):
        replace(small, classifier=Classifier(small.classifier.weights[1:]))


def test_log_odds_are_those_of_the_actions_asked_for_against_all_others():
    logits, every = torch.tensor([0.0, 0.0, -torch.inf, 0.0]), torch.tensor([True, True])
    assert log_odds(logits, every) == pytest.approx(math.log(2))
    assert log_odds(logits, torch.tensor([True, False])) == pytest.approx(-math.log(2))
    assert log_odds(logits, ~every) == -10 and log_odds(torch.tensor([90.0, 0.0, 0.0, 0.0]), every) == 10
    assert log_odds(torch.tensor([0.0, 0.0, 0.0, 0.0]), every) == pytest.approx(math.log(3)), "of texts that say more"


def test_the_classifier_separates_what_it_was_fitted_to_and_knows_no_side_of_an_even_text():
    rows, classes = torch.eye(4)[[0, 0, 1, 2, 3]], torch.tensor([0, 0, 1, 2, 3])
    logits = fit_classifier(rows, classes, 2).logits(rows)
    assert logits.argmax(dim=1).tolist() == classes.tolist() and logits.softmax(dim=1).amax(dim=1).min() > 0.9
    even = fit_classifier(torch.eye(4)[[1, 0, 2]], torch.tensor([0, 1, 3]), 2).logits(torch.eye(4)[:2].mean(0)[None])
    assert float(even[0, 0]) == pytest.approx(float(even[0, 1]), abs=0.05)


def test_words_are_the_first_in_plain_words_and_what_says_more_is_not_put_in_them():
    weights = {Sentence("walk sadly", WALK): 9.0, **WEIGHTS}
    vocabulary = build_vocabulary(weights, Hashes(), more={"walk sadly", "walk and wave"})
    stroll, sad, both, juggle = vocabulary.recognise(
        ["stroll along", "walk sadly", "walk and wave", "juggle"], Hashes()
    )
    assert (stroll.words, sad.words) == ("walk", "")
    assert stroll.confidence > 0.6 > max(sad.confidence, both.confidence, juggle.confidence)


def test_an_action_is_told_by_all_sentences_not_by_the_nearest_that_was_kept(small):
    """Of sentences that are not kept, the classifier has learned too."""
    shared = {Sentence("hello walk home", WALK): 1.0} | {
        Sentence(f"hello {word}", WAVE): 1.0 for word in ("friend", "there", "you", "all", "sun")
    }
    vocabulary = build_vocabulary(WEIGHTS | shared, Hashes())
    [told] = vocabulary.recognise(["hello hello you walk"], Hashes())
    [nearest] = replace(vocabulary, classifier=None).recognise(["hello hello you walk"], Hashes())
    assert told.action == "wave" and told.nearest[0].content == WAVE
    assert nearest.score != told.score


def test_data_without_actions_have_no_classifier():
    named = build_vocabulary(WEIGHTS, Hashes())
    nameless = build_vocabulary({Sentence(each.text, Content()): 1.0 for each in WEIGHTS}, Hashes())
    assert nameless.classifier is None and len(named.classifier.weights) == 4
    assert nameless.threshold < named.threshold


def test_a_vocabulary_travels_with_its_model_and_a_damaged_one_is_named(small, tmp_path):
    run = stmc.save(replace(tiny(), vocabulary=small), tmp_path / "run", card="")
    assert stmc.load(run).vocabulary.known == small.known
    content = (run / VOCABULARY).read_bytes()
    (run / VOCABULARY).write_bytes(content[:-1] + bytes([content[-1] ^ 1]))
    with pytest.raises(RunError, match=f"{VOCABULARY} is damaged"):
        stmc.load(run)
    (run / VOCABULARY).unlink()
    with pytest.raises(RunError, match=f"{VOCABULARY} is damaged"):
        stmc.load(run)


def test_a_run_without_a_vocabulary_loads_and_one_that_is_not_its_own_is_not_read(small, tmp_path):
    run = stmc.save(replace(tiny(), vocabulary=small), tmp_path / "run", card="")
    stmc.save(tiny(), run, card="")
    assert not (run / VOCABULARY).exists() and stmc.load(run).vocabulary is None
    write_vocabulary(small, run / VOCABULARY)
    assert stmc.load(run).vocabulary is None
    assert stmc.load(run).recognise(["walk"]) == []


def test_the_bundled_file_is_small():
    assert (bundled() / VOCABULARY).stat().st_size < 2e6


def test_the_page_marks_prompts_that_are_not_known(small):
    timeline = stmc.Timeline.parse("walk # 0 # 1\njuggle # 0 # 1 # head")
    [motion] = tiny().generate(timeline, steps=1)
    page = stmc.render_html(motion, timeline, doubtful=replace_known(small, ["walk", "juggle"]))
    assert page.count('class="bar unknown"') == 1 and "it knows nothing near" in page
    assert 'class="bar unknown"' not in stmc.render_html(motion, timeline)


def replace_known(vocabulary: Vocabulary, texts: list[str]) -> list:
    return [each for each in vocabulary.recognise(texts, Hashes()) if not each.known]


@pytest.mark.parametrize(
    ("text", "parts"),
    [
        ("walk to the left", {"legs"}),
        ("raise the right arm", {"right arm"}),
        ("wave with both hands", {"left arm", "right arm"}),
        ("point with the left hand to the right", {"left arm"}),
        ("nod", {"head"}),
        ("swim", set(BodyPart)),
        ("qwxz vvv kkk", set(BodyPart)),
    ],
)
def test_body_parts_are_suggested_by_what_is_near_and_by_words_for_sides(text, parts):
    assert stmc.suggest_parts(text).parts == parts


@pytest.mark.parametrize(
    ("text", "parts"),
    [
        ("kick", {"legs"}),
        ("kick with the right leg", {"legs"}),
        ("wave with the left hand", {"left arm"}),
        ("clap", {"left arm", "right arm"}),
        ("qwxz vvv kkk", set()),
    ],
)
def test_an_action_needs_its_legs_or_else_one_of_its_parts_and_nothing_is_known_of_words_without_sense(text, parts):
    assert stmc.suggest_parts(text).needs == parts


def test_listed_parts_stay_and_what_is_for_the_whole_body_goes_on_yielding():
    timeline = stmc.Timeline.parse("walk # 0 # 2 # head\nswim # 2 # 4\nkick with the left foot # 4 # 6")
    assert [prompt.parts for prompt in stmc.with_suggested_parts(timeline).prompts] == [{"head"}, set(), {"legs"}]


def exact(vocabulary: Vocabulary, rows: list[tuple[str, set[str]]]) -> float:
    found = suggest([text for text, _ in rows], vocabulary, sentence_encoder())
    return sum(each.parts == parts for each, (_, parts) in zip(found, rows, strict=True)) / len(rows)


@pytest.mark.slow
def test_body_parts_of_our_prompts_are_suggested_far_better_than_the_whole_body():
    rows = [(text, set(parts)) for text, parts in PROMPTS["parts"]]
    assert exact(stmc.load().vocabulary, rows[1::2]) > 0.8  # the half that nothing was chosen by


@pytest.mark.slow
@pytest.mark.skipif(not (DATA / "mtt/texts.txt").exists(), reason="no MTT at STMC_DATA")
def test_body_parts_of_mtt_s_prompts_are_suggested_far_better_than_the_whole_body():
    lines = [line.split(" # ") for line in (DATA / "mtt/texts.txt").read_text("utf-8").splitlines()]
    rows = [(text, set(map(BodyPart.parse, parts))) for text, *parts in lines]
    assert len(rows) == 60 and exact(stmc.load().vocabulary, rows) > 0.65


@pytest.mark.slow
def test_prompts_outside_warn_and_those_inside_do_not():
    """Of a model that was trained with every content's plain sentences; the threshold was chosen on half of these."""
    weights = {Sentence(text, Content(name, each.parts, each.cyclic)): 1.0
               for name, each in CONTENTS.items() for text in each.sentences}  # fmt: skip
    vocabulary = build_vocabulary(weights, sentence_encoder())
    assert flagged(vocabulary, PROMPTS["outside"]) >= 0.9 and flagged(vocabulary, PROMPTS["unusual"]) >= 0.85
    assert flagged(vocabulary, [text for _, text in PROMPTS["inside"]]) < 0.05
    assert flagged(vocabulary, [text for name in CONTENTS for text in CONTENTS[name].unseen]) < 0.08
