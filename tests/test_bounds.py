"""What a timeline may ask for: limits that are named, sorting instead of all pairs, files that cannot be read."""

import json
import math
import os
import random
import sys
import warnings
from itertools import pairwise

import pytest
from helpers.strategies import quietly

from stmc.motion.body import BodyPart
from stmc.timeline import (
    Prompt,
    Timeline,
    TimelineError,
    TimelineWarning,
    baseline_timelines,
    one_text,
    prompts,
    single_track,
    timeline_files,
)
from stmc.timeline.planning import assign, plan
from stmc.timeline.planning.plans import _Widening
from stmc.timeline.rows import crowded, first_fit

HOUR = 3600


def refusal(call, *given) -> str:
    with pytest.raises(TimelineError) as caught:
        call(*given)
    assert len(str(caught.value)) < 500
    return str(caught.value)


def in_a_row(count: int, seconds: float = 1.0) -> str:
    return "".join(f"walk # {seconds * number} # {seconds * (number + 1)} # legs\n" for number in range(count))


# Limits


@pytest.mark.parametrize("line", ["walk # 0 # 1e10", "walk # 0 # 1e308", "walk # 1e6 # 1000001", "walk # 0 # 14400.1"])
def test_a_prompt_that_ends_too_late_is_refused_with_its_line_and_the_limit(line):
    message = refusal(Timeline.parse, f"sit # 0 # 1\n{line}")
    assert message.startswith("line 2: end ")
    assert message.endswith("is later than 14400 seconds, the limit")


@pytest.mark.parametrize("fps", [1e5, 1e300, 10**400])
@pytest.mark.parametrize("ask", [Timeline.spans, Timeline.frames, assign, lambda t, fps: plan(t, fps, 10, 200)])
def test_too_many_frames_are_refused_before_they_are_counted(ask, fps):
    timeline = Timeline([Prompt("walk", 0, HOUR)], "film")
    assert refusal(ask, timeline, fps).startswith("timeline 'film', prompt 1: 3600 s at ")
    assert "more than 10,000,000 frames, the limit" in refusal(ask, timeline, fps)


def test_an_hour_and_several_thousand_prompts_are_read_and_planned():
    timeline = Timeline.parse(in_a_row(3000, 1.25) + "talk # 0 # 3750 # head\n")
    assert timeline.rows == (0,) * 3000 + (1,)
    ours = plan(timeline, 20, 10, 200)
    assert ours.frames == 75_000
    assert sum(crop.text == "walk" for crop in ours.crops) == 3000
    assert str(timeline).startswith("timeline: 3750 s, 3001 prompts")


def test_too_many_prompts_are_refused(monkeypatch):
    monkeypatch.setattr(prompts, "MOST_PROMPTS", 3)
    assert len(Timeline.parse(in_a_row(3)).prompts) == 3
    assert refusal(Timeline.parse, in_a_row(4)) == "line 4: a timeline of 4 prompts; the limit is 3"
    monkeypatch.setattr(timeline_files, "MOST_PROMPTS_IN_FILE", 3)
    assert "line 5: more than 3 prompts in one document" in refusal(Timeline.parse_all, f"{in_a_row(3)}\n{in_a_row(1)}")


def test_a_text_that_is_too_long_is_refused():
    assert "longer than 1,000,000 characters" in refusal(Prompt, "a" * 1_000_001, 0, 1)
    assert len(Prompt("a" * 1_000_000, 0, 1).text) == 1_000_000


@quietly
def test_a_single_track_of_too_many_characters_is_refused(monkeypatch):
    timeline = Timeline([Prompt("a" * 100, 0.1 * start, 9) for start in range(40)])
    assert len(single_track(timeline, 20).prompts) == 40
    monkeypatch.setattr(baseline_timelines, "MOST_CHARACTERS", 50_000)
    assert "more than 50,000 characters as a single track" in refusal(single_track, timeline, 20)


@pytest.mark.parametrize("name", ["t.txt", "t.json"])
def test_a_file_that_is_too_large_is_refused_unread(tmp_path, name):
    with (tmp_path / name).open("wb") as file:
        file.truncate(2**40)
    assert refusal(Timeline.read, tmp_path / name).endswith("larger than 8 MiB, the limit for such a file")


# The same as before, in less time


def split_by_trying(window: _Widening, start: int, end: int) -> list[tuple[int, int]]:
    """Every number of pieces from the fewest that could do."""
    for pieces in range(math.ceil((end - start) / window.longest), end - start + 1):
        spans = list(pairwise(start + (end - start) * piece // pieces for piece in range(pieces + 1)))
        if all(right - left <= window.longest for left, right in (window.widen(*span) for span in spans)):
            return spans
    raise AssertionError


def test_long_prompts_are_split_as_if_every_number_of_pieces_were_tried():
    rng = random.Random(0)
    for _ in range(500):
        frames = rng.randint(1, 300)
        start, end = sorted(rng.sample(range(frames + 1), 2))
        overlap = rng.choice((0, 1, 2, 3, 10, 25))
        window = _Widening((0, frames), overlap, min(overlap, frames - 1) + rng.randint(1, rng.choice((3, 20, 300))))
        assert window.split(start, end) == split_by_trying(window, start, end), (window, start, end)


def test_tracks_are_those_that_comparing_all_pairs_finds():
    rng = random.Random(0)
    for _ in range(300):
        spans = [tuple(map(float, sorted(rng.sample(range(20), 2)))) for _ in range(rng.randint(1, 12))]

        def together(one: int, other: int, spans=spans) -> bool:
            return spans[one][0] < spans[other][1] and spans[other][0] < spans[one][1]

        rows: list[int] = []
        for later in range(len(spans)):
            taken = {rows[earlier] for earlier in range(later) if together(earlier, later)}
            rows.append(next(row for row in range(len(spans)) if row not in taken))
        assert first_fit(spans) == tuple(rows)
        assert crowded(spans, rows) is None
        given = [rng.randint(0, 3) for _ in spans]
        pairs = [(b, a) for b in range(len(spans)) for a in range(b) if given[a] == given[b] and together(a, b)]
        assert crowded(spans, given) == next(iter(pairs), None)


def test_hundreds_of_prompts_at_once_give_one_short_warning_at_the_line_of_the_caller():
    document = "".join(f"walk {n} # {n / 10} # {200 + n / 10} # legs # head\n" for n in range(800))
    with pytest.warns(TimelineWarning) as told:
        timeline = Timeline.parse(document)
    [warning] = told
    assert warning.filename == __file__
    lines = str(warning.message).splitlines()
    assert lines[0].endswith("(line 2) both claim legs, head at 0.1 s; 'walk 1' (line 2) gets it")
    assert lines[3:] == ["these are 3 of more than 50 such pairs"]
    owners = assign(timeline, 10)
    assert owners[BodyPart.LEGS][:2] == ((0, 0, 1), (1, 1, 2))
    assert owners[BodyPart.LEGS][-1] == (799, 799, 2799)
    with pytest.warns(TimelineWarning, match="lasts no frame at 0.5 fps and is left out, and 1 more") as told:
        assign(Timeline([Prompt("a", 0, 9, "legs"), Prompt("b", 2, 3, "head"), Prompt("c", 4, 5, "head")]), 0.5)
    assert [warning.filename for warning in told] == [__file__]


# Files


@pytest.mark.skipif(sys.platform == "win32", reason="links and pipes")
@pytest.mark.parametrize("suffix", [".txt", ".json"])
def test_only_regular_files_are_read(tmp_path, suffix):
    os.mkfifo(tmp_path / f"pipe{suffix}")
    (tmp_path / f"folder{suffix}").mkdir()
    (tmp_path / f"loop{suffix}").symlink_to(f"loop{suffix}")
    for name, words in {"pipe": "a pipe or a device", "folder": "a directory", "loop": "not a path"}.items():
        assert words in refusal(Timeline.read, tmp_path / f"{name}{suffix}")
    assert r"/a\x00." in refusal(Timeline.read_all, f"{tmp_path}/a\0{suffix}")
    assert "not a path to a file" in refusal(Timeline.read_all, tmp_path / f"{'a' * 5000}{suffix}")


def test_a_key_that_stands_twice_is_refused(tmp_path):
    (tmp_path / "t.json").write_text('{"tracks": [[{"text": "sit", "start": 0, "end": 1, "end": 2}]]}')
    assert "the key 'end' is duplicated" in refusal(Timeline.read, tmp_path / "t.json")


@pytest.mark.parametrize("long", ["a", "\x00", "\u202e", "#"])
def test_messages_are_short_however_long_the_line_or_the_value(long, tmp_path):
    many = long * 100_000
    for line in (many, f"{many} # 0", f"sit # {many} # 1", f"sit # 0 # 1 # {many}", f"{many} # 2 # 1"):
        assert refusal(Timeline.parse, line).startswith("line 1: ")
    prompt = {"text": "sit", "start": 0, "end": 1}
    for change in ({many: 1}, {"text": [many]}, {"start": many}, {"body_parts": [many]}, {"body_parts": many}):
        (tmp_path / "t.json").write_text(json.dumps({"tracks": [[prompt | change]]}))
        assert "tracks[0][0]" in refusal(Timeline.read, tmp_path / "t.json")
    twice = [{"text": many, "start": 0, "end": 1}] * 2
    (tmp_path / "t.json").write_text(json.dumps({"tracks": [twice]}))
    refusal(Timeline.read, tmp_path / "t.json")


def test_lone_surrogates_are_refused_in_texts_and_names(tmp_path):
    assert r"the text 'walk \ud800' has a lone surrogate, '\ud800'" in refusal(Prompt, "walk \ud800", 0, 1)
    (tmp_path / "t.json").write_text(r'{"tracks": [[{"text": "walk \ud800", "start": 0, "end": 1}]]}')
    assert "tracks[0][0]: the text" in refusal(Timeline.read, tmp_path / "t.json")
    assert "the name '\\udfff' has" in refusal(Timeline, [Prompt("sit", 0, 1)], "\udfff")


@pytest.mark.parametrize("text", ["\ufeff", "\ufeffwalk", "\ufeff\ufeff walk", "wa\ufefflk", "walk 🚶"])
def test_a_text_that_begins_with_a_byte_order_mark_is_written_and_read_back(text, tmp_path):
    timelines = [Timeline([Prompt(text, 0, 1)]), Timeline([Prompt(text, 0, 1)])]
    for name in ("t.txt", "t.json"):
        Timeline.write_all(timelines, tmp_path / name)
        assert Timeline.read_all(tmp_path / name) == timelines


def test_what_planning_refuses_names_the_timeline(tmp_path):
    (tmp_path / "t.txt").write_text("sit # 0 # 1\n\nwalk # 0 # 0.01\n")
    _, moment = Timeline.read_all(tmp_path / "t.txt")
    assert refusal(plan, moment, 20, 10) == (
        f"{tmp_path / 't.txt'}, line 3: the timeline's 0.01 s are less than a frame at 20 fps; make it longer"
    )
    assert refusal(assign, Timeline([Prompt("a", 0, 0.01)], "0042"), 20).startswith("timeline '0042', prompt 1: ")


def test_one_text_of_hundreds_of_prompts_is_a_text():
    assert len(one_text(Timeline.parse(in_a_row(500)), 10).prompts) == 1


# Fuzz

SEEDS = (
    "walk forwards # 0 # 6 # legs\nraise the right arm # 2 # 5.5 # right arm # torso\n\nsit # 0.1 # 3\n",
    '{"name": "a", "tracks": [[{"text": "walk", "start": 0, "end": 4.2, "body_parts": ["legs"]}, {"text": "sit", '
    '"start": 5, "end": 6}], [{"text": "wave", "start": 1, "end": 3, "body_parts": ["left arm", "head"]}]]}',
)
TOKENS = (
    *("#", "\n", "\n\n", "legs", "head", "0", "1e308", "-1", "nan", "inf", "1e-300", "0.01", "14400", "99999999999999"),
    *("\ufeff", "\x00", "\u2028", "\ud83d", "\\ud800", '"', "{", "}", "[", "]", ",", ":", "null", "true", '"end": 2'),
    *('"text"', '"tracks"', "1" * 5000, "[" * 2000, "a" * 3000, "# 0 # 1\n" * 50, "\u202e", "🚶", " " * 100),
)


def mutated(rng: random.Random, document: str) -> bytes:
    for _ in range(rng.choice((0, 1, 1, 1, 2, 5))):
        start = rng.randint(0, len(document))
        end = min(len(document), start + rng.choice((0, 0, 1, 3, 20)))
        piece = rng.choice((rng.choice(TOKENS), document[rng.randint(0, len(document)) :][: rng.randint(0, 30)]))
        document = document[:start] + piece + document[end:]
    content = bytearray(document.encode("utf-8", "surrogatepass"))
    for _ in range(rng.choice((0, 0, 0, 0, 1))):
        content[rng.randrange(len(content))] = rng.randrange(256)
    return bytes(content)


def read_plan_and_write(path, rng: random.Random) -> None:
    timelines = Timeline.read_all(path)
    for timeline in timelines:
        frames = plan(timeline, 20, rng.choice((0, 10, 11)), 200).frames
        assert frames == timeline.frames(20)
    for suffix in (".txt", ".json"):
        Timeline.write_all(timelines, path.with_name(f"back{suffix}"))
        back = Timeline.read_all(path.with_name(f"back{suffix}"))
        assert [timeline.prompts for timeline in back] == [timeline.prompts for timeline in timelines]


def fuzzed(folder, count: int, seed: int) -> int:
    """How many of `count` mutated files are timelines; the others end in a short `TimelineError`."""
    rng, whole = random.Random(seed), 0
    for number in range(count):
        suffix, document = ((".txt", SEEDS[0]), (".json", SEEDS[1]))[number % 2]
        path = folder / f"t{suffix}"
        path.write_bytes(mutated(rng, document))
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", TimelineWarning)
                read_plan_and_write(path, rng)
            whole += 1
        except TimelineError as error:
            assert len(str(error).replace(str(folder), "")) < 500, path.read_bytes()
    return whole


def test_mutated_timelines_are_read_or_refused_in_a_sentence(tmp_path):
    assert fuzzed(tmp_path, 200, seed=1) > 10


@pytest.mark.slow
def test_twenty_thousand_mutated_timelines_are_read_or_refused_in_a_sentence(tmp_path):
    assert fuzzed(tmp_path, 20_000, seed=2) > 1000


def test_every_part_has_an_owner_after_any_mutation_of_what_is_listed():
    rng = random.Random(3)
    spans = [tuple(sorted(rng.sample(range(40), 2))) for _ in range(300)]
    listed = [rng.sample(list(BodyPart), rng.randint(0, 5)) for _ in spans]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", TimelineWarning)
        timeline = Timeline([Prompt("a", *span, parts) for span, parts in zip(spans, listed, strict=True)])
    for part, runs in assign(timeline, 1).items():
        for owner, start, end in runs:
            for frame in range(start, end):
                assert owner == by_the_rule(timeline, part, frame)


def by_the_rule(timeline: Timeline, part: BodyPart, frame: int) -> int | None:
    """SINC's order written down: the base, then fewer and fewer parts, each overriding those before it."""
    given = timeline.prompts
    active = [n for n, prompt in enumerate(given) if prompt.start <= frame < prompt.end]
    if not active:
        return None
    ranked = sorted(active, key=lambda n: -len(given[n].claims))
    base = next((n for n in ranked if BodyPart.LEGS in given[n].claims), ranked[0])
    return [base, *(n for n in ranked if n != base and part in given[n].claims)][-1]
