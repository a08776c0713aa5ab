"""Streams of the studio: they are those of the library, in turns with jobs, few, and soon over where nobody reads."""

import itertools
import json
import threading
import time
from collections.abc import Callable

import pytest
from helpers.motions import walking
from helpers.tiny_model import tiny

import stmc
from stmc.editing.stream_frames import describe_frame
from stmc.motion.body import JOINTS
from stmc.settings.records import SettingError
from stmc.text.vocabulary import Suggestion
from stmc.viewing.studio import Jobs, Motions, Streams, Turns
from stmc.viewing.studio.request_errors import RequestError
from stmc.viewing.studio.streams import IDLE_SECONDS, MOST_STREAMS, MOST_TEXT, mannequin_file

WALK = stmc.Timeline.parse("walk # 0 # 2 # legs")
PATIENCE = 60.0
"""Seconds for a thread."""


def suggest(texts) -> list[Suggestion]:
    """Everything is about the head."""
    return [Suggestion(frozenset({stmc.BodyPart.HEAD}), 1.0) for _ in texts]


def studio(clock: Callable[[], float] = time.monotonic, turns: Turns | None = None) -> Streams:
    return Streams(tiny().stream, 1, suggest, turns or Turns(), clock)


def opened(streams: Streams, timeline: stmc.Timeline | None = WALK, seed: int = 0, **settings) -> str:
    return streams.open(timeline, seed, settings)["stream"]


def add(text: str = "wave", **values) -> dict:
    return {"add": {"text": text, "seconds": 2, "body_parts": ["right arm"]} | values}


def test_the_same_seed_and_edits_give_the_frames_of_the_library():
    streams = studio()
    name = opened(streams, seed=3, clean_feet=False)
    read = streams.read(name, (), 30)["frames"] + streams.read(name, (add(),), 25)["frames"]
    library = tiny().stream(WALK, 3, steps=1, clean_feet=False)
    expected = [describe_frame(next(library)) for _ in range(30)]
    library.add(stmc.Prompt("wave", library.now, library.now + 2, ["right arm"]))
    expected += [describe_frame(next(library)) for _ in range(25)]
    assert read == expected
    assert read != studio_frames(seed=4)


def studio_frames(seed: int) -> list[dict]:
    streams = studio()
    name = opened(streams, seed=seed, clean_feet=False)
    return streams.read(name, (), 30)["frames"] + streams.read(name, (add(),), 25)["frames"]


def test_an_opened_stream_tells_its_skeleton_and_its_prompts():
    answer = studio().open(WALK, 0, {})
    assert answer["fps"] == 20 and answer["joints"] == list(JOINTS[:22]) and answer["parents"][1:4] == [0, 0, 0]
    assert answer["prompts"] == [{"number": 0, "text": "walk", "start": 0.0, "end": 2.0, "parts": ["legs"]}]
    assert studio().open(None, 0, {})["prompts"] == []


def test_edits_are_answered_in_order_and_what_is_out_is_refused_in_the_stream_s_sentence():
    streams = studio()
    name = opened(streams)
    streams.read(name, (), 20)
    edits = (add(), {"move": 1, "end": 4}, {"move": 0, "start": 0.5}, {"remove": 1}, add(start=0.9), {"jump": 1})
    answer = streams.read(name, edits, 0)
    assert answer["frames"] == [] and [each["frame"] for each in answer["answers"]] == [20] * 6
    assert answer["answers"][0] == {"added": 1, "start": 1.0, "end": 3.0, "frame": 20}
    assert answer["answers"][1]["moved"] == answer["answers"][3]["removed"] == 1
    assert "'walk' has begun at 0 s; only its end can move" in answer["answers"][2]["error"]
    assert "'wave' cannot start at 0.9 s: changes are possible from 1.00 s on" in answer["answers"][4]["error"]
    assert "one of the keys add, move, remove" in answer["answers"][5]["error"]
    assert [prompt["number"] for prompt in answer["prompts"]] == [0]


def test_body_parts_that_are_left_out_are_suggested_and_others_are_not():
    streams = studio()
    name = opened(streams, stmc.Timeline.parse("nod # 0 # 1"))
    bare = {"add": {"text": "nod", "seconds": 2}}
    answer = streams.read(name, (bare, add(), add(body_parts=[])), 0)
    assert [prompt["parts"] for prompt in answer["prompts"]] == [["head"], ["head"], ["right arm"], []]


@pytest.mark.parametrize(
    ("edit", "words"),
    [
        (add("x" * (MOST_TEXT + 1)), "1,001 letters: 1,000 at most"),
        (add(seconds=301), "seconds=301: 300 s at most"),
        (add(start=1e4), "start=10000: 300 s at most"),
        ({"move": 0, "end": 300.5}, "end=300.5: 300 s at most"),
        (add(" "), "the text is empty"),
        ({"add": {"text": " ", "seconds": 1}}, "the text is empty"),
        ({"add": {"text": 7, "seconds": 1}}, "text=7"),
        ({"add": []}, "add="),
        ({}, "one of the keys"),
    ],
    ids=str,
)
def test_an_edit_beyond_the_bounds_is_refused_in_a_sentence_and_changes_nothing(edit, words):
    streams = studio()
    answer = streams.read(opened(streams), (edit,), 0)
    assert words in answer["answers"][0]["error"] and len(answer["prompts"]) == 1


def test_a_stream_holds_as_many_prompts_as_a_timeline(monkeypatch):
    monkeypatch.setattr("stmc.viewing.studio.streams.MOST_PROMPTS", 3)
    streams = studio()
    answers = streams.read(opened(streams), (add(), add(), add()), 0)["answers"]
    assert answers[1]["added"] == 2 and "3 prompts: 3 at most" in answers[2]["error"]


def test_a_stream_ends_with_the_longest_timeline(monkeypatch):
    monkeypatch.setattr("stmc.viewing.studio.streams.MOST_SECONDS", 1)
    streams = studio()
    name = opened(streams)
    answer = [streams.read(name, (), frames) for frames in (15, 15, 15)]
    assert [(len(each["frames"]), each["ended"]) for each in answer] == [(15, False), (5, True), (0, True)]


def test_settings_are_those_of_the_library():
    with pytest.raises(SettingError, match="needs one that composes at every step"):
        opened(studio(), method="sinc")
    with pytest.raises(SettingError, match="unknown setting 'overlaps'"):
        opened(studio(), overlaps=1)


def test_of_too_many_streams_the_one_that_was_read_longest_ago_ends():
    seconds = iter(range(1000))
    streams = studio(lambda: float(next(seconds)))
    names = [opened(streams) for _ in range(MOST_STREAMS)]
    streams.read(names[0], (), 1)
    names.append(opened(streams))
    with pytest.raises(RequestError, match="no such stream"):
        streams.read(names[1], (), 1)
    assert [len(streams.read(name, (), 1)["frames"]) for name in (names[0], names[2])] == [1, 1]


def test_streams_are_independent_of_each_other():
    streams = studio()
    one, other = opened(streams, seed=1, clean_feet=False), opened(streams, seed=2, clean_feet=False)
    mixed = [streams.read(name, (), 5)["frames"] for name in (one, other) * 3]
    alone = studio()
    name = opened(alone, seed=2, clean_feet=False)
    assert [streams for read in mixed[1::2] for streams in read] == alone.read(name, (), 15)["frames"]


def test_a_stream_that_nobody_reads_ends_and_so_does_one_that_is_closed():
    now = [0.0]
    streams = studio(lambda: now[0])
    name, closed = opened(streams), opened(streams)
    streams.close(closed)
    for gone in (closed, "none"):
        with pytest.raises(RequestError, match="no such stream") as refused:
            streams.close(gone)
        assert refused.value.status == 404
    now[0] = IDLE_SECONDS
    streams.read(name, (), 0)
    now[0] = 2 * IDLE_SECONDS + 1
    with pytest.raises(RequestError, match="no such stream"):
        streams.read(name, (), 0)


def test_while_a_stream_is_read_another_request_for_it_is_refused_and_it_does_not_end():
    turns = Turns()
    streams = studio(turns=turns)
    name, read = opened(streams), []

    def wait_for_a_turn() -> None:
        while not read:
            try:
                read.append(streams.read(name, (), 1))
            except RequestError:
                continue  # the test looked whether it was read

    thread = threading.Thread(target=wait_for_a_turn)
    with turns.job():  # which samples all the while
        thread.start()
        refused = None
        patience = time.monotonic() + PATIENCE
        while refused is None and time.monotonic() < patience:
            try:
                streams.read(name, (), 0)
            except RequestError as error:
                refused = error
        assert refused is not None and refused.status == 429 and not read
        for _ in range(MOST_STREAMS):
            opened(streams)
    thread.join(PATIENCE)
    assert len(read[0]["frames"]) == 1 and len(streams.read(name, (), 1)["frames"]) == 1


def test_a_job_gives_way_between_its_steps_and_two_never_sample_at_once():
    turns, busy, order = Turns(), threading.Lock(), []

    def sample(kind: str) -> None:
        alone = busy.acquire(blocking=False)
        order.append((kind, alone))
        busy.release()

    def read() -> None:
        with turns.stream():
            sample("stream")

    thread = threading.Thread(target=read)
    with turns.job():
        thread.start()
        patience = time.monotonic() + PATIENCE
        while thread.is_alive() and time.monotonic() < patience:
            sample("step")
            turns.give_way()
        assert ("stream", True) in order
    thread.join(PATIENCE)
    assert all(alone for _, alone in order)


def test_a_stream_is_read_between_two_steps_of_a_job(tmp_path):
    turns, began, read, late = Turns(), threading.Event(), threading.Event(), []

    def sample(request, progress) -> list[stmc.Motion]:
        patience = time.monotonic() + PATIENCE
        for _ in progress(itertools.count(), total=1):
            began.set()
            late.append(time.monotonic() > patience)
            if read.is_set() or late[-1]:
                return [walking(seconds=1.0, fps=20)]

    streams, jobs = studio(turns=turns), Jobs(sample, Motions(tmp_path), turns)
    job = jobs.add(stmc.GenerateRequest.read({"timelines": "walk # 0 # 1"}))
    assert began.wait(PATIENCE)
    assert len(streams.read(opened(streams), (), 1)["frames"]) == 1
    read.set()
    jobs.wait()
    jobs.close()
    assert job.events[-1][0] == "done" and not any(late)


@pytest.mark.slow  # its skin takes a second
def test_the_mannequin_has_the_joints_of_streams():
    content = mannequin_file(stmc.Skeleton.default(), 20)
    length = int.from_bytes(content[12:16], "little")
    names = [node["name"] for node in json.loads(content[20 : 20 + length])["nodes"]]
    assert names[:22] == list(JOINTS[:22])
