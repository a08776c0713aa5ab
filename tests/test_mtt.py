"""The benchmark's construction: what the paper says of its timelines holds for any seed, and files mean one thing."""

import json
import math
from itertools import pairwise
from pathlib import Path
from statistics import mean, pstdev

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from stmc.benchmarks.atomic_prompts import (
    SHORTEST,
    AtomicPrompt,
    read_atomic_prompts,
    sample_timelines,
    write_atomic_prompts,
)
from stmc.body import BodyPart
from stmc.timeline import Timeline, TimelineError

PUBLISHED = Path(__file__).parents[1] / ".." / "shared" / "data" / "mtt"


def atom(text: str, *parts: str) -> AtomicPrompt:
    return AtomicPrompt(text, frozenset(map(BodyPart, parts)), f"clip of {text}", 0.0, 3.0)


ATOMS = [
    atom("walk", "legs"),
    atom("run", "legs"),
    atom("raise the right arm", "right arm"),
    atom("wave with both hands", "left arm", "right arm"),
    atom("bow", "head", "spine"),
]


@settings(max_examples=30)
@given(seed=st.integers(0, 2**32))
def test_every_timeline_has_two_prompts_in_a_row_and_a_third_on_body_parts_of_its_own(seed):
    for timeline in sample_timelines(ATOMS, 20, seed):
        first, second, third = timeline.prompts
        assert timeline.rows == (0, 0, 1)
        assert (first.start, first.end) == (0.0, second.start)
        assert 0 <= third.start < third.end <= second.end
        assert not third.parts & (first.parts | second.parts)
        assert first.text != second.text
        assert all(prompt.end - prompt.start >= SHORTEST - 1e-9 for prompt in timeline.prompts)


def test_durations_have_the_mean_and_the_deviation_asked_for():
    timelines = sample_timelines(ATOMS, 1000, seed=0)
    lasting = [prompt.end - prompt.start for timeline in timelines for prompt in timeline.prompts[:2]]
    assert mean(lasting) == pytest.approx(6.0, abs=5 / math.sqrt(len(lasting)))
    assert pstdev(lasting) == pytest.approx(1.0, abs=0.08)
    starts = [t.prompts[2].start / (t.duration - t.prompts[2].end + t.prompts[2].start) for t in timelines]
    assert mean(starts) == pytest.approx(0.5, abs=0.05)


def test_a_seed_gives_the_same_timelines_and_another_seed_others():
    assert (
        sample_timelines(ATOMS, 5, seed=3) == sample_timelines(ATOMS, 5, seed=3) != sample_timelines(ATOMS, 5, seed=4)
    )
    assert sample_timelines(ATOMS, 9, seed=3)[:5] == sample_timelines(ATOMS, 5, seed=3)


def test_atomic_prompts_survive_their_file(tmp_path):
    write_atomic_prompts(ATOMS, tmp_path / "prompts.json")
    assert read_atomic_prompts(tmp_path / "prompts.json") == ATOMS
    assert len((tmp_path / "prompts.json").read_text(encoding="utf-8").splitlines()) == len(ATOMS) + 2


def test_names_are_in_order_and_the_timelines_survive_their_file(tmp_path):
    timelines = sample_timelines(ATOMS, 12, seed=1)
    assert all(a.name < b.name for a, b in pairwise(timelines))
    Timeline.write_all(timelines, tmp_path / "open.json")
    assert Timeline.read_all(tmp_path / "open.json") == timelines


def test_prompts_that_cannot_go_together_are_an_error_and_no_endless_loop():
    with pytest.raises(TimelineError, match="no three of the 2"):
        sample_timelines([atom("walk", "legs"), atom("run", "legs")], 1, seed=0)


def test_atomic_prompts_are_read_from_both_forms(tmp_path):
    (tmp_path / "texts.txt").write_text("walk  forwards # legs\nbow # head # torso\n")
    (tmp_path / "motions.txt").write_text("KIT/1/walk # 0.0 # 3.5\nM/KIT/2/bow # 1 # 2\n")
    read = read_atomic_prompts(tmp_path / "texts.txt", tmp_path / "motions.txt")
    assert read == [
        AtomicPrompt("walk forwards", frozenset({BodyPart.LEGS}), "KIT/1/walk", 0.0, 3.5),
        AtomicPrompt("bow", frozenset({BodyPart.HEAD, BodyPart.SPINE}), "M/KIT/2/bow", 1.0, 2.0),
    ]
    rows = [
        {"text": a.text, "body_parts": sorted(a.parts), "clip": a.clip, "start": a.start, "end": a.end} for a in read
    ]
    (tmp_path / "prompts.json").write_text(json.dumps(rows))
    assert read_atomic_prompts(tmp_path / "prompts.json") == read


@pytest.mark.parametrize(
    ("texts", "motions", "message"),
    [
        ("walk # legs\nrun # legs", "a # 0 # 1", "2 texts.*1 motions"),
        ("walk # legs", "a # 0", r"motions\.txt, line 1: a motion is written clip # start # end"),
        ("walk # legs", "a # 1 # 1", r"texts\.txt, line 1.*later than start"),
        ("walk # legs", "a # zero # 1", r"texts\.txt, line 1.*zero"),
        ("walk # tail", "a # 0 # 1", "unknown body part 'tail'"),
        ("walk # legs\nwalk # spine", "a # 0 # 1\nb # 0 # 1", "'walk' is duplicated"),
    ],
)
def test_atomic_prompts_that_cannot_be_meant_are_errors_with_their_place(texts, motions, message, tmp_path):
    (tmp_path / "texts.txt").write_text(texts)
    (tmp_path / "motions.txt").write_text(motions)
    with pytest.raises(TimelineError, match=message):
        read_atomic_prompts(tmp_path / "texts.txt", tmp_path / "motions.txt")


@pytest.mark.parametrize("document", ["{", "{}", '[{"text": "walk"}]', "[3]"])
def test_json_that_is_no_list_of_prompts_is_an_error_with_its_place(document, tmp_path):
    (tmp_path / "prompts.json").write_text(document)
    with pytest.raises(TimelineError, match=r"prompts\.json"):
        read_atomic_prompts(tmp_path / "prompts.json")


@pytest.mark.skipif(not PUBLISHED.exists(), reason="the published MTT files are not at ../shared/data/mtt")
def test_the_published_prompts_are_those_of_the_published_timelines():
    atoms = {atom.text: atom for atom in read_atomic_prompts(PUBLISHED / "texts.txt", PUBLISHED / "motions.txt")}
    assert len(atoms) == 60
    for timeline in Timeline.read_all(PUBLISHED / "MTT.txt"):
        for prompt in timeline.prompts:
            assert prompt.parts == atoms[prompt.text].parts
