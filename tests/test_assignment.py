"""Who owns each body part at every frame: against a frame-by-frame oracle, and the R2 and R3 decisions."""

import warnings
from itertools import pairwise

import pytest
from helpers.strategies import quietly, timelines
from hypothesis import given
from hypothesis import strategies as st

from stmc.motion.body import BodyPart
from stmc.timeline import Prompt, Timeline, TimelineError, TimelineWarning
from stmc.timeline.planning import assign

LEFT, RIGHT, LEGS, HEAD, SPINE = BodyPart


def owner(timeline: Timeline, fps: float, part: BodyPart, frame: int) -> int | None:
    """Appendix B read for one part at one frame: among the claimants the smallest, then the latest; else the base."""
    spans = [(int(fps * prompt.start), int(fps * prompt.end)) for prompt in timeline.prompts]
    active = [index for index, (start, end) in enumerate(spans) if start <= frame < end]
    if not active:
        return None
    size = {index: len(timeline.prompts[index].claims) for index in active}
    legs = [index for index in active if LEGS in timeline.prompts[index].claims]
    base = max(legs or active, key=lambda index: (size[index], -index))
    claimants = [index for index in active if index != base and part in timeline.prompts[index].claims]
    return min(claimants, key=lambda index: (size[index], -index), default=base)


@quietly
@given(timelines(), st.sampled_from((20, 30, 12.5)))
def test_each_frame_of_each_part_has_the_owner_of_appendix_b(timeline, fps):
    owners = assign(timeline, fps)
    assert list(owners) == list(BodyPart)
    for part, runs in owners.items():
        found = [run[0] for run in runs for _ in range(run[1], run[2])]
        assert found == [owner(timeline, fps, part, frame) for frame in range(timeline.frames(fps))]


@quietly
@given(timelines())
def test_runs_cover_the_timeline_in_order_and_neighbours_differ(timeline):
    for runs in assign(timeline, 20).values():
        assert runs[0][1] == 0
        assert runs[-1][2] == timeline.frames(20)
        assert all(start < end for _, start, end in runs)
        for (before, _, end), (after, start, _) in pairwise(runs):
            assert end == start
            assert before != after


def test_a_walk_with_a_raised_arm():
    owners = assign(Timeline([Prompt("walk", 0, 6, {"legs"}), Prompt("raise", 2, 5, {"right arm"})]), fps=20)
    assert owners[LEGS] == owners[HEAD] == owners[SPINE] == owners[LEFT] == ((0, 0, 120),)
    assert owners[RIGHT] == ((0, 0, 40), (1, 40, 100), (0, 100, 120))


def test_a_tie_falls_to_the_order_of_the_file():
    prompts = [Prompt("a", 0, 1, {"right arm"}), Prompt("b", 0, 1, {"left arm"})]
    for _ in range(5):
        owners = assign(Timeline(prompts), 20)
        assert owners[LEGS] == owners[RIGHT] == ((0, 0, 20),)
        assert owners[LEFT] == ((1, 0, 20),)
    assert assign(Timeline(prompts[::-1]), 20)[LEGS] == ((0, 0, 20),)


def test_a_moment_without_prompts_belongs_to_nobody():
    owners = assign(Timeline([Prompt("walk", 1, 2, {"legs"}), Prompt("sit", 3, 4, {"legs"})]), 10)
    assert owners == dict.fromkeys(BodyPart, ((None, 0, 10), (0, 10, 20), (None, 20, 30), (1, 30, 40)))


@quietly
def test_an_edge_that_moves_no_part_divides_nothing():
    prompts = [Prompt("all", 0, 5), Prompt("legs", 0, 5, {"legs"}), Prompt("legs too", 1, 4, {"legs"})]
    owners = assign(Timeline(prompts), 10)
    assert owners[HEAD] == ((0, 0, 50),)
    assert owners[LEGS] == ((1, 0, 10), (2, 10, 40), (1, 40, 50))


def test_a_prompt_without_parts_yields_to_one_that_lists_some():
    owners = assign(Timeline([Prompt("wave", 0, 1, {"right arm"}), Prompt("walk", 0, 1)]), 20)
    assert {part: runs[0][0] for part, runs in owners.items()} == {LEFT: 1, RIGHT: 0, LEGS: 1, HEAD: 1, SPINE: 1}


def test_a_prompt_of_no_frames_is_left_out_with_a_warning():
    with pytest.warns(TimelineWarning, match=r"'blink' \(0.51 to 0.52 s\) lasts no frame at 20 fps and is left out"):
        owners = assign(Timeline([Prompt("walk", 0, 1, {"legs"}), Prompt("blink", 0.51, 0.52, {"head"})]), 20)
    assert owners == dict.fromkeys(BodyPart, ((0, 0, 20),))


def test_a_timeline_of_no_frames_is_refused():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        with pytest.raises(TimelineError, match=r"the timeline's 0.04 s are less than a frame at 20 fps"):
            assign(Timeline([Prompt("walk", 0, 0.04)]), 20)
