"""The perceptual study: what surveys ask, what their pages hold, and what is made of the answers."""

import base64
import json
import math
import re
from collections import Counter
from dataclasses import replace
from pathlib import Path
from statistics import NormalDist

import numpy as np
import pytest
import torch
from helpers.motions import walking
from helpers.scripts import loaded, run, script
from hypothesis import given
from hypothesis import strategies as st
from omegaconf import OmegaConf

import stmc
from stmc.evaluation.study import (
    AnswersError,
    Aspect,
    Key,
    Kind,
    Pair,
    Preference,
    Question,
    StudyError,
    Survey,
    Vote,
    analyse,
    design,
    read_answers,
    read_pairs,
    survey_page,
    wilson,
)
from stmc.evaluation.study.clips import Clip
from stmc.evaluation.study.surveys import stranger
from stmc.motion.body import JOINTS, PARENTS
from stmc.motion.body_model import Skeleton
from stmc.motion.geometry import rotation_z
from stmc.motion.motion import Motion
from stmc.timeline import Timeline

METHODS = ("collage", "rival")
Z = NormalDist().inv_cdf(0.975)


def pair(number: int, motions: int = 2) -> Pair:
    """A timeline with texts of its own, and two motions that nobody else has."""
    text = f"walk number{number} # 0 # {1 + 0.1 * number:.1f} # legs\nraise arm{number} # 0.3 # 0.9 # right arm"
    first, second = (walking(1.0 + 0.1 * number, speed=0.1 * number + side, turn=0.3) for side in (0.0, 0.7))
    return Pair(f"{number:04d}_0", Timeline.parse(text), first, second)


@pytest.fixture(scope="module")
def pairs() -> list[Pair]:
    return [pair(number) for number in range(17)]


@pytest.fixture(scope="module")
def study(pairs) -> tuple[list, Key]:
    return design(pairs, METHODS, seed=3)


def kinds(survey, key) -> list[Kind]:
    return [key.surveys[survey.id][question.id].kind for question in survey.questions]


# ---- surveys --------------------------------------------------------------------------------------------------------


def test_a_survey_asks_fifteen_questions_of_which_three_warm_up_and_two_are_honeypots(study):
    surveys, key = study
    assert len(surveys) == 2
    for survey in surveys:
        asked = kinds(survey, key)
        assert asked[:3] == [Kind.WARM_UP] * 3
        honeypots = {Kind.REALISM_HONEYPOT: 1, Kind.TIMELINE_HONEYPOT: 1}
        assert Counter(asked) == {Kind.WARM_UP: 3, Kind.PAIR: 10} | honeypots


def test_every_pair_is_asked_about_and_no_timeline_is_shown_twice_in_a_survey(study, pairs):
    surveys, key = study
    asked = [entry.pair for entries in key.surveys.values() for entry in entries.values() if entry.kind == Kind.PAIR]
    assert set(asked) == {each.name for each in pairs}
    for survey in surveys:
        names = [entry.pair for entry in key.surveys[survey.id].values()]
        assert len(names) == len(set(names)) == 15
        timelines = {each.name: each.timeline for each in pairs}
        for question in survey.questions:
            assert question.timeline is timelines[key.surveys[survey.id][question.id].pair]


def test_each_method_stands_on_the_left_for_half_of_the_pairs_in_no_regular_order(study):
    surveys, key = study
    orders = set()
    for survey in surveys:
        entries = key.surveys[survey.id]
        left = [
            entries[question.id].sides[question.sides[0][0]]
            for question in survey.questions
            if entries[question.id].kind == Kind.PAIR
        ]
        assert Counter(left) == {"collage": 5, "rival": 5}
        orders.add(tuple(left))
    assert len(orders) == 2


def test_ids_are_unique_and_lead_to_the_motion_that_the_key_says(study, pairs):
    surveys, key = study
    known = {each.name: {"collage": each.first, "rival": each.second} for each in pairs}
    ids = [survey.id for survey in surveys]
    for survey in surveys:
        for question in survey.questions:
            entry = key.surveys[survey.id][question.id]
            ids += [question.id, *(name for name, _ in question.sides)]
            for name, clip in question.sides:
                if entry.kind.tests is None:
                    expected = Clip.of(known[entry.pair][entry.sides[name]])
                    assert same(clip, expected)
    assert len(ids) == len(set(ids))
    assert all(re.fullmatch("[0-9a-f]{16}", name) for name in ids)


def same(one: Clip, other: Clip) -> bool:
    """Whether two clips are drawn alike."""
    return torch.equal(one.motion.rotations, other.motion.rotations) and np.array_equal(one.joints, other.joints)


def test_the_honeypots_right_side_is_the_first_method_s_own_motion(study, pairs):
    surveys, key = study
    known = {each.name: each for each in pairs}
    for survey in surveys:
        for question in survey.questions:
            entry = key.surveys[survey.id][question.id]
            if entry.kind.tests is None:
                continue
            clips = {entry.sides[name]: clip for name, clip in question.sides}
            own = known[entry.pair]
            assert same(clips["right"], Clip.of(own.first))
            if entry.kind == Kind.REALISM_HONEYPOT:
                assert same(clips["wrong"], Clip.of(own.second).stretched())
            else:
                other = stranger(own.timeline, [each for each in pairs if each is not own])
                assert same(clips["wrong"], Clip.of(other.first))


def test_a_study_belongs_to_its_seed_and_the_names_of_its_methods_and_timelines(study, pairs):
    surveys, key = study
    renamed = [replace(pairs[0], name="another"), *pairs[1:]]
    for different in (
        design(pairs, METHODS, seed=4)[1],
        design(pairs, ("collage", "another"), seed=3)[1],
        design(renamed, METHODS, seed=3)[1],
    ):
        assert not set(different.surveys) & set(key.surveys)
    again, same = design(pairs[::-1], METHODS, seed=3)
    assert same == key
    for survey, other in zip(surveys, again, strict=True):
        assert [(each.id, each.timeline) for each in survey.questions] == [
            (each.id, each.timeline) for each in other.questions
        ]


def test_the_last_bits_of_motions_which_no_two_processors_share_change_nothing_of_a_study(study, pairs):
    def elsewhere(motion: Motion) -> Motion:
        return replace(motion, joints=motion.joints * (1 + 2**-50))

    moved = [replace(each, first=elsewhere(each.first), second=elsewhere(each.second)) for each in pairs]
    assert not torch.equal(moved[0].first.joints, pairs[0].first.joints)
    surveys, key = design(moved, METHODS, seed=3)
    assert key == study[1] and [each.id for each in surveys] == [each.id for each in study[0]]


def test_too_few_timelines_and_methods_of_one_name_are_errors(pairs):
    with pytest.raises(StudyError, match="14 timelines have motions, but a survey of 10 pairs needs 15"):
        design(pairs[:14], METHODS)
    assert len(design(pairs[:14], METHODS, size=9)[0][0].questions) == 14
    with pytest.raises(StudyError, match="both methods are called 'stmc'"):
        design(pairs, ("stmc", "stmc"))
    with pytest.raises(StudyError, match="two pairs have the same name"):
        design([*pairs, pairs[0]], METHODS)


def test_the_stranger_has_other_texts_few_of_the_words_and_about_the_same_length():
    def made(text: str) -> Pair:
        return Pair(text, Timeline.parse(text), walking(1.0), walking(1.0))

    own = Timeline.parse("walk forwards # 0 # 6\nwave # 6 # 10")
    same, words = made("walk forwards # 0 # 10"), made("walk forwards slowly # 0 # 10")
    short, right = made("jump # 0 # 2"), made("jump up # 0 # 9")
    assert stranger(own, [same, words, short, right]) is right
    tied = replace(right, name="a")
    assert stranger(own, [right, tied]) is stranger(own, [tied, right]) is tied
    with pytest.raises(StudyError, match="a honeypot needs a timeline without 'walk forwards', 'wave'"):
        stranger(own, [same])


# ---- clips and pages ------------------------------------------------------------------------------------------------


@given(st.floats(-math.pi, math.pi), st.floats(-20, 20), st.floats(-20, 20))
def test_where_a_motion_begins_and_faces_does_not_show(angle, x, y):
    motion = walking(0.5, turn=0.9)
    turn = rotation_z(torch.tensor(angle).double())
    shift = torch.tensor([x, y, 0.0]).double()
    rotations = torch.cat([turn @ motion.rotations[:, :1], motion.rotations[:, 1:]], dim=1)
    moved = Motion(rotations, motion.translation @ turn.T + shift, motion.joints @ turn.T + shift, motion.fps)
    one, other = Clip.of(moved), Clip.of(motion)
    assert one.joints == pytest.approx(other.joints, abs=1e-9)
    assert one.motion.rotations.numpy() == pytest.approx(other.motion.rotations.numpy(), abs=1e-9)


def test_a_clip_begins_at_the_origin_and_looks_towards_minus_y():
    clip = Clip.of(walking(1.0))
    assert clip.joints[0, 0, :2] == pytest.approx([0, 0])
    assert clip.motion.facing[0].numpy() == pytest.approx([0, -1, 0], abs=1e-6)


def test_stretched_limbs_grow_to_twice_their_size_and_nothing_else_does():
    clip = Clip.of(walking(4.0))
    wild = clip.stretched()

    def lengths(joints, joint):
        return np.linalg.norm(joints[:, joint] - joints[:, PARENTS[joint]], axis=-1)

    largest = {"elbow": 2.6, "wrist": 2.6, "hand": 2.6, "knee": 2.0, "ankle": 2.0, "foot": 2.0}
    for joint, name in enumerate(JOINTS[1:], start=1):
        ratio = lengths(wild.joints, joint) / lengths(clip.joints, joint)
        assert ratio.max() == pytest.approx(largest.get(name.split("_")[-1], 1.0))
        assert ratio.min() >= 1 - 1e-9
    assert wild.joints[..., 2].min(axis=1) == pytest.approx(clip.joints[..., 2].min(axis=1))


def test_a_page_holds_one_figure_for_each_body():
    tall = Skeleton(Skeleton.default().offsets * 1.1)
    short, long = walking(1.0), walking(2.0)
    other = Motion.posed(short.rotations, short.translation, 20, tall)
    sides = tuple((f"{number:016x}", Clip.of(motion)) for number, motion in enumerate((short, other)))
    again = ((f"{7:016x}", Clip.of(long)), (f"{8:016x}", Clip.of(short).stretched()))
    timeline = Timeline.parse("walk # 0 # 1")
    data = data_of(survey_page(Survey("many", (Question("q", timeline, sides), Question("r", timeline, again)))))
    assert [clip["figure"] for question in data["questions"] for clip in question["clips"]] == [0, 1, 0, 0]
    assert [len(animations(figure)) for figure in data["figures"]] == [3, 1]


def data_of(content: str) -> dict:
    """What a page's script reads."""
    return json.loads(re.search(r'<script type="application/json" id="survey">(.*?)</script>', content, re.S)[1])


def animations(figure: str) -> list[str]:
    """Their names, in a figure's file."""
    binary = base64.b64decode(figure)
    document = json.loads(binary[20 : 20 + int.from_bytes(binary[12:16], "little")])
    return [each["name"] for each in document["animations"]]


def test_a_page_tells_nothing_of_what_its_questions_are_for(study, pairs):
    surveys, _ = study
    content = survey_page(surveys[0])
    data = data_of(content)
    assert [question["id"] for question in data["questions"]] == [question.id for question in surveys[0].questions]
    assert {tuple(question) for question in data["questions"]} == {("id", "duration", "prompts", "clips")}
    clips = [clip for question in data["questions"] for clip in question["clips"]]
    assert {tuple(clip) for clip in clips} == {("id", "figure")}
    assert sorted(clip["id"] for clip in clips) == sorted(name for each in data["figures"] for name in animations(each))
    page = re.sub(r"<script>.*?</script>|" + "|".join(map(re.escape, data["figures"])), "", content, flags=re.S)
    for secret in (*METHODS, *Kind, *(each.name for each in pairs), "honeypot", "warm", "seed", "stretched"):
        assert secret not in page or secret == "pair", secret


def test_a_page_loads_nothing_and_is_a_few_megabytes_at_most(study):
    content = survey_page(study[0][0])
    markup = re.sub("<script.*?</script>|'sha256-[^']*'", "", content, flags=re.S)  # a digest in base64 may hold "//"
    assert not re.search(r"https?:|//\w|@import|url\(", markup)
    assert "default-src 'none'; script-src 'sha256-" in content
    assert len(content) < 3_000_000


def test_texts_cannot_break_out_of_the_page(pairs):
    bad = Timeline.parse("</script><script>alert(1)</script> # 0 # 2 # legs")
    surveys, _ = design([replace(each, timeline=bad) if n == 0 else each for n, each in enumerate(pairs)], METHODS)
    contents = [survey_page(survey) for survey in surveys]
    assert any("alert(1)" in content for content in contents)
    assert all(content.count("</script>") == 2 for content in contents)


# ---- folders of motions ---------------------------------------------------------------------------------------------


def sampled(folder: Path, timeline: Timeline, motion: Motion, seed: int = 0, name: str = "some") -> Path:
    """A motion and its record, as the sampling script leaves them."""
    path = folder / f"{name}_{seed}.npz"
    stmc.write(motion, path)
    prompts = [[prompt.text, prompt.start, prompt.end, sorted(prompt.parts)] for prompt in timeline.prompts]
    path.with_suffix(".json").write_text(json.dumps({"seed": seed, "prompts": prompts}))
    return path


def test_motions_are_paired_by_their_timelines_whatever_their_files_are_called(tmp_path, pairs):
    one, other, third = pairs[:3]
    first, second = tmp_path / "first", tmp_path / "second"
    for each, name in ((one, "a"), (other, "b")):
        for seed in (2, 1):
            sampled(first, each.timeline, each.first if seed == 1 else each.second, seed, name)
        sampled(second, each.timeline, each.second, 7, {"a": "b", "b": "a"}[name])
    found = read_pairs(first, second, [third.timeline, other.timeline, one.timeline, one.timeline])
    assert [each.name for each in found] == ["b_1", "a_1"]
    assert [each.timeline for each in found] == [other.timeline, one.timeline]
    for each, origin in zip(found, (other, one), strict=True):
        assert each.first.joints.numpy() == pytest.approx(origin.first.joints.numpy(), abs=1e-5)
        assert each.second.joints.numpy() == pytest.approx(origin.second.joints.numpy(), abs=1e-5)


def test_what_cannot_be_paired_is_named(tmp_path, pairs):
    first, second = tmp_path / "first", tmp_path / "second"
    one, other = pairs[:2]
    with pytest.raises(StudyError, match="first has no motions"):
        read_pairs(first, second, [one.timeline])
    path = sampled(first, one.timeline, one.first)
    sampled(second, other.timeline, other.first)
    with pytest.raises(
        StudyError, match=r"'walk number0', 'raise arm0'\): .*first has a motion of it, .*second has none"
    ):
        read_pairs(first, second, [one.timeline])
    with pytest.raises(StudyError, match="has a motion of any of the 1 timelines"):
        read_pairs(first, second, [pairs[2].timeline])
    path.with_suffix(".json").write_text('{"seed": 0}')
    with pytest.raises(StudyError, match=r"some_0\.json is not a record"):
        read_pairs(first, second, [one.timeline])
    path.with_suffix(".json").unlink()
    with pytest.raises(StudyError, match=r"some_0\.json is missing"):
        read_pairs(first, second, [one.timeline])


# ---- answers --------------------------------------------------------------------------------------------------------


def answered(
    key: Key, survey: str, rater: int, realism=Vote.FIRST, timeline=Vote.FIRST, honeypots: dict | None = None
) -> dict:
    """The file of a rater who says the same of every pair, and of honeypots as told: right, wrong or none."""
    answers = {}
    wanted = {Vote.FIRST: key.methods[0], Vote.SECOND: key.methods[1], Vote.NEITHER: "none"}
    for question, entry in key.surveys[survey].items():
        ids = {behind: name for name, behind in entry.sides.items()} | {"none": "none"}
        if entry.kind.tests is None:
            answers[question] = {"realism": ids[wanted[realism]], "timeline": ids[wanted[timeline]]}
        else:
            chosen = ids[(honeypots or {}).get(entry.kind.tests, "right")]
            answers[question] = {"realism": "none", "timeline": "none"} | {entry.kind.tests: chosen}
    return {"format": "stmc study answers 1", "survey": survey, "rater": f"{rater:016x}", "answers": answers}


def written(folder: Path, *files: dict) -> list[Path]:
    folder.mkdir(exist_ok=True)
    paths = [folder / f"{number}.json" for number in range(len(files))]
    for path, data in zip(paths, files, strict=True):
        path.write_text(json.dumps(data))
    return paths


def test_the_majority_decides_and_ties_are_no_preference(study, tmp_path):
    _, key = study
    one = next(iter(key.surveys))
    paths = written(
        tmp_path / "answers",
        answered(key, one, 1, Vote.FIRST, Vote.FIRST),
        answered(key, one, 2, Vote.FIRST, Vote.SECOND),
        answered(key, one, 3, Vote.SECOND, Vote.NEITHER),
    )
    found = analyse(key, read_answers(paths, key))
    realism, timeline = found.preferences[Aspect.REALISM], found.preferences[Aspect.TIMELINE]
    assert (realism.count(Vote.FIRST), realism.count(Vote.NEITHER), realism.count(Vote.SECOND)) == (10, 0, 0)
    assert (timeline.count(Vote.FIRST), timeline.count(Vote.NEITHER), timeline.count(Vote.SECOND)) == (0, 10, 0)
    assert realism.raters == timeline.raters == 3
    assert len(found.unjudged) == 7
    assert found.data()["preferences"]["realism"]["shares"]["first"]["share"] == 1.0
    assert found.data()["preferences"]["realism"]["shares"]["first"]["interval"] == list(wilson(10, 10))
    text = found.text()
    assert re.search(r"collage or similar +10 +100\.0 % +\[72\.2, 100\.0\]", text)
    assert "7 pairs have no answers: " in text


@pytest.mark.parametrize(
    ("votes", "majority"),
    [
        ({Vote.FIRST: 2, Vote.SECOND: 1}, Vote.FIRST),
        ({Vote.FIRST: 1, Vote.SECOND: 1}, Vote.NEITHER),
        ({Vote.FIRST: 2, Vote.NEITHER: 2, Vote.SECOND: 1}, Vote.NEITHER),
        ({Vote.SECOND: 3, Vote.NEITHER: 2, Vote.FIRST: 2}, Vote.SECOND),
        ({Vote.NEITHER: 1}, Vote.NEITHER),
    ],
)
def test_the_answer_with_most_votes_wins(votes, majority):
    assert Preference({"pair": Counter(votes)}).outcomes == {"pair": majority}


@pytest.mark.parametrize(
    ("honeypots", "reason"),
    [
        ({"realism": "wrong"}, "realism honeypot failed: chose the stretched motion"),
        ({"timeline": "wrong"}, "timeline honeypot failed: chose another timeline's motion"),
        ({"timeline": "none"}, "timeline honeypot failed: no preference"),
    ],
)
def test_who_fails_a_honeypot_is_discarded_in_all_surveys_and_the_reason_is_said(study, tmp_path, honeypots, reason):
    _, key = study
    one, two = key.surveys
    paths = written(
        tmp_path / "answers",
        answered(key, one, 1, Vote.SECOND, Vote.SECOND, honeypots),
        answered(key, two, 1, Vote.SECOND, Vote.SECOND),
        answered(key, one, 2),
    )
    found = analyse(key, read_answers(paths, key))
    assert [each.source for each in found.kept] == [str(paths[2])]
    assert [(each.answers.source, each.reasons) for each in found.discarded] == [
        (str(paths[0]), (reason,)),
        (str(paths[1]), (f"{reason} (the same rater in {paths[0]})",)),
    ]
    assert found.preferences[Aspect.REALISM].count(Vote.FIRST) == 10
    assert f"{paths[0]}: {reason}" in found.text()
    assert found.data()["discarded"][0] == {"file": str(paths[0]), "rater": f"{1:016x}", "reasons": [reason]}


def test_a_rater_has_one_vote_on_a_pair_that_two_surveys_ask_about(study, tmp_path):
    _, key = study
    one, two = key.surveys
    paths = written(tmp_path / "answers", answered(key, one, 1, Vote.FIRST), answered(key, two, 1, Vote.SECOND))
    found = analyse(key, read_answers(paths, key)).preferences[Aspect.REALISM]
    assert len(found.votes) == 17
    assert all(votes.total() == 1 for votes in found.votes.values())
    assert (found.count(Vote.FIRST), found.count(Vote.SECOND)) == (10, 7)


def test_nobody_left_is_said_and_not_divided_by(study):
    _, key = study
    found = analyse(key, [])
    assert "0 pairs" in found.text() and len(found.unjudged) == 17
    assert found.data()["preferences"]["timeline"]["shares"] == {}


@given(st.integers(1, 400).flatmap(lambda total: st.tuples(st.integers(0, total), st.just(total))))
def test_wilson_s_bounds_are_the_shares_from_which_the_observed_one_is_z_deviations_away(case):
    count, total = case
    for bound in wilson(count, total):
        assert (count / total - bound) ** 2 == pytest.approx(Z**2 * bound * (1 - bound) / total, abs=1e-9)
    assert wilson(0, total)[1] == pytest.approx(Z**2 / (total + Z**2))
    low, high = wilson(total - count, total)
    assert wilson(count, total) == pytest.approx((1 - high, 1 - low))


def test_no_share_of_nothing():
    with pytest.raises(ValueError, match="3 of 0 is not a share"):
        wilson(3, 0)


def tampered(change: str, data: dict, key: Key) -> None:
    """Changes an honest answer file in one respect."""
    questions = list(data["answers"])
    ids = list(key.surveys[data["survey"]][questions[1]].sides)
    match change:
        case "a question is gone":
            del data["answers"][questions[4]]
        case "a question is new":
            data["answers"]["0" * 16] = data["answers"][questions[4]]
        case "a choice is another question's":
            data["answers"][questions[0]]["realism"] = ids[0]
        case "a choice is no text":
            data["answers"][questions[0]]["realism"] = ["none"]
        case "an answer is gone":
            del data["answers"][questions[0]]["timeline"]
        case "an answer is none at all":
            data["answers"][questions[0]] = None
        case "the survey is unknown":
            data["survey"] = "f" * 16
        case "the survey is a list":
            data["survey"] = []
        case "the rater is a name":
            data["rater"] = "Anna"
        case "the format is another":
            data["format"] = "stmc study answers 2"
        case "a key is new":
            data["method"] = "stmc"


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        ("a question is gone", r"answers: '[0-9a-f]{16}' is missing$"),
        ("a question is new", r"answers: '0000000000000000' does not belong there"),
        ("a choice is another question's", r"answers\.[0-9a-f]{16}\.realism: '[0-9a-f]{16}' is neither of the two"),
        ("a choice is no text", r"realism: \[\"none\"\] is neither of the two motions nor 'none'"),
        ("an answer is gone", r"answers\.[0-9a-f]{16}: 'timeline' is missing"),
        ("an answer is none at all", r"answers\.[0-9a-f]{16}: null is not an object"),
        ("the survey is unknown", "survey: 'ffffffffffffffff' is none of the 2 surveys of this key"),
        ("the survey is a list", r"survey: \[\] is none of the 2 surveys"),
        ("the rater is a name", "rater: 'Anna' is not the code of 16 hexadecimal digits"),
        ("the format is another", "format: 'stmc study answers 2' is not 'stmc study answers 1'"),
        ("a key is new", "the document: 'method' does not belong there"),
    ],
)
def test_a_tampered_file_is_named_with_the_place_that_is_wrong(study, tmp_path, change, complaint):
    _, key = study
    data = answered(key, next(iter(key.surveys)), 1)
    tampered(change, data, key)
    with pytest.raises(AnswersError, match=r"0\.json: ") as caught:
        read_answers(written(tmp_path / "answers", data), key)
    assert re.search(complaint, str(caught.value)), str(caught.value)


@pytest.mark.parametrize(
    ("content", "complaint"),
    [
        (b"", "line 1, column 1: not JSON"),
        (b"\xff\xfe", "not UTF-8 text"),
        (b"[" * 100000, "not JSON"),
        (b"[]", r"the document: \[\] is not an object"),
        (b'{"rater": "a", "rater": "b"}', "the key 'rater' is duplicated"),
        (b"{}", "the document: 'format' is missing, and 3 more"),
        (b" " * (2**20 + 1), "larger than 1 MiB"),
    ],
)
def test_what_is_no_answer_file_is_named(study, tmp_path, content, complaint):
    (tmp_path / "x.json").write_bytes(content)
    with pytest.raises(AnswersError, match=r"x\.json: " + complaint):
        read_answers([tmp_path / "x.json"], study[1])
    with pytest.raises(AnswersError, match=r"y\.json: cannot be read"):
        read_answers([tmp_path / "y.json"], study[1])


def test_the_same_answers_cannot_count_twice(study, tmp_path):
    _, key = study
    data = answered(key, next(iter(key.surveys)), 1)
    with pytest.raises(AnswersError, match=r"1\.json: the same rater's answers to the same survey are in .*0\.json"):
        read_answers(written(tmp_path / "answers", data, data), key)


def test_a_key_is_read_as_it_was_written_and_else_refused(study, tmp_path):
    _, key = study
    path = tmp_path / "key.json"
    key.write(path)
    assert Key.read(path) == key
    data = json.loads(path.read_text())
    broken = json.loads(path.read_text())
    next(iter(next(iter(broken["surveys"].values())).values()))["sides"] = {"a": "collage", "b": "collage"}
    for content in ("", "[]", "{}", json.dumps(data | {"methods": ["one"]}), json.dumps(broken)):
        path.write_text(content)
        with pytest.raises(StudyError, match=r"key\.json is not an answer key"):
            Key.read(path)
    path.write_text(json.dumps(data | {"format": "else"}))
    with pytest.raises(StudyError, match="the format is 'else'"):
        Key.read(path)


# ---- scripts --------------------------------------------------------------------------------------------------------


@pytest.fixture
def asked(pairs, tmp_path) -> tuple[str, ...]:
    """Settings of a study of seven timelines whose motions lie in two folders."""
    for each in pairs[:7]:
        sampled(tmp_path / "stmc", each.timeline, each.first, name=each.name)
        sampled(tmp_path / "sinc", each.timeline, each.second, name=each.name)
    Timeline.write_all([each.timeline for each in pairs], tmp_path / "timelines.json")
    folders = (f"first={tmp_path / 'stmc'}", f"second={tmp_path / 'sinc'}", f"output={tmp_path / 'study'}")
    return (*folders, f"timelines={tmp_path / 'timelines.json'}", "size=2", "names=[null,rival]")


def test_from_folders_of_motions_to_an_analysis_by_the_scripts(asked, tmp_path, capsys):
    output = tmp_path / "study"
    run("study", "study", *asked)
    assert "4 surveys" in capsys.readouterr().out
    assert sorted(path.name for path in (output / "surveys").iterdir()) == [f"survey_{n:02d}.html" for n in range(1, 5)]
    key = Key.read(output / "key.json")
    assert key.methods == ("stmc", "rival")
    written(tmp_path / "answers", *(answered(key, survey, 5) for survey in key.surveys))
    run("analyse_study", "analyse_study", f"study={output}", f"answers={tmp_path / 'answers'}")
    told = capsys.readouterr().out
    assert re.search(r"stmc or similar +7 +100\.0 %", told)
    assert (output / "analysis.txt").read_text() == told
    assert json.loads((output / "analysis.json").read_text())["preferences"]["timeline"]["pairs"] == 7


@pytest.mark.slow
def test_the_scripts_leave_nothing_in_the_folder_that_they_are_called_in(asked, tmp_path):
    here, output = tmp_path / "here", tmp_path / "study"
    script("study", *asked, folder=here)
    key = Key.read(output / "key.json")
    written(tmp_path / "answers", *(answered(key, survey, 5) for survey in key.surveys))
    script("analyse_study", f"study={output}", f"answers={tmp_path / 'answers'}", folder=here)
    assert not list(here.iterdir())


def test_a_study_is_not_overwritten_and_an_analysis_needs_answers(tmp_path):
    (tmp_path / "key.json").write_text("{}")
    with pytest.raises(StudyError, match="already holds a study, and its answers need its key"):
        loaded("study").write_study(OmegaConf.create(), tmp_path)
    Key(METHODS, {}).write(tmp_path / "key.json")
    with pytest.raises(StudyError, match="has no answer files"):
        loaded("analyse_study").analyse_folder(tmp_path, tmp_path / "answers")
