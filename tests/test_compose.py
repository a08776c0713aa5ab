"""The collage against closed forms and its own slow definition (parity: test_compose_golden)."""

from itertools import islice

import numpy as np
import pytest
import torch
from helpers.collages import (
    COLUMNS,
    GAP,
    STAND_NOD,
    WALK_WAVE,
    Constant,
    embeddings,
    last,
    padding_of,
    plans_of,
    random_embeddings,
    small_network,
    timeline,
)
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from stmc.composing import (
    NULL,
    canvas_lengths,
    collage,
    crop_lengths,
    crop_seeds,
    distinct_texts,
    guided_crops,
    sinc,
    smooth_seams,
)
from stmc.composing.batching import _runs
from stmc.diffusion import Noise, Schedule, ddim, ddpm
from stmc.motion.body import BodyPart
from stmc.timeline import Timeline
from stmc.timeline.planning import Crop, Plan, Tile

# What a step computes -----------------------------------------------------------------------------


@torch.no_grad()
def test_constant_predictions_make_a_mosaic_known_in_closed_form():
    plans = plans_of(WALK_WAVE, STAND_NOD, GAP)
    table = embeddings(plans)
    crops = guided_crops(Constant(), Schedule.cosine(100), plans, table, guidance=3.0)
    x0 = collage(crops, plans, COLUMNS)(torch.randn(3, 74, 10), 50)
    guided = {text: 100 + 3.0 * (float(value) - 100) for text, value in table.items()}
    for i, each in enumerate(plans):
        for part, columns in COLUMNS.items():
            expected = torch.zeros(74)
            for tile in each.tiles:
                if tile.part == part:
                    text = each.crops[tile.crop].text
                    expected[tile.start : tile.end] += tile.weight * guided[text or NULL]
            for column in columns:
                torch.testing.assert_close(x0[i, :, column], expected)
    walk, run = guided["walk"], guided["run"]
    legs = x0[0, :, COLUMNS[BodyPart.LEGS][0]]
    assert legs[[0, 34, 35, 44, 45, 73]].tolist() == pytest.approx(
        [walk, walk, walk + run - 100, walk + run - 100, run, run]
    )


@torch.no_grad()
def test_the_collage_is_its_slow_definition():
    plans = plans_of(WALK_WAVE, GAP, STAND_NOD, overlap=7)

    def nonlinear(crops: Tensor, t: int) -> Tensor:
        return crops.cumsum(dim=1).sin() + t

    x = torch.randn(3, 74, 10)
    slow = torch.zeros_like(x)
    for i, each in enumerate(plans):
        predicted = [nonlinear(x[i : i + 1, crop.start : crop.end], 3)[0] for crop in each.crops]
        for tile in each.tiles:
            first = tile.start - each.crops[tile.crop].start
            piece = predicted[tile.crop][first : first + tile.end - tile.start]
            for column in COLUMNS[tile.part]:
                slow[i, tile.start : tile.end, column] += tile.weight * piece[:, column]
    torch.testing.assert_close(collage(nonlinear, plans, COLUMNS)(x, 3), slow)


def test_weights_that_sum_to_one_leave_an_identity_alone():
    plans = plans_of(WALK_WAVE, GAP, overlap=9)
    x = torch.randn(2, 74, 10)
    x[1, 60:] = 0
    torch.testing.assert_close(collage(lambda crops, t: crops, plans, COLUMNS)(x, 0), x)


SPANS = st.tuples(st.integers(0, 60), st.integers(1, 40), st.sets(st.sampled_from(BodyPart), min_size=1))


@given(st.lists(st.lists(SPANS, min_size=1, max_size=6), min_size=1, max_size=4), st.integers(0, 12))
@settings(max_examples=30)
@pytest.mark.filterwarnings("ignore")
@torch.no_grad()
def test_any_batch_of_timelines_composes_to_the_number_all_its_texts_agree_on(batch, overlap):
    """Prompts that overlap, meet, leave gaps or are shorter than the overlap, with every weight of a tile in play."""
    timelines = []
    for spans in batch:
        first = min(start for start, _, _ in spans)
        named = [(f"text {a} {n}", a - first, a - first + n, *parts) for a, n, parts in spans]
        timelines.append(timeline(*named))
    plans = plans_of(*timelines, overlap=overlap)
    agreed = {text: torch.full((1, 1), 4.0) for text in distinct_texts(plans)}
    crops = guided_crops(Constant(), Schedule.cosine(100), plans, agreed)
    x0 = collage(crops, plans, COLUMNS)(torch.randn(len(plans), max(each.frames for each in plans), 10), 7)
    for row, each in zip(x0, plans, strict=True):
        torch.testing.assert_close(row[: each.frames], torch.full((each.frames, 10), 4.0))
        assert row[each.frames :].eq(0).all()


def test_nothing_comes_out_beyond_the_end_of_a_timeline():
    plans = plans_of(WALK_WAVE, STAND_NOD)
    x0 = collage(lambda crops, t: crops + 1, plans, COLUMNS)(torch.randn(2, 74, 10), 0)
    assert x0[1, 55:].eq(0).all() and x0[1, :55].ne(0).all()


def test_crops_are_cut_with_zeros_beyond_their_end():
    plans = plans_of(WALK_WAVE, STAND_NOD)
    seen = []
    collage(lambda crops, t: seen.append(crops) or crops, plans, COLUMNS)(torch.full((2, 74, 10), 7.0), 0)
    lengths = crop_lengths(plans)
    assert seen[0].shape == (len(lengths), max(lengths), 10)
    for crop, length in zip(seen[0], lengths, strict=True):
        assert crop[:length].eq(7).all() and crop[length:].eq(0).all()


# Which rows go through the denoiser ---------------------------------------------------------------


@torch.no_grad()
def test_rows_without_a_text_are_denoised_once_and_rows_with_one_twice():
    plans = plans_of(WALK_WAVE, GAP)
    denoiser = Constant()
    lengths = crop_lengths(plans)
    crops = guided_crops(denoiser, Schedule.cosine(100), plans, embeddings(plans), guidance=2.5)
    crops(torch.zeros(len(lengths), max(lengths), 10), 5)
    with_text = sum(crop.text is not None for each in plans for crop in each.crops)
    assert sum(rows for rows, _ in denoiser.calls) == len(lengths) + with_text
    assert with_text == 5 < len(lengths)


@pytest.mark.parametrize(("weight", "expected"), [(1.0, [1.0, 2.0, 3.0]), (0.0, [100.0, 100.0, 100.0])])
@torch.no_grad()
def test_guidance_of_one_and_zero_needs_a_single_pass(weight, expected):
    plans = plans_of(WALK_WAVE)
    denoiser = Constant()
    lengths = crop_lengths(plans)
    x0 = guided_crops(denoiser, Schedule.cosine(100), plans, embeddings(plans), weight)(
        torch.zeros(len(lengths), max(lengths), 10), 5
    )
    assert sum(rows for rows, _ in denoiser.calls) == len(lengths)
    assert x0[:3, 0, 0].tolist() == expected
    assert x0[3:, 0, 0].eq(100).all()


@torch.no_grad()
def test_no_call_exceeds_the_budget_and_a_longer_crop_goes_alone():
    plans = plans_of(*[WALK_WAVE, STAND_NOD] * 8)
    lengths = crop_lengths(plans)
    x = torch.zeros(len(lengths), max(lengths), 10)
    for budget, allowed in [(200, 200), (1, max(lengths))]:
        denoiser = Constant()
        guided_crops(denoiser, Schedule.cosine(100), plans, embeddings(plans), budget=budget)(x, 5)
        assert max(rows * frames for rows, frames in denoiser.calls) <= allowed
    assert {rows for rows, _ in denoiser.calls} == {1}


@torch.no_grad()
def test_grouping_and_budget_change_nothing_in_the_result():
    plans = plans_of(WALK_WAVE, STAND_NOD, GAP)
    lengths = crop_lengths(plans)
    x = torch.randn(len(lengths), max(lengths), 10)
    network, table = small_network(), random_embeddings(plans)
    one, many, pieces = (
        guided_crops(network, Schedule.cosine(100), plans, table, padding=padding, budget=budget)(x, 30)
        for padding, budget in [(0.99, 10**9), (0.0, 10**9), (0.1, 60)]
    )
    torch.testing.assert_close(one, many, atol=1e-5, rtol=0)
    torch.testing.assert_close(one, pieces, atol=1e-5, rtol=0)


@torch.no_grad()
def test_what_stands_beyond_a_crop_is_not_seen_and_comes_out_as_zero():
    plans = plans_of(WALK_WAVE)
    lengths = crop_lengths(plans)
    crops = guided_crops(small_network(), Schedule.cosine(100), plans, random_embeddings(plans), padding=0.99)
    clean = torch.randn(len(lengths), max(lengths), 10)
    dirty = clean.clone()
    for row, length in enumerate(lengths):
        dirty[row, length:] = 1e4
    torch.testing.assert_close(crops(clean, 30), crops(dirty, 30))
    assert all(row[length:].eq(0).all() for row, length in zip(crops(dirty, 30), lengths, strict=True))


@pytest.mark.parametrize(("mixed", "place", "calls"), [(False, None, 4), (True, 5, 1)])
@torch.no_grad()
def test_a_row_does_not_depend_on_the_number_of_words_beside_it(mixed, place, calls):
    plans = plans_of(WALK_WAVE)
    lengths = crop_lengths(plans)
    x = torch.randn(len(lengths), max(lengths), 10)
    words = dict(zip(distinct_texts(plans), torch.randn(4, 6, 4), strict=True))
    ragged = {text: value[: 2 + i] for i, (text, value) in enumerate(words.items())}
    network, widths = small_network(words=place), []

    def denoiser(x: Tensor, t: Tensor, text: Tensor, *masks: Tensor | None) -> Tensor:
        widths.append(text.shape[1])
        return network(x, t, text, *masks)

    def crops(**how) -> Tensor:
        return guided_crops(denoiser, Schedule.cosine(100), plans, ragged, padding=0.9, supports_padding=mixed, **how)(
            x, 3
        )

    together, called = crops(), len(widths)
    torch.testing.assert_close(together, crops(budget=1), atol=1e-5, rtol=0)
    assert called == calls


@pytest.mark.parametrize("prediction", ["eps", "v", "score"])
@torch.no_grad()
def test_what_the_network_predicts_makes_no_difference(prediction):
    plans, schedule = plans_of(WALK_WAVE), Schedule.cosine(100)
    lengths = crop_lengths(plans)
    x = torch.randn(len(lengths), max(lengths), 10, dtype=torch.float64)
    clean = Constant()

    def other(x, t, text, text_mask=None, mask=None):
        return schedule.from_x0(clean(x, t, text), x, t, prediction)

    table = embeddings(plans)
    expected = guided_crops(clean, schedule, plans, table)(x, 40)
    torch.testing.assert_close(guided_crops(other, schedule, plans, table, prediction=prediction)(x, 40), expected)


@pytest.mark.parametrize("window", [None, 80])
@pytest.mark.parametrize("mixed", [True, False])
def test_the_padding_counts_what_the_denoiser_is_given(mixed, window):
    """Also where it always sees as many frames, and where texts of other numbers of words go apart."""
    plans = plans_of(*[WALK_WAVE, STAND_NOD, GAP] * 3)
    denoiser, lengths = Constant(), crop_lengths(plans, window)
    table = {text: value.expand(1 + i, 1) for i, (text, value) in enumerate(embeddings(plans).items())}
    crops = guided_crops(denoiser, Schedule.cosine(100), plans, table, supports_padding=mixed, fixed_length=window)
    crops(torch.zeros(len(lengths), max(lengths), 10), 5)
    needed = sum(crop.frames * (2 if crop.text else 1) for each in plans for crop in each.crops)
    given_ = sum(rows * frames for rows, frames in denoiser.calls)
    assert crops.padding == pytest.approx(1 - needed / given_)
    assert (crops.padding > 0.4) == (window is not None)


@given(st.lists(st.integers(1, 200), min_size=1, max_size=60), st.floats(0, 0.5))
def test_the_padding_stays_within_what_is_allowed(lengths, padding):
    plans = [Plan(n, (Crop("a", 0, n),), tuple(Tile(0, part, 0, n, 1) for part in BodyPart)) for n in lengths]
    assert -1e-9 <= padding_of(plans, padding=padding) <= padding + 1e-9
    assert padding_of(plans, padding=0.0) == 0


def test_a_text_without_an_embedding_is_an_error_that_names_it():
    plans = plans_of(WALK_WAVE)
    table = embeddings(plans)
    del table["run"]
    with pytest.raises(ValueError, match="run"):
        guided_crops(Constant(), Schedule.cosine(100), plans, table)


def test_columns_must_own_every_feature_once():
    plans = plans_of(WALK_WAVE)
    with pytest.raises(ValueError, match="columns"):
        collage(lambda crops, t: crops, plans, {**COLUMNS, BodyPart.HEAD: (0, 1)})


def test_each_text_is_listed_once_and_the_empty_one_first():
    again = timeline(("walk", 0, 40, "legs"), ("run", 40, 74, "legs"), ("walk", 74, 90, "legs"))
    assert distinct_texts(plans_of(again, WALK_WAVE)) == (NULL, "walk", "run", "wave")


# Whole runs ---------------------------------------------------------------------------------------


@torch.no_grad()
def sample_timelines(timelines: list[Timeline], seeds: list[int], network, table: dict[str, Tensor]) -> list[Tensor]:
    plans = plans_of(*timelines)
    schedule = Schedule.cosine(100)
    predict = collage(guided_crops(network, schedule, plans, table), plans, COLUMNS)
    draw = Noise(seeds, [each.frames for each in plans], 10)
    x0 = last(ddpm(predict, schedule, draw(), draw, steps=20))
    return [row[: each.frames] for row, each in zip(x0, plans, strict=True)]


def test_a_batch_gives_what_each_timeline_gives_alone():
    timelines = [WALK_WAVE, STAND_NOD, GAP]
    network, table = small_network(), random_embeddings(plans_of(*timelines))
    together = sample_timelines(timelines, [5, 6, 7], network, table)
    for each, seed, batched in zip(timelines, [5, 6, 7], together, strict=True):
        (alone,) = sample_timelines([each], [seed], network, table)
        torch.testing.assert_close(batched, alone, atol=1e-4, rtol=0)


@torch.no_grad()
def test_independent_crops_of_a_batch_are_what_they_are_alone():
    network, schedule = small_network(), Schedule.cosine(100)
    both = plans_of(WALK_WAVE, STAND_NOD, overlap=0)
    table = random_embeddings(both)

    def sample(plans: list[Plan], seeds: list[int]) -> Tensor:
        draw = Noise(crop_seeds(plans, seeds), crop_lengths(plans), 10)
        crops = guided_crops(network, schedule, plans, table)
        return sinc(last(ddpm(crops, schedule, draw(), draw, steps=10)), plans, COLUMNS)

    together, alone = sample(both, [3, 4]), sample(both[1:], [4])
    torch.testing.assert_close(together[1, :55], alone[0], atol=1e-4, rtol=0)


def test_no_global_generator_is_touched():
    timelines = [WALK_WAVE, GAP]
    network, table = small_network(), random_embeddings(plans_of(*timelines))
    before = torch.get_rng_state(), np.random.get_state()[1].copy()
    sample_timelines(timelines, [1, 2], network, table)
    assert torch.equal(before[0], torch.get_rng_state())
    assert np.array_equal(before[1], np.random.get_state()[1])


@torch.no_grad()
def test_index_tensors_are_made_once_for_all_steps(monkeypatch):
    plans = plans_of(WALK_WAVE, GAP)
    schedule = Schedule.cosine(100)
    predict = collage(guided_crops(Constant(), schedule, plans, embeddings(plans)), plans, COLUMNS)
    draws = Noise([1, 2], [74, 60], 10)
    steps = ddim(predict, schedule, draws(), steps=6)
    next(steps)
    monkeypatch.setattr(torch, "tensor", None)
    monkeypatch.setattr(torch, "from_numpy", None)
    assert len(list(steps)) == 5


# SINC and SINC-lerp ---------------------------------------------------------------------------------


def test_sinc_selects_each_part_from_the_crop_that_owns_it():
    plans = plans_of(WALK_WAVE, overlap=0)
    crops = torch.stack([torch.full((max(crop_lengths(plans)), 10), float(i)) for i in range(3)])
    x0 = sinc(crops, plans, COLUMNS)[0]
    legs, arm = COLUMNS[BodyPart.LEGS][0], COLUMNS[BodyPart.RIGHT_ARM][1]
    assert x0[:, legs].tolist() == [0.0] * 40 + [1.0] * 34
    assert x0[:, arm].tolist() == [0.0] * 14 + [2.0] * 38 + [1.0] * 22


def test_lerp_draws_a_line_across_each_seam_of_the_part_that_changes():
    plans = plans_of(timeline(("a", 0, 20, "legs"), ("b", 20, 40, "legs")), overlap=0)
    features = torch.cat([torch.zeros(1, 20, 10), torch.ones(1, 20, 10)], dim=1)
    smooth = smooth_seams(features, plans, COLUMNS, overlap=6)
    torch.testing.assert_close(smooth[0, 17:23], torch.linspace(0, 1, 6)[:, None].expand(6, 10))
    assert smooth[0, :17].eq(0).all() and smooth[0, 23:].eq(1).all()
    assert torch.equal(smooth_seams(features, plans, COLUMNS, overlap=0), features)


def test_lerp_leaves_parts_alone_that_do_not_change():
    plans = plans_of(WALK_WAVE, timeline(("stand", 0, 74)), overlap=0)
    features = torch.randn(2, 74, 10)
    smooth = smooth_seams(features, plans, COLUMNS, overlap=10)
    assert torch.equal(smooth[1], features[1])
    arm, legs = list(COLUMNS[BodyPart.RIGHT_ARM]), list(COLUMNS[BodyPart.LEGS])
    assert torch.equal(smooth[0, 9:19, legs], features[0, 9:19, legs])
    assert not torch.equal(smooth[0, 9:19, arm], features[0, 9:19, arm])


def test_lerp_refuses_plans_with_an_overlap():
    plans = plans_of(WALK_WAVE)
    with pytest.raises(ValueError, match="overlap=0"):
        smooth_seams(torch.zeros(1, 74, 10), plans, COLUMNS, overlap=10)


def test_stopping_early_costs_no_further_steps():
    plans = plans_of(WALK_WAVE)
    denoiser = Constant()
    predict = collage(guided_crops(denoiser, Schedule.cosine(100), plans, embeddings(plans)), plans, COLUMNS)
    draw = Noise([0], [74], 10)
    calls = []
    for _ in islice(ddpm(predict, Schedule.cosine(100), draw(), draw), 3):
        calls.append(len(denoiser.calls))
    assert len(set(np.diff(calls))) == 1 and len(denoiser.calls) == calls[-1]


# Denoisers that see more than a crop --------------------------------------------------------------


def test_with_a_window_every_crop_goes_on_for_as_many_frames_of_its_timeline():
    plans, window = plans_of(WALK_WAVE, STAND_NOD), 60
    lengths = canvas_lengths(plans, window)
    assert lengths == (74 + 60, 55 + 60)
    x = torch.randn(2, max(lengths), 10, generator=torch.Generator().manual_seed(0))
    crops, seen = [], Constant()
    rows = guided_crops(seen, Schedule.cosine(100), plans, embeddings(plans), fixed_length=window)
    x0 = collage(lambda cut, t: crops.append(cut) or rows(cut, t), plans, COLUMNS, window)(x, 3)
    starts = [(i, crop.start) for i, plan in enumerate(plans) for crop in plan.crops]
    for crop, (i, start) in zip(crops[0], starts, strict=True):
        assert torch.equal(crop, x[i, start : start + window])
    assert {frames for _, frames in seen.calls} == {window}
    plain = collage(guided_crops(Constant(), Schedule.cosine(100), plans, embeddings(plans)), plans, COLUMNS)
    assert x0.shape == x.shape and torch.equal(x0[:, :74], plain(x[:, :74], 3))
    assert not x0[:, 74:].any() and not x0[1, 55:].any()


def test_with_a_window_there_are_no_masks_and_all_frames_are_predicted():
    plans, window = plans_of(WALK_WAVE, overlap=0), 60

    def denoiser(x: Tensor, t: Tensor, text: Tensor, text_mask, mask) -> Tensor:
        assert mask is None and x.shape[1] == window
        return x + 1

    crops = guided_crops(denoiser, Schedule.cosine(100), plans, embeddings(plans), 1.0, fixed_length=window)
    x = torch.randn(3, window, 10)
    assert torch.equal(crops(x, 3), x + 1)
    assert torch.equal(sinc(x, plans, COLUMNS), sinc(x[:, : max(crop_lengths(plans))], plans, COLUMNS))


def test_a_crop_longer_than_the_window_is_an_error_that_says_what_to_do():
    plans = plans_of(WALK_WAVE)
    with pytest.raises(ValueError, match=r"a crop has 48 frames, but the denoiser sees 30; plan with longest=30"):
        guided_crops(Constant(), Schedule.cosine(100), plans, embeddings(plans), fixed_length=30)


@pytest.mark.parametrize(
    ("lengths", "padding", "expected"),
    [
        ([81, 100], 0.1, [(0, 2)]),  # 19 of the 200 frames that are denoised
        ([79, 100], 0.1, [(0, 1), (1, 2)]),  # 21
        ([1, 1, 1, 3], 0.5, [(0, 4)]),  # the very half
    ],
)
def test_padding_is_a_share_of_all_that_is_denoised(lengths, padding, expected):
    assert _runs(lengths, padding) == expected
