"""MTT's timelines drawn anew: from the authors' prompts and seed they are those of the published file."""

from collections import Counter
from itertools import pairwise

import pytest
from conftest import data_file
from test_mtt import ATOMIC_PROMPTS, atomic_prompt

from stmc.evaluation.benchmarks.atomic_prompts import read_atomic_prompts
from stmc.evaluation.benchmarks.published_timelines import LONGEST, sample_published_timelines
from stmc.timeline import Timeline, TimelineError


@pytest.mark.parametrize("count", [60, pytest.param(500, marks=pytest.mark.slow)])
def test_the_published_timelines_are_those_of_their_prompts_and_seed(count):
    published = data_file("mtt/MTT.txt")
    atomic_prompts = read_atomic_prompts(published.parent / "texts.txt", published.parent / "motions.txt")
    drawn = sample_published_timelines(atomic_prompts, count)
    assert [each.prompts for each in drawn] == [each.prompts for each in Timeline.read_all(published)[:count]]


def test_the_third_prompt_lies_beside_one_of_the_others_and_is_of_parts_that_it_has_not():
    beside = Counter()
    for timeline in sample_published_timelines(ATOMIC_PROMPTS, 400, seed=0):
        first, second, third = timeline.prompts
        assert timeline.rows == (0, 0, 1)
        assert (first.start, first.end) == (0.0, second.start)
        assert third.text not in (first.text, second.text)
        assert max(prompt.end - prompt.start for prompt in timeline.prompts) <= LONGEST + 0.01
        met = [each for each in (first, second) if third.start < each.end - 0.01 and each.start < third.end - 0.01]
        assert not third.parts.intersection(*(each.parts for each in met))
        beside[len(met)] += 1
    assert beside[1] > 2 * beside[2] > 0


def test_a_seed_gives_the_same_timelines_and_another_seed_others():
    few, more = (sample_published_timelines(ATOMIC_PROMPTS, count, seed=3) for count in (5, 9))
    assert more[:5] == few != sample_published_timelines(ATOMIC_PROMPTS, 5, seed=4)
    assert all(one.name < other.name for one, other in pairwise(more))


@pytest.mark.parametrize(
    "atomic_prompts",
    [
        [],
        ATOMIC_PROMPTS[:1],
        [atomic_prompt("walk", "legs"), atomic_prompt("run", "legs"), atomic_prompt("hop", "legs")],
    ],
)
def test_prompts_that_cannot_go_together_are_an_error_and_no_endless_loop(atomic_prompts):
    with pytest.raises(TimelineError, match="no three of the"):
        sample_published_timelines(atomic_prompts, 1)
