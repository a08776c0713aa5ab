"""The benchmark's construction: what the paper says of its timelines holds for any seed, and files mean one thing."""

import json
import math
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from statistics import mean, pstdev

import numpy as np
import pytest
from conftest import data_file
from hypothesis import given
from hypothesis import strategies as st

from stmc.evaluation.benchmarks.atomic_prompts import (
    LONGEST,
    SHORTEST,
    AtomicPrompt,
    read_atomic_prompts,
    sample_timelines,
    write_atomic_prompts,
)
from stmc.motion.body import BodyPart
from stmc.timeline import Timeline, TimelineError


def published(name: str) -> Path:
    """One of the authors' files, or a skip."""
    return data_file(f"mtt/{name}")


def atomic_prompt(text: str, *parts: str) -> AtomicPrompt:
    return AtomicPrompt(text, frozenset(map(BodyPart, parts)), f"clip of {text}", 0.0, 3.0)


ATOMIC_PROMPTS = [
    atomic_prompt("walk", "legs"),
    atomic_prompt("run", "legs"),
    atomic_prompt("raise the right arm", "right arm"),
    atomic_prompt("wave with both hands", "left arm", "right arm"),
    atomic_prompt("bow", "head", "spine"),
]


def sampled(prompts: list[AtomicPrompt], count: int, seed: int) -> list[Timeline]:
    return sample_timelines(prompts, count, np.random.default_rng(seed))


@given(seed=st.integers(0, 2**32))
def test_every_timeline_has_two_prompts_in_a_row_and_a_third_on_parts_that_those_it_overlaps_leave_free(seed):
    for timeline in sampled(ATOMIC_PROMPTS, 20, seed):
        first, second, third = timeline.prompts
        assert timeline.rows == (0, 0, 1)
        assert (first.start, first.end) == (0.0, second.start)
        assert 0 <= third.start < third.end <= second.end
        overlapped = [each for each in (first, second) if third.start < each.end and third.end > each.start]
        assert not third.parts & frozenset().union(*(each.parts for each in overlapped))
        if len(overlapped) == 1:
            assert overlapped[0].start <= third.start and third.end <= overlapped[0].end
        assert all(SHORTEST - 1e-9 <= prompt.end - prompt.start <= LONGEST + 1e-9 for prompt in timeline.prompts)


def test_a_prompt_is_asked_for_no_shorter_and_no_longer_than_its_own_range_says():
    jump = replace(atomic_prompt("jump", "legs"), shortest=3.0, longest=4.0)
    timelines = sampled([jump, *ATOMIC_PROMPTS], 200, seed=0)
    asked = [prompt for timeline in timelines for prompt in timeline.prompts if prompt.text == "jump"]
    lasting = [round(prompt.end - prompt.start, 2) for prompt in asked]
    assert len(lasting) > 50 and min(lasting) >= 3.0 and max(lasting) == 4.0


def statistics(timelines: list[Timeline]) -> dict[str, tuple[float, float]]:
    """What a set of timelines is like, and the standard error of each number: of shares binomial, of durations from
    their own scatter (of a deviation, that of normal numbers)."""
    first, second, third = zip(*(timeline.prompts for timeline in timelines), strict=True)
    pairs = list(zip(first, second, third, strict=True))
    straddling = [c.start < a.end and c.end > b.start for a, b, c in pairs]
    overlaps = [c.start < each.end and c.end > each.start for a, b, c in pairs for each in (a, b)]
    found = {
        "straddles both": share(straddling),
        "a text overlaps another": share([*overlaps, *[True] * len(timelines)]),
        "legs on track 1": share([BodyPart.LEGS in each.parts for each in (*first, *second)]),
        "legs on track 2": share([BodyPart.LEGS in each.parts for each in third]),
        "one part on track 2": share([len(each.parts) == 1 for each in third]),
    }
    for track, prompts in (("1", (*first, *second)), ("2", third)):
        lasting = [prompt.end - prompt.start for prompt in prompts]
        found[f"mean duration on track {track}"] = mean(lasting), pstdev(lasting) / math.sqrt(len(lasting))
        found[f"deviation on track {track}"] = pstdev(lasting), pstdev(lasting) / math.sqrt(2 * len(lasting))
    return found


def share(answers: list[bool]) -> tuple[float, float]:
    p = mean(answers)
    return p, math.sqrt(p * (1 - p) / len(answers))


@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.slow) for seed in (1, 2, 3))])
def test_timelines_of_the_papers_own_prompts_are_like_the_published_ones(seed):
    """Both are samples of 500: each number may differ by 4 standard errors of the difference (the chance that one of
    these 36 comparisons of like samples does is 0.2 %), such as 10 points where the share that straddles is 18 %."""
    theirs = statistics(Timeline.read_all(published("MTT.txt")))
    drawn = sampled(read_atomic_prompts(published("texts.txt"), published("motions.txt")), 500, seed)
    assert all(len(timeline.prompts) == 3 for timeline in drawn)
    for name, (value, error) in statistics(drawn).items():
        expected, other = theirs[name]
        assert value == pytest.approx(expected, abs=4 * math.hypot(error, other)), name


def test_legs_are_drawn_three_times_as_often_as_an_arm_where_nothing_is_drawn_again():
    """Two prompts that go together at all times and of equal ranges: what is drawn again does not depend on which."""
    timelines = sampled(
        [atomic_prompt("walk", "legs"), atomic_prompt("raise the right arm", "right arm")], 1000, seed=0
    )
    told = [prompt.text for timeline in timelines for prompt in timeline.prompts[:2]]
    assert mean(text == "walk" for text in told) == pytest.approx(3 / 4, abs=0.05)


def test_a_seed_gives_the_same_timelines_and_another_seed_others():
    assert (
        sampled(ATOMIC_PROMPTS, 5, seed=3) == sampled(ATOMIC_PROMPTS, 5, seed=3) != sampled(ATOMIC_PROMPTS, 5, seed=4)
    )
    assert sampled(ATOMIC_PROMPTS, 9, seed=3)[:5] == sampled(ATOMIC_PROMPTS, 5, seed=3)


def test_atomic_prompts_survive_their_file(tmp_path):
    write_atomic_prompts(ATOMIC_PROMPTS, tmp_path / "prompts.json")
    assert read_atomic_prompts(tmp_path / "prompts.json") == ATOMIC_PROMPTS
    assert len((tmp_path / "prompts.json").read_text(encoding="utf-8").splitlines()) == len(ATOMIC_PROMPTS) + 2


def test_names_are_in_order_and_the_timelines_survive_their_file(tmp_path):
    timelines = sampled(ATOMIC_PROMPTS, 12, seed=1)
    assert all(a.name < b.name for a, b in pairwise(timelines))
    Timeline.write_all(timelines, tmp_path / "open.json")
    assert Timeline.read_all(tmp_path / "open.json") == timelines


def test_prompts_that_cannot_go_together_are_an_error_and_no_endless_loop():
    with pytest.raises(TimelineError, match="no two of the 2"):
        sampled([atomic_prompt("walk", "legs"), atomic_prompt("run", "legs")], 1, seed=0)
    brief = [
        replace(atomic_prompt(text, part), shortest=3.0, longest=2.5)
        for text, part in (("nod", "head"), ("step", "legs"))
    ]
    with pytest.raises(TimelineError, match="no two of the 2"):
        sampled(brief, 1, seed=0)


def test_atomic_prompts_are_read_from_both_forms(tmp_path):
    (tmp_path / "texts.txt").write_text("walk  forwards # legs\nbow # head # torso\n")
    (tmp_path / "motions.txt").write_text("KIT/1/walk # 0.0 # 3.5\nM/KIT/2/bow # 1 # 2\n")
    read = read_atomic_prompts(tmp_path / "texts.txt", tmp_path / "motions.txt")
    assert read == [
        AtomicPrompt("walk forwards", frozenset({BodyPart.LEGS}), "KIT/1/walk", 0.0, 3.5),
        AtomicPrompt("bow", frozenset({BodyPart.HEAD, BodyPart.SPINE}), "M/KIT/2/bow", 1.0, 2.0),
    ]
    rows = [row(a) for a in read]
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


def row(a: AtomicPrompt) -> dict:
    """As a file has it."""
    described = {"text": a.text, "body_parts": sorted(a.parts), "clip": a.clip, "start": a.start, "end": a.end}
    return described | {"shortest": a.shortest, "longest": a.longest, "cyclic": a.cyclic}


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"shortest": 5.0, "longest": 4.0}, r"\[0\]: shortest \(5\.0\) must be above 0 and at most longest \(4\.0\)"),
        ({"shortest": 0}, r"\[0\]: shortest \(0\)"),
        ({"longest": "9"}, r"\[0\]: shortest and longest must be seconds"),
        ({"cyclic": 1}, r"\[0\]: .* cyclic must be true or false"),
    ],
)
def test_a_range_that_cannot_be_meant_is_an_error_with_its_place(changed, message, tmp_path):
    (tmp_path / "prompts.json").write_text(json.dumps([row(ATOMIC_PROMPTS[0]) | changed]))
    with pytest.raises(TimelineError, match=message):
        read_atomic_prompts(tmp_path / "prompts.json")


@pytest.mark.parametrize("document", ["{", "{}", '[{"text": "walk"}]', "[3]"])
def test_json_that_is_no_list_of_prompts_is_an_error_with_its_place(document, tmp_path):
    (tmp_path / "prompts.json").write_text(document)
    with pytest.raises(TimelineError, match=r"prompts\.json"):
        read_atomic_prompts(tmp_path / "prompts.json")


def test_the_published_prompts_are_those_of_the_published_timelines():
    atomic_prompts = {
        prompt.text: prompt for prompt in read_atomic_prompts(published("texts.txt"), published("motions.txt"))
    }
    assert len(atomic_prompts) == 60
    for timeline in Timeline.read_all(published("MTT.txt")):
        for prompt in timeline.prompts:
            assert prompt.parts == atomic_prompts[prompt.text].parts
