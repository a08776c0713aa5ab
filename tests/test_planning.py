"""Plans: parity with the published code, the invariant on random timelines, long prompts, and what is not planned."""

import re

import numpy as np
import pytest
from conftest import checked, golden, golden_sets
from helpers.appendix_b import by_the_rules
from helpers.strategies import quietly, timelines
from hypothesis import example, given
from hypothesis import strategies as st

from stmc.motion.body import BodyPart
from stmc.timeline import Prompt, Timeline, TimelineError
from stmc.timeline.planning import Crop, Plan, Tile, plan

# What the published code answers, and ours in the same form


def published(result: dict, overlap: int) -> tuple:
    """Length, crops and tiles by part, without the rows that no body part uses and without empty transitions."""
    count = len(result["crops"])
    used = sorted({row for runs in result["bp_info"] for row, *_ in runs})
    transitions = result["trans"] if overlap else []
    row_of = {row: n for n, row in enumerate([*used, *range(count, count + len(transitions))])}
    crops = [result["crops"][row] for row in used] + transitions
    return result["max_t"], crops, renumbered(result["bp_info"], row_of), renumbered(result["bp_trans"], row_of)


def renumbered(tiles: list, row_of: dict) -> list:
    return [[[row_of[row], *span] for row, *span in runs if span[0] < span[1]] for runs in tiles]


def in_published_form(ours: Plan) -> tuple:
    def tiles(weight: int) -> list:
        chosen = [tile for tile in ours.tiles if tile.weight == weight]
        return [[placed(ours, tile) for tile in chosen if tile.part == part] for part in BodyPart]

    return ours.frames, [[crop.start, crop.end] for crop in ours.crops], tiles(1), tiles(-1)


def placed(ours: Plan, tile: Tile) -> list[int]:
    offset = ours.crops[tile.crop].start
    return [tile.crop, tile.start, tile.end, tile.start - offset, tile.end - offset]


def in_frames(prompts: list) -> Timeline:
    """A timeline of one frame a second; half a second makes a prompt that has no frame and is legal."""
    made = [Prompt(f"{n}", a, b + 0.5 * (a == b), parts) for n, (a, b, parts) in enumerate(prompts)]
    return Timeline(made)


def assert_published(prompts: list, overlap: int, results: list) -> bool:
    """Ours is one of the published outcomes, the one whose ties fall to the file's order. Whether there is such a plan:
    where the published code has an exception for that order, ours is at least a plan (it has checked)."""
    outcomes = [result.get("error") or published(result, overlap) for result in results]
    ours = in_published_form(plan(in_frames(prompts), 1, overlap))
    expected = by_the_rules(prompts, overlap)
    assert expected in outcomes
    assert ours == expected or isinstance(expected, str)
    return not isinstance(expected, str)


def plans_of_the_published_timelines_are_the_published_ones(folder, every):
    expected = golden(folder, "mtt_plans.json.gz")
    for case in expected["timelines"][::every]:
        parts = [parts for _, _, parts in case["prompts"]]
        prompts = [Prompt("x", *span, listed) for span, listed in zip(case["prompts_s"], parts, strict=True)]
        timeline = Timeline(prompts).shifted()
        assert [list(span) for span in timeline.spans(expected["fps"])] == [prompt[:2] for prompt in case["prompts"]]
        for overlap in map(str, expected["overlaps"]):
            outcomes = [published(variant | variant["ov"][overlap], int(overlap)) for variant in case["variants"]]
            assert in_published_form(plan(timeline, expected["fps"], int(overlap))) in outcomes
        selected = in_published_form(plan(timeline, expected["fps"], 0))[2]
        assert selected in [variant["noext_bp_info"] for variant in case["variants"]]


def plans_of_random_timelines_are_admissible_to_the_published_code(folder, every):
    cases = golden(folder, "fuzz_plans.json.gz")["cases"][::every]
    planned = [assert_published(case["prompts"], case["overlap"], case["results"]) for case in cases]
    for case, has_plan in zip(cases, planned, strict=True):
        if has_plan:
            assert_selected(case["prompts"], case["results"])
    never = sum(all("error" in result for result in case["results"]) for case in cases)
    sometimes = sum(any("error" in result for result in case["results"]) for case in cases)
    assert never <= planned.count(False) <= sometimes < len(cases) / 2


@pytest.mark.golden
@quietly
@pytest.mark.parametrize("every", [5, pytest.param(1, marks=pytest.mark.slow)])
@pytest.mark.parametrize("folder", golden_sets("stmc"))
def test_plans_are_the_published_ones(folder, every, subtests):
    checked(
        subtests,
        [
            plans_of_the_published_timelines_are_the_published_ones,
            plans_of_random_timelines_are_admissible_to_the_published_code,
        ],
        folder,
        every,
    )


def assert_selected(prompts: list, results: list) -> None:
    """The same for plans without overlap, by the spans alone: row numbers differ where a prompt is not planned."""
    outcomes = [spans_by_part(result["noext_bp_info"]) for result in results if "error" not in result]
    assert spans_by_part(in_published_form(plan(in_frames(prompts), 1, 0))[2]) in outcomes


def spans_by_part(rows: list) -> list:
    return [[span for _, *span in runs] for runs in rows]


LATE = "gap_first_prompt_starts_late(start_at_zero=False)"
ILLEGAL = {"negative_length_prompt": "must be later than start", "empty_timeline": "the timeline is empty"}


def corner_cases_are_planned_as_published_or_better(folder):
    cases = golden(folder, "degenerate_plans.json")["cases"]
    for name in cases.keys() - ILLEGAL.keys() - {LATE, "single_prompt_zero_length"}:
        for run, results in cases[name]["runs"].items():
            overlap, extension = re.fullmatch(r"overlap=(\d+),(stmc|noext)", run).groups()
            overlap = int(overlap) if extension == "stmc" else 0
            assert_published(cases[name]["prompts"], overlap, results)


def corner_cases_without_a_meaning_are_refused(folder, name):
    with pytest.raises(TimelineError, match=ILLEGAL[name]):
        in_frames(golden(folder, "degenerate_plans.json")["cases"][name]["prompts"])


def a_late_start_is_an_unconditional_crop_where_the_published_code_leaves_zeros(folder):
    case = golden(folder, "degenerate_plans.json")["cases"][LATE]
    _, _, tiles, _ = published(case["runs"]["overlap=10,stmc"][0], 10)
    ours = plan(in_frames(case["prompts"]), 1, 10)
    assert ours.crops[2] == Crop(None, 0, 15)
    kept = [[tile for tile in runs if tile[0] != 2] for runs in in_published_form(ours)[2]]
    assert kept == tiles


@pytest.mark.golden
@quietly
@pytest.mark.parametrize("folder", golden_sets("stmc"))
def test_corner_cases_are_planned_as_published_or_better_or_refused(folder, subtests):
    checked(
        subtests,
        [
            corner_cases_are_planned_as_published_or_better,
            *((corner_cases_without_a_meaning_are_refused, each) for each in ILLEGAL),
            a_late_start_is_an_unconditional_crop_where_the_published_code_leaves_zeros,
        ],
        folder,
    )


# Any timeline


@st.composite
def prompts_in_frames(draw) -> list:
    """Timelines that the published code has a plan for most of the time: the first prompt lasts from start to end."""
    last = draw(st.integers(5, 120))
    listed = st.lists(st.sampled_from(list(BodyPart)), unique=True).map(lambda parts: [part.value for part in parts])
    spans = st.lists(st.integers(0, last), min_size=2, max_size=2, unique=True).map(sorted)
    rest = draw(st.lists(st.tuples(spans, listed.filter(bool)), max_size=5))
    return [[0, last, ["legs"]], *([start, end, parts] for (start, end), parts in rest)]


@quietly
@given(prompts_in_frames(), st.integers(0, 45))
def test_plans_of_any_timeline_are_those_of_appendix_b_read_interval_by_interval(prompts, overlap):
    expected = by_the_rules(prompts, overlap)
    ours = in_published_form(plan(in_frames(prompts), 1, overlap))
    assert ours == expected or expected == "AssertionError"


def weights(ours: Plan) -> np.ndarray:
    """The sum of the weights, [5, frames], added up tile by tile."""
    canvas = np.zeros((5, ours.frames))
    for tile in ours.tiles:
        canvas[list(BodyPart).index(tile.part), tile.start : tile.end] += tile.weight
    return canvas


@quietly
@given(timelines(), st.integers(0, 45), st.one_of(st.none(), st.integers(1, 60)))
@example(Timeline([Prompt("one frame", 0, 0.05)]), 9, 1)
def test_any_legal_timeline_has_a_plan_whose_weights_sum_to_one(timeline, overlap, spare):
    longest = None if spare is None else overlap + spare
    ours = plan(timeline, 20, overlap, longest)
    frames = timeline.frames(20)
    assert ours.frames == frames
    assert (weights(ours) == 1).all()
    for crop in ours.crops:
        assert 0 <= crop.start < crop.end <= frames
        assert crop.frames <= (longest or frames)
    assert {tile.crop for tile in ours.tiles} == set(range(len(ours.crops)))
    for tile in ours.tiles:
        assert ours.crops[tile.crop].start <= tile.start < tile.end <= ours.crops[tile.crop].end


@quietly
@given(timelines(), st.integers(1, 30))
def test_without_overlap_each_part_is_selected_from_one_crop_of_its_owner(timeline, longest):
    ours = plan(timeline, 20, 0, longest)
    assert all(tile.weight == 1 for tile in ours.tiles)
    for tile in ours.tiles:
        text = ours.crops[tile.crop].text
        for frame in range(tile.start, tile.end):
            held = [p.text for p, (a, b) in zip(timeline.prompts, timeline.spans(20), strict=True) if a <= frame < b]
            assert text in held if held else text is None


@quietly
@given(timelines(), st.integers(0, 30))
@example(Timeline([Prompt("shorter than the overlap", 0, 0.5)]), 30)
def test_a_longest_that_holds_the_timeline_changes_nothing(timeline, overlap):
    assert plan(timeline, 20, overlap, timeline.frames(20)) == plan(timeline, 20, overlap)


# Transitions, gaps, long prompts


def spans(ours: Plan) -> list[tuple]:
    return [(crop.text, crop.start, crop.end) for crop in ours.crops]


def test_a_transition_is_centred_on_the_edge_and_an_odd_overlap_is_longer_on_the_right():
    ours = plan(Timeline([Prompt("a", 0, 5), Prompt("b", 5, 10)]), 10, 5)
    assert spans(ours) == [("a", 0, 53), ("b", 48, 100), (None, 48, 53)]
    assert [(tile.crop, tile.weight) for tile in ours.tiles if tile.part == "head"] == [(0, 1), (1, 1), (2, -1)]


def test_several_parts_that_change_at_one_edge_share_one_transition():
    ours = plan(Timeline([Prompt("a", 0, 5, {"legs"}), Prompt("b", 1, 3, {"left arm", "head"})]), 10, 4)
    assert spans(ours) == [("a", 0, 50), ("b", 8, 32), (None, 8, 12), (None, 28, 32)]
    assert [tile.part for tile in ours.tiles if tile.weight < 0] == ["left arm"] * 2 + ["head"] * 2


@quietly
def test_a_prompt_that_owns_nothing_is_not_planned():
    ours = plan(Timeline([Prompt("a", 0, 5, "legs"), Prompt("lost", 1, 3, "head"), Prompt("b", 1, 3, "head")]), 10, 4)
    assert [crop.text for crop in ours.crops] == ["a", "b", None, None]


@quietly
def test_an_edge_that_moves_no_part_is_no_transition():
    ours = plan(Timeline([Prompt("a", 0, 5), Prompt("lost", 1, 3, "legs"), Prompt("b", 0, 5, {"legs"})]), 10, 4)
    assert spans(ours) == [("a", 0, 50), ("b", 0, 50)]


def test_a_gap_is_an_unconditional_crop_joined_like_a_prompt():
    ours = plan(Timeline([Prompt("a", 0, 2), Prompt("b", 4, 6)]), 10, 4)
    assert spans(ours) == [("a", 0, 22), ("b", 38, 60), (None, 18, 42), (None, 18, 22), (None, 38, 42)]


def test_a_prompt_longer_than_longest_is_split_into_the_fewest_equal_pieces_of_the_same_text():
    ours = plan(Timeline([Prompt("walk", 0, 15, {"legs"}), Prompt("wave", 2, 4, {"head"})]), 20, 10, longest=160)
    assert spans(ours) == [("walk", 0, 155), ("walk", 145, 300), ("wave", 35, 85)] + [
        (None, start, start + 10) for start in (35, 75, 145)
    ]
    joint = [(tile.part, tile.weight) for tile in ours.tiles if tile.crop == 5]
    assert joint == [(part, -1) for part in BodyPart]
    assert len(plan(Timeline([Prompt("walk", 0, 15)]), 20, 10, longest=154).crops) == 3 + 2


def test_a_joint_reaches_only_the_parts_that_its_prompt_owns_there():
    ours = plan(Timeline([Prompt("walk", 0, 10, {"legs"}), Prompt("wave", 4, 6, {"head"})]), 10, 4, longest=60)
    joint = [tile.part for tile in ours.tiles if ours.crops[tile.crop] == Crop(None, 48, 52)]
    assert joint == ["left arm", "right arm", "legs", "spine"]


@quietly
def test_pieces_that_own_nothing_are_not_planned():
    prompts = [Prompt("walk", 0, 20, {"legs"}), Prompt("run", 5, 20), Prompt("sit", 5, 20, {"legs"})]
    ours = plan(Timeline(prompts), 10, 0, longest=50)
    assert [(crop.start, crop.end) for crop in ours.crops if crop.text == "walk"] == [(0, 50)]


def test_what_happens_once_has_its_text_in_its_first_piece_alone():
    timeline = Timeline([Prompt("walk", 0, 15, {"legs"}), Prompt("raise", 2, 15, {"left arm"})])
    asked, once = plan(timeline, 20, 10, longest=160), plan(timeline, 20, 10, longest=160, one_shot={"raise"})
    assert [crop.text for crop in asked.crops[:4]] == ["walk", "walk", "raise", "raise"]
    assert [crop.text for crop in once.crops[:4]] == ["walk", "walk", "raise", None]
    assert [(crop.start, crop.end) for crop in once.crops] == [(crop.start, crop.end) for crop in asked.crops]
    assert once.tiles == asked.tiles


def test_a_gap_longer_than_longest_is_split_too():
    ours = plan(Timeline([Prompt("a", 10, 11)]), 10, 4, longest=60)
    assert spans(ours)[:3] == [("a", 98, 110), (None, 0, 52), (None, 48, 102)]


@pytest.mark.parametrize("longest", [0, -3, 10])
def test_longest_must_leave_room_for_the_overlap(longest):
    with pytest.raises(ValueError, match=f"longest {longest} must be more than the overlap of 10 frames"):
        plan(Timeline([Prompt("a", 0, 5)]), 20, 10, longest)


def test_the_overlap_must_not_be_negative():
    with pytest.raises(ValueError, match="overlap -1 must be 0 frames or more"):
        plan(Timeline([Prompt("a", 0, 5)]), 20, -1)


# A plan made by hand


def tiles_of(crop: int, start: int, end: int, weight: float = 1) -> tuple[Tile, ...]:
    return tuple(Tile(crop, part, start, end, weight) for part in BodyPart)


@pytest.mark.parametrize(
    ("crops", "tiles", "words"),
    [
        ((Crop("a", 0, 9),), tiles_of(0, 0, 9), "the weights of the left arm sum to 0 instead of 1 from frame 9 on"),
        ((Crop("a", 0, 10),), tiles_of(0, 0, 10)[1:], "the weights of the left arm sum to 0 instead of 1 from frame 0"),
        ((Crop("a", 0, 10),), tiles_of(0, 0, 10) + tiles_of(0, 2, 4)[2:3], "legs sum to 2 instead of 1 from frame 2"),
        ((Crop("a", 0, 11),), tiles_of(0, 0, 10), "not within the timeline's 10 frames"),
        ((Crop("a", 3, 3), Crop("b", 0, 10)), tiles_of(1, 0, 10), "is empty or not within the timeline's 10 frames"),
        ((Crop("a", 1, 10),), tiles_of(0, 0, 10), "is empty or not within Crop"),
        ((Crop("a", 0, 10),), tiles_of(1, 0, 10), "refers to none of the 1 crops"),
    ],
)
def test_a_plan_that_breaks_the_invariant_is_refused(crops, tiles, words):
    with pytest.raises(ValueError, match=words):
        Plan(10, crops, tiles)


def test_a_plan_made_by_hand_may_have_fractional_weights():
    weights = (0.7, 0.2, 0.1)  # floats whose sum is just below 1
    tiles = tuple(tile for crop, weight in enumerate(weights) for tile in tiles_of(crop, 0, 10, weight))
    Plan(10, tuple(Crop(text, 0, 10) for text in "abc"), tiles)


@pytest.mark.parametrize("total", [0.95, 0.9999, 1.001, 1.05])
def test_a_plan_whose_weights_nearly_sum_to_1_is_refused(total):
    tiles = tuple(Tile(0, part, 0, 10, total) for part in BodyPart)
    with pytest.raises(ValueError, match=f"sum to {re.escape(str(total))} instead of 1 from frame 0 on"):
        Plan(10, (Crop("walk", 0, 10),), tiles)
