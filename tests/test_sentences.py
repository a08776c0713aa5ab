"""Sentences for every content and style: what users write is among them; the mirror swaps sides and nothing else."""

import json
import re

import pytest
import torch
from helpers.scripts import ROOT
from hypothesis import given
from hypothesis import strategies as st

from stmc.data.sources.contents import (
    ALWAYS_STYLED,
    CONTENTS,
    FORWARD_WALKS,
    STYLES,
    content,
    describe,
    mirror_content,
    mirrored,
)
from stmc.data.sources.joined import PER_PAIR, join, joined_sentences
from stmc.evaluation.benchmarks.mtt_checks import MTT_CHECKS
from stmc.evaluation.benchmarks.novelty import nearest_cosines
from stmc.motion.body import BodyPart
from stmc.text.vocabulary import sentence_encoder
from stmc.text.vocabulary.sentences import embed_sentences

LABELS = (
    "walk", "walk-back", "walk-left", "walk-right", "walk-turn-left", "walk-turn-right", "run", "dash",
    "raise-up-both-hands", "raise-up-left-hand", "raise-up-right-hand", "wave-both-hands", "wave-left-hand",
    "wave-right-hand", "bow", "bye", "byebye", "guide", "punch", "kick", "slash", "call", "respond", "dance-short",
)  # fmt: skip
MOODS = (
    "normal", "happy", "sad", "angry", "proud", "not-confident", "masculinity", "feminine", "childish", "old", "tired",
    "active", "musical", "giant", "chimpira", "elderly", "exhausted", "masculine", "youthful",
)  # fmt: skip
FREQUENT = LABELS[:14]
SIDES = re.compile(r"\b(left|right|clockwise|counterclockwise)(?:wards?)?\b")


def test_every_label_of_the_data_set_has_sentences():
    assert set(CONTENTS) >= set(LABELS)
    assert set(STYLES) == set(MOODS)
    for name, record in CONTENTS.items():
        assert record.name == name
        assert len(set(record.sentences)) == len(record.sentences) >= (8 if name in FREQUENT else 4)


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("walk", "walk forwards"),
        ("walk", "a person walks forward"),
        ("walk-back", "walk backwards"),
        ("run", "run"),
        ("run", "run forwards"),
        ("run", "jogs forwards"),
        ("walk-turn-left", "turn left"),
        ("walk-turn-right", "turn right"),
        ("walk-turn-left", "walk and turn to the left"),
        ("quarter-circle-right", "walk in a quarter circle to the right"),
        ("raise-up-right-hand", "raise the right arm"),
        ("raise-up-right-hand", "raise the right hand"),
        ("raise-up-left-hand", "raise the left arm"),
        ("raise-up-both-hands", "raise both arms in the air"),
        ("raise-up-both-hands", "raise both hands"),
        ("wave-right-hand", "wave with the right hand"),
        ("wave-left-hand", "wave with the left hand"),
        ("wave-both-hands", "wave with both hands"),
        ("bow", "bow"),
    ],
)
def test_what_users_and_the_benchmark_write_is_a_sentence(name, text):
    assert text in content(name).sentences


@pytest.mark.parametrize(
    ("name", "text", "parts"),
    [
        ("walk-circle-right", "walk in a circle clockwise", "legs"),
        ("walk-circle-left", "walk in a circle counterclockwise", "legs"),
        ("quarter-circle-left", "walk in a quarter circle to the left", "legs"),
        ("half-turn-left-on-left-foot", "turn 180 degrees to the left on the left foot", "legs"),
        ("half-turn-left-on-right-foot", "turn 180 degrees to the left on the right foot", "legs"),
        ("walk-slow", "slowly walk forwards", "legs"),
        ("walk-back-slow", "slowly walk backwards", "legs"),
        ("walk-fast", "quickly walk forwards", "legs"),
        ("walk-back-fast", "quickly walk backwards", "legs"),
        ("jog-back", "jogs backwards", "legs"),
        ("low-kick-right", "low kick with the right foot", "legs"),
        ("high-kick-left", "high kick with the left foot", "legs"),
        ("applause", "applause", "left arm # right arm"),
        ("guitar", "play the guitar", "left arm # right arm"),
        ("violin", "play the violin", "left arm # right arm"),
        ("phone-left", "talk on phone with left hand", "head # left arm"),
        ("point-right", "point with his right hand", "right arm"),
        ("drink-left", "drink with the left arm", "head # left arm"),
        ("eat-right", "eat something with the right arm", "head # right arm"),
        ("look-right", "look right", "head"),
        ("dodge", "dodge a hit to his head", "head # spine"),
        ("throw-left", "throw something with left hand", "left arm"),
        ("pick-up-right", "pick something with the right hand", "legs # right arm # spine"),
        ("punch-left", "punch with the left hand", "left arm"),
        ("jump-back", "jump backward", "legs # spine"),
        ("hop-left", "hop to the left", "legs # spine"),
        ("golf", "play golf", "head # left arm # legs # right arm # spine"),
        ("touch-head-right", "touches back of head with right hand", "head # right arm"),
        ("wipe-right", "wipe with the right hand", "right arm"),
        ("idle", "stand", "legs"),
    ],
)
def test_texts_of_the_benchmark_belong_to_the_actions_edited_for_them(name, text, parts):
    assert text in content(name).sentences[:2]
    assert content(name).parts == {BodyPart(part) for part in parts.split(" # ")}


def test_a_sentence_belongs_to_one_content_except_for_the_three_forward_walks():
    owner = {}
    for name, record in CONTENTS.items():
        for text in record.sentences:
            assert owner.setdefault(text, name) in (name, "walk"), f"{text!r} is said of {owner[text]} and of {name}"


def test_walking_to_the_left_of_the_room_is_plain_walking():
    walks = {content(name).sentences for name in ("walk", "walk-left", "walk-right")}
    assert len(walks) == 1
    assert not any(SIDES.search(text) for text in walks.pop())


def test_sentences_name_a_side_exactly_where_the_label_does_and_never_the_other():
    for name, record in CONTENTS.items():
        sides = set(re.findall(r"-(left|right)", name.removeprefix("walk-left").removeprefix("walk-right")))
        for text in (*record.sentences, *record.unseen):
            named = {{"counterclockwise": "left", "clockwise": "right"}.get(word, word) for word in SIDES.findall(text)}
            assert named == sides, f"{name}: {text}"


def test_parts_are_those_that_the_benchmark_gives_to_the_same_text():
    assert content("walk").parts == content("walk-turn-left").parts == {BodyPart.LEGS}
    assert content("raise-up-left-hand").parts == content("wave-left-hand").parts == {BodyPart.LEFT_ARM}
    assert content("raise-up-right-hand").parts == content("wave-right-hand").parts == {BodyPart.RIGHT_ARM}
    assert content("raise-up-both-hands").parts == {BodyPart.LEFT_ARM, BodyPart.RIGHT_ARM}
    assert content("bow").parts == {BodyPart.HEAD, BodyPart.SPINE}


def test_only_contents_without_a_decisive_middle_are_cyclic():
    cyclic = {name for name, record in CONTENTS.items() if record.cyclic and name in LABELS}
    walks = {"walk", "walk-left", "walk-right", "walk-back", "run", "dash"}
    assert cyclic == walks | {"wave-left-hand", "wave-right-hand", "wave-both-hands", "dance-short"}


@pytest.mark.parametrize("style", MOODS)
def test_probabilities_sum_to_one_and_no_sentence_is_listed_twice(style):
    for name in LABELS:
        rows = describe(name, style)
        assert sum(weight for _, weight in rows) == pytest.approx(1.0)
        assert len(dict(rows)) == len(rows)
        assert min(weight for _, weight in rows) > 0


def test_half_of_the_draws_of_a_styled_clip_name_the_style():
    plain = set(content("walk").sentences)
    rows = dict(describe("walk", "happy"))
    assert sum(weight for text, weight in rows.items() if text in plain) == pytest.approx(0.5)
    assert "walk forwards happily" in rows


def test_a_normal_clip_has_plain_sentences_only():
    assert {text for text, _ in describe("run", "normal")} == set(content("run").sentences)


def test_low_raises_are_never_called_plain_raises():
    for name, style in ALWAYS_STYLED:
        assert not set(content(name).sentences) & {text for text, _ in describe(name, style)}


@pytest.mark.parametrize(
    ("text", "other"),
    [
        ("raise the left arm", "raise the right arm"),
        ("Turn LEFT, Right foot first", "Turn RIGHT, Left foot first"),
        ("walk clockwise", "walk counterclockwise"),
        ("walk anticlockwise", "walk clockwise"),
        ("walk Counter-clockwise", "walk Clockwise"),
        ("stand upright, brightly, in cleft leftovers", "stand upright, brightly, in cleft leftovers"),
        ("step leftwards and rightward", "step rightwards and leftward"),
        ("a left-handed wave", "a right-handed wave"),
        ("raise-up-left-hand", "raise-up-right-hand"),
        ("right_arm", "left_arm"),
        ("walk forwards", "walk forwards"),
    ],
)
def test_the_mirror_swaps_whole_words_and_keeps_case(text, other):
    assert mirrored(text) == other


@given(st.lists(st.sampled_from(["left", "Right", "LEFT", "clockwise", "Counterclockwise", "walk", "upright", "-"])))
def test_mirroring_twice_changes_nothing(words):
    text = " ".join(words)
    assert mirrored(mirrored(text)) == text


@given(st.text())
def test_any_text_can_be_mirrored(text):
    assert isinstance(mirrored(text), str)


@pytest.mark.parametrize("style", MOODS)
def test_a_mirrored_clip_is_described_by_the_mirrored_sentences(style):
    for name in LABELS:
        expected = {(mirrored(text), weight) for text, weight in describe(name, style)}
        assert set(describe(mirror_content(name), style)) == expected


def test_sides_change_places_and_what_has_no_side_stays():
    assert mirror_content("wave-left-hand") == "wave-right-hand"
    assert mirror_content("walk-turn-right") == "walk-turn-left"
    assert mirror_content("raise-up-both-hands") == "raise-up-both-hands"


def test_unknown_labels_are_refused_with_the_choices():
    with pytest.raises(ValueError, match=r"unknown content 'fly'.*walk-back"):
        describe("fly", "happy")
    with pytest.raises(ValueError, match=r"unknown style 'purple'.*chimpira"):
        describe("walk", "purple")
    with pytest.raises(ValueError, match="unknown content 'float-left'"):
        mirror_content("float-left")


def test_no_phrase_of_a_style_contains_the_name_of_a_side():
    assert not [phrase for phrases in STYLES.values() for phrase in phrases if SIDES.search(phrase)]


TOO_NEAR = 0.895
"""Cosine below 0.9 by more than another machine's rounding."""


@pytest.mark.slow
def test_kept_back_sentences_are_no_near_duplicates_of_the_content_s_own():
    contents = [each for name, each in CONTENTS.items() if name not in FORWARD_WALKS[1:] and each.unseen]
    texts = sorted({text for each in contents for text in (*each.sentences, *each.unseen)}, key=len)
    encoder, batches = sentence_encoder(), [texts[first : first + 256] for first in range(0, len(texts), 256)]
    rows = dict(zip(texts, torch.cat([embed_sentences(batch, encoder) for batch in batches]), strict=True))
    near = {}
    for each in contents:
        unseen, own = (torch.stack([rows[text] for text in said]) for said in (each.unseen, each.sentences))
        near |= dict(zip(each.unseen, (unseen @ own.T).amax(dim=1).tolist(), strict=True))
    assert not {text: score for text, score in near.items() if score >= TOO_NEAR}
    assert sorted(near.values())[len(near) // 2] < 0.85


UNTOLD = frozenset(
    ["a", "an", "the", "his", "her", "their", "your", "is", "person", "someone", "man", "woman", "he", "she"]
)


def words(text: str) -> tuple[str, ...]:
    """The words of a text that tell something, in one order."""
    return tuple(sorted(set(re.findall(r"[a-z0-9']+", text.lower())) - UNTOLD))


@pytest.fixture(params=["mtt_paraphrases.json", "mtt_paraphrases_second.json", "mtt_paraphrases_third.json"])
def paraphrases(request) -> dict[str, str]:
    """One for each text of MTT, written by somebody who saw those texts alone."""
    return json.loads((ROOT / "tests/helpers" / request.param).read_text("utf-8"))


def test_every_text_of_mtt_has_a_paraphrase_that_is_no_training_sentence(paraphrases):
    said = {words(text) for each in CONTENTS.values() for text in each.sentences if text not in MTT_CHECKS}
    assert paraphrases.keys() == MTT_CHECKS.keys()
    assert not [text for text in paraphrases.values() if words(text) in said]


@pytest.mark.slow
def test_paraphrases_of_mtt_are_no_near_duplicates_of_training_sentences(paraphrases):
    training = {text for each in CONTENTS.values() for text in each.sentences} - MTT_CHECKS.keys()
    texts = list(paraphrases.values())
    near = dict(zip(texts, nearest_cosines(texts, sorted(training, key=len), sentence_encoder()).tolist(), strict=True))
    assert not {text: score for text, score in near.items() if score >= TOO_NEAR}


def test_prompts_that_the_vocabulary_is_tested_with_are_no_training_sentences_not_even_in_another_order():
    said = {words(text) for each in CONTENTS.values() for text in each.sentences}
    prompts = json.loads((ROOT / "tests/helpers/prompts.json").read_text("utf-8"))
    assert not [text for _, text in prompts["inside"] if words(text) in said]
    assert not [text for text in (*prompts["outside"], *prompts["unusual"]) if words(text) in said]
    assert all(name in CONTENTS for name, _ in prompts["inside"])


def test_every_content_has_a_plain_name_and_a_topic():
    titles = [each.title for name, each in CONTENTS.items() if name not in FORWARD_WALKS[1:]]
    assert len(set(titles)) == len(titles)
    topics = [
        "locomotion",
        "turns",
        "jumps",
        "arms",
        "everyday",
        "exercise",
        "sport",
        "fighting",
        "dance",
        "music",
        "posture",
    ]
    assert {each.topic for each in CONTENTS.values()} == set(topics)
    assert content("wave-right-hand").title == "wave with the right hand"


def test_joined_sentences_say_both_in_either_order():
    said = join(("walk forwards", "walking forwards"), ("wave with the right hand", "waving with the right hand"))
    assert {
        "walk forwards while waving with the right hand",
        "wave with the right hand and walk forwards",
        "walk forwards, waving with the right hand",
    } < set(said)
    assert len(set(said)) == len(said)


def test_gerunds_belong_to_sentences_of_contents_that_leave_body_parts_to_others():
    for name, each in CONTENTS.items():
        assert bool(each.gerunds) <= (len(each.parts) < len(BodyPart)), name
        assert {imperative for imperative, _ in each.gerunds} <= set(each.sentences)
        assert all("ing" in gerund for _, gerund in each.gerunds)
    without = {name for name, each in CONTENTS.items() if not each.gerunds and len(each.parts) < len(BodyPart)}
    assert without == {"pick-up-left", "pick-up-right"}  # whose arm and legs are one movement


def test_each_two_contents_of_different_parts_have_a_few_joined_sentences():
    joined = joined_sentences(set(CONTENTS) | {"unheard of"})
    assert frozenset(("walk", "wave-left-hand")) in joined and frozenset(("walk", "squat")) not in joined
    assert frozenset(("guitar", "wave-left-hand")) not in joined and frozenset(("walk", "cartwheel")) not in joined
    assert {len(set(texts)) for texts in joined.values()} == {PER_PAIR}
    assert len({text for texts in joined.values() for text in texts}) < 6000
    for pair, texts in joined.items():
        sides = set(re.findall(r"-(left|right)", " ".join(pair).replace("walk-left", "").replace("walk-right", "")))
        named = {{"counterclockwise": "left", "clockwise": "right"}.get(w, w) for t in texts for w in SIDES.findall(t)}
        assert named == sides, pair
    assert joined == joined_sentences(tuple(reversed(CONTENTS)))
