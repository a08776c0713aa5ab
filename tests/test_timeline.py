"""Timelines: what they accept, what they refuse and in which words, files, drawings, and baselines made from them."""

import hashlib
import json
import math
import re
import warnings
from itertools import pairwise
from pathlib import Path

import pytest
from conftest import data_file, golden, golden_sets
from helpers.strategies import quietly, timelines
from hypothesis import given
from hypothesis import strategies as st

from stmc.motion.body import BodyPart
from stmc.timeline import Prompt, Timeline, TimelineError, TimelineWarning, one_text, single_track
from stmc.timeline.overlaps import Precedence

WALK_AND_RAISE = "walk forwards # 0 # 6 # legs\nraise the right arm # 2 # 5.5 # right arm # torso\n"
ALL = "left arm, right arm, legs, head, spine"


def refusal(document: str, read=Timeline.parse_all) -> str:
    with pytest.raises(TimelineError) as caught:
        read(document)
    return str(caught.value)


def of_json(tmp_path: Path):
    def read(document: str) -> list[Timeline]:
        (tmp_path / "t.json").write_text(document, encoding="utf-8")
        return Timeline.read_all(tmp_path / "t.json")

    return read


# Prompts and timelines


def test_a_prompt_takes_part_names_and_keeps_body_parts():
    assert Prompt("sit", 0, 1, ["Torso", "left_arm"]).parts == {BodyPart.SPINE, BodyPart.LEFT_ARM}
    assert Prompt("sit", 0, 1, "legs").parts == {BodyPart.LEGS}


def test_the_part_names_of_published_timelines_are_read_as_the_parts_that_own_them():
    timeline = Timeline.parse("wave # 0 # 2 # Left hand # neck # torso\nkick # 0 # 2 # left leg # right_leg")
    wave, kick = timeline.prompts
    assert wave.parts == {BodyPart.LEFT_ARM, BodyPart.HEAD, BodyPart.SPINE}
    assert kick.parts == {BodyPart.LEGS}
    assert Prompt("wave", 0, 1, ["right-hand"]).parts == {BodyPart.RIGHT_ARM}
    assert "unknown body part 'leg'" in refusal("kick # 0 # 1 # leg")


def test_a_prompt_without_parts_claims_the_whole_body():
    assert Prompt("sit", 0, 1).parts == frozenset()
    assert Prompt("sit", 0, 1).claims == set(BodyPart)
    assert Prompt("sit", 0, 1, {"legs"}).claims == {BodyPart.LEGS}


def test_white_space_in_a_text_becomes_one_space():
    assert Prompt("  walk \n\t forwards ", 0, 1).text == "walk forwards"


def test_times_are_floats_of_seconds():
    prompt = Prompt("sit", 1, 2)
    assert (prompt.start, prompt.end) == (1.0, 2.0)
    assert isinstance(prompt.start, float)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ((" ", 0, 1), "the text is empty"),
        (("sit", 2, 1), "end 1 must be later than start 2"),
        (("sit", 2, 2), "end 2 must be later than start 2"),
        (("sit", -0.5, 1), "start -0.5 must be a finite number of seconds, 0 or later"),
        (("sit", math.nan, 1), "start nan must be a finite"),
        (("sit", 0, math.inf), "end inf must be a finite"),
        (("sit", 0, 10**400), "must be a finite"),
        (("sit", 0, 1, {"leg"}), f"unknown body part 'leg'; choose from {ALL}"),
    ],
)
def test_a_prompt_that_cannot_be_meant_is_refused(arguments, words):
    with pytest.raises(TimelineError, match=words.replace("(", r"\(")):
        Prompt(*arguments)


def test_an_empty_timeline_is_refused():
    with pytest.raises(TimelineError, match="the timeline is empty"):
        Timeline([])


def test_frames_are_truncated_seconds():
    timeline = Timeline([Prompt("sit", 0.09, 1.99)])
    assert timeline.spans(20) == ((1, 39),)
    assert timeline.frames(20) == 39


@pytest.mark.parametrize("fps", [0, -20, math.nan, math.inf])
def test_frames_per_second_must_be_positive(fps):
    with pytest.raises(ValueError, match="must be a positive number of frames per second"):
        Timeline([Prompt("sit", 0, 1)]).spans(fps)


def test_a_late_first_prompt_stays_late_until_the_timeline_is_shifted():
    timeline = Timeline([Prompt("sit", 2, 3), Prompt("walk", 3, 5)], "late")
    assert timeline.duration == 5
    shifted = timeline.shifted()
    assert [(prompt.start, prompt.end) for prompt in shifted.prompts] == [(0, 1), (1, 3)]
    assert shifted.name == "late"


def test_prompts_without_tracks_go_to_the_first_track_that_is_free():
    times = {"legs": [(0, 4), (4, 6)], "head": [(1, 2), (3, 5)]}
    (a, c), (b, d) = ([Prompt("sit", *span, part) for span in spans] for part, spans in times.items())
    timeline = Timeline([a, b, c, d])
    assert timeline.rows == (0, 1, 0, 1)
    assert timeline.tracks == ((a, c), (b, d))


def test_given_tracks_are_kept():
    a, b = Prompt("a", 0, 1), Prompt("b", 2, 3)
    assert Timeline([a, b], rows=[4, 7]).tracks == ((a,), (b,))


def test_two_prompts_of_one_track_at_the_same_time_are_refused():
    prompts = [Prompt("a", 0, 4), Prompt("b", 3.5, 5)]
    with pytest.raises(TimelineError, match=r"prompt 2 \('b', 3.5 to 5 s\) .* as prompt 1 \('a', 0 to 4 s\)"):
        Timeline(prompts, rows=[0, 0])


def test_every_prompt_needs_a_row_if_one_has():
    with pytest.raises(TimelineError, match="1 rows for 2 prompts"):
        Timeline([Prompt("a", 0, 1), Prompt("b", 2, 3)], rows=[0])


# SINC's order and its warnings


def owners_at_once(*parts: set[str]) -> list[int]:
    """The prompt that each body part obeys while prompts that list these parts hold together."""
    precedence = Precedence([Prompt("sit", 0, 1, listed).parts for listed in parts])
    precedence.update([], range(len(parts)))
    return [precedence.owner(part) for part in BodyPart]


def test_the_base_is_the_biggest_prompt_with_legs():
    assert owners_at_once({"head", "spine", "left arm"}, {"legs"}, {"head"}) == [0, 1, 1, 2, 0]
    assert owners_at_once({"head", "spine", "left arm"}, {"head"}) == [0, 0, 0, 1, 0]


def test_ties_fall_to_the_order_of_the_file():
    assert owners_at_once({"head"}, {"spine"}, {"left arm"}) == [2, 0, 0, 0, 1]


@pytest.mark.parametrize(
    ("document", "winner"),
    [
        ("a # 0 # 4 # right arm # spine\nb # 2 # 6 # right arm", 2),
        ("a # 0 # 4 # right arm\nb # 2 # 6 # right arm # spine", 1),
        ("a # 0 # 4 # right arm\nb # 2 # 6 # right arm", 2),
        ("a # 0 # 4 # legs # right arm\nb # 2 # 6 # head # spine # right arm", 2),
        ("a # 0 # 4\nb # 2 # 6", 2),
    ],
)
def test_a_part_claimed_twice_is_a_warning_that_says_who_gets_it(document, winner):
    with pytest.warns(TimelineWarning, match=rf"right arm.* at 2 s; '{'ab'[winner - 1]}' \(line {winner}\) gets it$"):
        Timeline.parse(document)


@pytest.mark.parametrize(
    "document",
    [
        "a # 0 # 4 # right arm\nb # 4 # 6 # right arm",
        "a # 0 # 4 # right arm\nb # 2 # 6 # left arm",
        "walk # 0 # 6\nwave # 2 # 4 # right arm",
    ],
)
def test_compatible_prompts_give_no_warning(document):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        Timeline.parse(document)


# Text


def test_text_gives_prompts_in_the_order_of_the_lines():
    timeline = Timeline.parse(WALK_AND_RAISE)
    assert timeline.prompts == (
        Prompt("walk forwards", 0, 6, {"legs"}),
        Prompt("raise the right arm", 2, 5.5, {"right arm", "spine"}),
    )


def test_blank_lines_separate_timelines():
    document = f"\ufeff\n{WALK_AND_RAISE} \n\t\n\r\nsit # 0 # 1\r\n\n"
    walk, sit = Timeline.parse_all(document)
    assert walk == Timeline.parse(WALK_AND_RAISE)
    assert sit.prompts == (Prompt("sit", 0, 1),)


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("sit", "'sit' has no start and no end; write text # start # end # part # part"),
        ("sit # 0", "'sit # 0' has no end; write text # start # end # part # part"),
        ("sit # now # 1", "start 'now' is not a number of seconds; write text # start # end"),
        ("sit # 0 # legs", "end 'legs' is not a number of seconds"),
        ("# 0 # 1", "the text is empty"),
        ("sit # 3 # 1", "end 1 must be later than start 3"),
        ("sit # 3 # 3", "end 3 must be later than start 3"),
        ("sit # -3 # 3", "start -3.0 must be a finite number of seconds, 0 or later"),
        ("sit # nan # 3", "start nan must be a finite"),
        ("sit # 0 # inf", "end inf must be a finite"),
        ("sit # 0 # 1 # knee", f"unknown body part 'knee'; choose from {ALL}"),
        ("sit # 0 # 1 #", f"unknown body part ''; choose from {ALL}"),
    ],
)
def test_errors_in_text_name_the_line_the_value_and_the_choices(line, words, tmp_path):
    document = f"walk # 0 # 6\n\n{line}\n"
    assert refusal(document).startswith("line 3: ")
    assert words in refusal(document)
    path = tmp_path / "t.txt"
    path.write_text(document)
    assert refusal(path, Timeline.read_all).startswith(f"{path}, line 3: ")


def test_a_text_without_prompts_is_refused():
    assert "the timeline is empty; write one prompt a line: text # start # end" in refusal("\n \n")


def test_one_timeline_is_not_read_from_several():
    assert "holds 2 timelines" in refusal("sit # 0 # 1\n\nsit # 0 # 1", Timeline.parse)


# JSON


def test_json_keeps_name_tracks_and_order(tmp_path):
    path = tmp_path / "one.json"
    document = {
        "name": "0001",
        "tracks": [
            [{"text": "wave", "start": 1, "end": 2.5, "body_parts": ["left arm", "torso"]}],
            [],
            [{"text": "walk", "start": 3, "end": 4.0}, {"text": "sit", "start": 0, "end": 1}],
        ],
    }
    path.write_text(json.dumps(document))
    timeline = Timeline.read(path)
    assert timeline.name == "0001"
    assert [[prompt.text for prompt in track] for track in timeline.tracks] == [["wave"], ["walk", "sit"]]
    assert timeline.prompts[0].parts == {BodyPart.LEFT_ARM, BodyPart.SPINE}
    timeline.write(path)
    assert Timeline.read(path) == timeline
    assert Timeline.read(path).rows == timeline.rows


def test_a_json_list_holds_many_timelines(tmp_path):
    many = [Timeline([Prompt("sit", 0, 1)], "a"), Timeline([Prompt("walk", 0, 1)], "b")]
    Timeline.write_all(many, tmp_path / "many.json")
    assert Timeline.read_all(tmp_path / "many.json") == many
    assert Timeline.parse_all((tmp_path / "many.json").read_text(), ".json") == many
    assert "holds 2 timelines" in refusal(tmp_path / "many.json", Timeline.read)


def test_what_a_file_would_hold_is_written_and_read_without_one(tmp_path):
    timeline = Timeline([Prompt("sit", 0, 1, ["legs"]), Prompt("wave", 2, 3)], rows=[0, 1])
    for suffix, text in ((".json", timeline.to_json()), (".TXT", timeline.to_text())):
        timeline.write(tmp_path / f"t{suffix}")
        assert (tmp_path / f"t{suffix}").read_text() == text
        assert Timeline.parse(text, suffix) == timeline
    assert Timeline.parse(timeline.to_json(), ".json").rows == timeline.rows
    with pytest.raises(TimelineError, match=r"^unknown kind of timeline file '\.csv'; choose from \.json, \.txt$"):
        Timeline.parse("sit # 0 # 1", ".csv")
    with pytest.raises(TimelineError, match=r"^tracks\[0\]\[0\]: no \"end\""):
        Timeline.parse('{"tracks": [[{"text": "sit", "start": 0}]]}', ".json")


SIT = '{"text": "sit", "start": 0, "end": 1}'


@pytest.mark.parametrize(
    ("document", "words"),
    [
        ("{", "line 1, column 2: not JSON"),
        ("[" * 100_000, "not JSON that can be read"),
        ("[]", "the list of timelines is empty"),
        ("3", "the document: 3 is not a timeline"),
        ("{}", 'the document: no "tracks"'),
        ('[{"tracks": [], "nam": 1}]', "[0]: unknown key 'nam'; choose from name, tracks"),
        ('{"tracks": [[]]}', "the document: the timeline is empty"),
        ('[{"tracks": []}]', "[0]: the timeline is empty"),
        ('{"tracks": [], "name": 7}', "name: 7 is not a string"),
        ('{"tracks": {}}', "tracks: {} is not a list of tracks"),
        (f'{{"tracks": [{SIT}]}}', "tracks[0]: "),
        ('{"tracks": [[], ["sit"]]}', "tracks[1][0]: 'sit' is not a prompt"),
        ('[{"tracks": [[{"text": "sit", "start": 0}]]}]', '[0].tracks[0][0]: no "end"; a prompt needs text, start'),
        (f'{{"tracks": [[{SIT[:-1]}, "parts": []}}]]}}', "'parts'; choose from text, start, end, body_parts"),
        ('{"tracks": [[{"text": 3, "start": 0, "end": 1}]]}', "tracks[0][0].text: 3 is not a string"),
        ('{"tracks": [[{"text": "sit", "start": "0", "end": 1}]]}', "tracks[0][0].start: '0' is not a number of"),
        ('{"tracks": [[{"text": "sit", "start": 0, "end": true}]]}', "tracks[0][0].end: true is not a number"),
        ('{"tracks": [[{"text": "sit", "start": NaN, "end": 1}]]}', "tracks[0][0]: start nan must be a finite"),
        ('{"tracks": [[{"text": "sit", "start": 0, "end": 1e999}]]}', "tracks[0][0]: end inf must be a finite"),
        ('{"tracks": [[{"text": "sit", "start": -1, "end": 1}]]}', "tracks[0][0]: start -1 must be a finite number"),
        ('{"tracks": [[{"text": "sit", "start": 2, "end": 1}]]}', "tracks[0][0]: end 1 must be later than start 2"),
        ('{"tracks": [[{"text": "", "start": 0, "end": 1}]]}', "tracks[0][0]: the text is empty"),
        (f'{{"tracks": [[{SIT[:-1]}, "body_parts": "legs"}}]]}}', "body_parts: 'legs' is not a list of body parts"),
        (f'{{"tracks": [[{SIT[:-1]}, "body_parts": [3]}}]]}}', f"body_parts[0]: 3 is not one of {ALL}"),
        (f'{{"tracks": [[{SIT[:-1]}, "body_parts": ["leg"]}}]]}}', f"unknown body part 'leg'; choose from {ALL}"),
        (f'{{"tracks": [[{SIT}], [{SIT}, {SIT}]]}}', "tracks[1][1] ('sit', 0 to 1 s) is in the same track as "),
    ],
)
@quietly
def test_errors_in_json_name_the_path_the_value_and_the_choices(document, words, tmp_path):
    message = refusal(document, of_json(tmp_path))
    assert message.startswith(f"{tmp_path / 't.json'}, ")
    assert words in message


# Files


def test_a_file_of_unknown_kind_is_refused(tmp_path):
    assert "choose from .json, .txt" in refusal(tmp_path / "t.yaml", Timeline.read_all)


def test_a_file_that_is_not_text_is_refused(tmp_path):
    (tmp_path / "t.txt").write_bytes(b"sit\xff # 0 # 1")
    assert "not UTF-8 text" in refusal(tmp_path / "t.txt", Timeline.read_all)


def test_a_text_with_the_separator_is_only_written_as_json(tmp_path):
    timeline = Timeline([Prompt("play in C#", 0, 1)])
    (tmp_path / "t.txt").write_text("precious")
    with pytest.raises(TimelineError, match=r"'play in C#' has a #.* write .json instead"):
        timeline.write(tmp_path / "t.txt")
    assert (tmp_path / "t.txt").read_text() == "precious"
    timeline.write(tmp_path / "t.json")
    assert Timeline.read(tmp_path / "t.json") == timeline


def test_nothing_but_the_file_is_left_after_writing(tmp_path):
    Timeline.parse(WALK_AND_RAISE).write(tmp_path / "t.txt")
    assert [path.name for path in tmp_path.iterdir()] == ["t.txt"]


@quietly
@given(st.lists(timelines(), min_size=1, max_size=3), st.sampled_from((".json", ".txt")))
def test_what_is_written_is_read_back(tmp_path_factory, many, suffix):
    path = tmp_path_factory.mktemp("files") / f"t{suffix}"
    Timeline.write_all(many, path)
    back = Timeline.read_all(path)
    assert [timeline.prompts for timeline in back] == [timeline.prompts for timeline in many]
    if suffix == ".json":
        assert back == many


# Drawing


def test_printing_a_timeline_draws_its_tracks():
    assert str(Timeline.parse(WALK_AND_RAISE)).splitlines() == [
        "timeline: 6 s, 2 prompts",
        "0 s         1            2            3           4            5            6",
        "[1 walk forwards···························································]",
        "                         [2 raise the right arm·····················]",
        "1  walk forwards        0 to 6 s    legs",
        "2  raise the right arm  2 to 5.5 s  right arm, spine",
    ]


def test_a_notebook_shows_the_drawing():
    assert Timeline([Prompt("walk < run", 0, 1)], "x")._repr_html_().startswith("<pre>x: 1 s, 1 prompt")
    assert "walk &lt; run" in Timeline([Prompt("walk < run", 0, 1)])._repr_html_()


@quietly
@given(timelines())
def test_any_timeline_can_be_drawn(timeline):
    title, ruler, *rest = str(timeline).splitlines()
    assert title.endswith("prompts") or title.endswith("1 prompt")
    assert len(rest) == len(timeline.tracks) + len(timeline.prompts)
    assert all(len(row) <= 76 for row in rest[: len(timeline.tracks)])
    assert ruler.startswith("0 s")


# Baselines


def test_one_text_joins_tracks_with_while_and_prompts_with_and_then():
    timeline = Timeline([Prompt("A", 0, 2, {"legs"}), Prompt("C", 1, 3, {"head"}), Prompt("B", 2, 5, {"legs"})], "name")
    baseline = one_text(timeline, 9.8)
    assert baseline == Timeline([Prompt("A and then B while C", 0, 5, {"legs", "head"})], "name")
    assert one_text(timeline, 4).duration == 4


def test_single_track_cuts_where_any_prompt_starts_or_ends():
    timeline = Timeline([Prompt("A", 0, 4, {"legs"}), Prompt("B", 2, 6, {"head"}), Prompt("C", 7, 8)], "name")
    assert single_track(timeline, 20) == Timeline(
        [
            Prompt("A", 0, 2, {"legs"}),
            Prompt("A while B", 2, 4, {"legs", "head"}),
            Prompt("B", 4, 6, {"head"}),
            Prompt("C", 7, 8, set(BodyPart)),
        ],
        "name",
    )


def test_single_track_has_no_pieces_of_zero_frames():
    prompts = [Prompt("A", 0, 2), Prompt("B", 0.01, 1.99, {"head"}), Prompt("C", 2, 3), Prompt("D", 2.51, 2.52, "head")]
    pieces = single_track(Timeline(prompts), 20)
    assert pieces.spans(20) == ((0, 39), (39, 40), (40, 60))
    assert [prompt.text for prompt in pieces.prompts] == ["A while B", "A", "C"]


def test_single_track_of_a_moment_is_refused():
    with pytest.raises(TimelineError, match="no prompt lasts a frame at 20 fps"):
        single_track(Timeline([Prompt("A", 0, 0.01)]), 20)


@quietly
@given(timelines(), st.sampled_from((20, 30, 7.5)))
def test_single_track_pieces_follow_each_other(timeline, fps):
    if all(start == end for start, end in timeline.spans(fps)):
        return
    pieces = single_track(timeline, fps)
    spans = pieces.spans(fps)
    assert len(pieces.tracks) == 1
    assert all(start < end for start, end in spans)
    assert all(end <= start for (_, end), (start, _) in pairwise(spans))
    covered = {frame for start, end in timeline.spans(fps) for frame in range(start, end)}
    assert {frame for start, end in spans for frame in range(start, end)} == covered


def fingerprint(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def record(prompt: Prompt) -> tuple:
    return prompt.start, prompt.end, [part for part in BodyPart if part in prompt.parts], fingerprint(prompt.text)


@pytest.mark.data
def test_the_published_timelines_are_read_without_a_warning():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        mtt = Timeline.read_all(data_file("mtt/MTT.txt"))
    assert len(mtt) == 500
    assert all([len(track) for track in timeline.tracks] == [2, 1] for timeline in mtt)


@pytest.mark.golden
@pytest.mark.data
@pytest.mark.parametrize("folder", golden_sets("stmc"))
def test_baselines_of_the_published_timelines_are_the_published_ones(folder):
    expected = golden(folder, "mtt_baselines.json.gz")
    mtt = Timeline.read_all(data_file("mtt/MTT.txt"))
    fps = expected["fps"]
    for case in expected["timelines"]:
        timeline = mtt[case["id"]]
        assert [list(record(prompt)) for prompt in timeline.prompts] == case["prompts_s"]
        (one,) = one_text(timeline, 9.8).prompts
        start, end, _, parts, text = case["onetext"]
        assert record(one) == (start, end, parts, text)
        assert list(one_text(timeline, 9.8).spans(fps)[0]) == case["onetext_frames"]
        single = single_track(timeline, fps)
        lasting = [n for n, (start, end) in enumerate(case["singletrack_frames"]) if start < end]
        assert [list(span) for span in single.spans(fps)] == [case["singletrack_frames"][n] for n in lasting]
        for prompt, n in zip(single.prompts, lasting, strict=True):
            start, end, _, parts, text = case["singletrack"][n]
            assert record(prompt)[2:] == (parts, text)
            assert len(lasting) < len(case["singletrack"]) or (prompt.start, prompt.end) == (start, end)


def test_a_composition_of_flowmdm_is_a_track_of_its_texts(tmp_path):
    """As its authors' lists and instructions are: frames of HumanML3D's 20 a second, or of the rate that is said."""
    listed = [{"id": 7, "text": ["walk", "turn left"], "lengths": [57, 43], "scenario": "short"}]
    listed.append({"text": ["sit"], "lengths": [45], "fps": 30})
    (tmp_path / "list.json").write_text(json.dumps(listed))
    first, second = Timeline.read_all(tmp_path / "list.json")
    assert first.name == "7" and [prompt.text for prompt in first.prompts] == ["walk", "turn left"]
    assert first.spans(20) == ((0, 57), (57, 100)) and first.rows == (0, 0)
    assert second.spans(30) == ((0, 45),) and second.prompts[0].end == pytest.approx(1.5)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"lengths": [40]}, "text: 2 texts, but 1 lengths"),
        ({"lengths": [40, 1.5]}, "lengths[1]: 1.5 is not whole frames"),
        ({"lengths": [40, 0]}, "end"),
        ({"text": ["walk", 3]}, "text[1]: 3 is not a string"),
        ({"text": "walk"}, "text: 'walk' is not a list"),
        ({"fps": 0}, "fps: 0 is not above 0"),
        ({"tracks": []}, "unknown key 'tracks'; choose from text, lengths, id"),
    ],
)
def test_what_is_wrong_with_a_composition_is_named(changes, words):
    document = json.dumps({"text": ["walk", "sit"], "lengths": [40, 20]} | changes)
    with pytest.raises(TimelineError, match=re.escape(words)):
        Timeline.parse(document, ".json")


def test_a_repr_is_short_and_what_one_would_type():
    timeline = Timeline.parse("walk # 0 # 4\nraise # 1.25 # 3 # right arm # left arm")
    told = repr(timeline)
    prompts = "(Prompt('walk', 0, 4), Prompt('raise', 1.25, 3, ['left arm', 'right arm']))"
    assert told == f"Timeline(prompts={prompts}, name='')"
    assert eval(told, {"Timeline": Timeline, "Prompt": Prompt}) == timeline
