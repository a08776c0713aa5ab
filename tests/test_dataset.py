"""Batches: reproducible, balanced, never empty, and of real frames only."""

import dataclasses
from collections import Counter
from itertools import pairwise

import numpy as np
import pytest
import torch
from helpers.toy_data import FPS, LAYOUT, LetterCounts, cache
from hypothesis import given
from hypothesis import strategies as st

from stmc.data.cache import Cache, Clip, read_caches
from stmc.diffusion.statistics import Statistics
from stmc.motion.body import BodyPart
from stmc.motion.body_model import Skeleton
from stmc.motion.representation import Field, Layout, SmplRepresentation
from stmc.training.data.balanced_batches import BalancedBatches
from stmc.training.data.batches import ClipBatches
from stmc.training.data.dataset import NULL, SEAM, BatchPlan, Dataset


@pytest.fixture(scope="module")
def dataset() -> Dataset:
    return Dataset(cache(), LetterCounts(), LAYOUT, min_clips=3)


def draw(dataset: Dataset, count: int = 4000, split: str = "train", **settings):
    """A plan of many rows, and the clip that each is from."""
    [plan] = ClipBatches(dataset, split, BalancedBatches(**settings, rows=count, pool=1, pieces=1)).plans(0)
    starts = np.array([clip.start for clip in dataset.clips])
    return plan, [dataset.clips[index] for index in np.searchsorted(starts, plan.body.start, side="right") - 1]


def same(one, other) -> bool:
    tensors = ((getattr(one, name), getattr(other, name)) for name in ("motion", "mask", "text", "text_mask"))
    return all((a is None and b is None) or torch.equal(a, b) for a, b in tensors)


def one_content(lengths: list[int], cyclic: bool, from_start: bool = False) -> Dataset:
    starts = np.cumsum([0, *lengths])
    clips = tuple(
        Clip(
            f"clip-{i}", "walk", "normal", "walk", ("legs",), cyclic, False, "train", start, end, from_start=from_start
        )
        for i, (start, end) in enumerate(pairwise(starts.tolist()))
    )
    motion = torch.arange(float(starts[-1]))[:, None].expand(-1, LAYOUT.width)  # every frame knows its place
    texts = {"walk": (("walk", 1.0),)}
    return Dataset(Cache(FPS, "toy", motion.contiguous(), clips, texts), LetterCounts(), LAYOUT, min_clips=1)


def test_a_steps_batch_is_the_same_whenever_it_is_asked_for(dataset):
    recipe = BalancedBatches(rows=6, pool=3, pieces=2, slowest=0.8, fastest=1.25)
    in_order = ClipBatches(dataset, "train", recipe, seed=7)
    batches = [in_order(step) for step in range(8)]
    again = ClipBatches(dataset, "train", recipe, seed=7)
    for step in (5, 0, 7):
        assert all(same(a, b) for a, b in zip(again(step), batches[step], strict=True))


def test_seeds_processes_steps_and_splits_draw_differently(dataset):
    recipe = BalancedBatches(rows=6, pool=2, pieces=1)
    train, other = ClipBatches(dataset, "train", recipe), ClipBatches(dataset, "train", recipe, seed=1)
    [first] = train(0)
    for different in (train(1), train(2), train(0, process=1), other(0), ClipBatches(dataset, "val", recipe)(0)):
        assert not same(first, different[0])


def test_only_clips_of_the_split_are_drawn(dataset):
    for split in ("train", "val"):
        assert {clip.split for clip in draw(dataset, split=split, uncond_crop_prob=0.3)[1]} == {split}


@pytest.mark.parametrize("balance", [0.0, 0.5, 1.0])
def test_contents_are_drawn_by_the_power_of_their_number_of_clips(dataset, balance):
    _, clips = draw(dataset, balance=balance, uncond_crop_prob=0.0)
    walks, raises = 10, 5  # training clips
    share = sum(clip.content == "walk" for clip in clips) / len(clips)
    assert share == pytest.approx(walks**balance / (walks**balance + raises**balance), abs=0.03)


def test_a_content_is_drawn_so_many_times_as_often_as_its_emphasis_says(dataset):
    _, clips = draw(dataset, balance=0.0, emphasis={"walk": 3.0}, uncond_crop_prob=0.0)
    share = sum(clip.content == "walk" for clip in clips) / len(clips)
    assert share == pytest.approx(3 / 4, abs=0.03)
    for emphasis, error in (
        ({"wlak": 2.0}, r"emphasis: unknown contents \['wlak'\]; choose from kick, raise, walk"),
        ({"walk": -1.0}, "factors must be at least 0"),
        ({"walk": 0.0, "raise": 0.0}, "no content is left"),
    ):
        with pytest.raises(ValueError, match=error):
            draw(dataset, emphasis=emphasis)


def test_a_content_of_too_few_clips_is_seen_only_without_text(dataset):
    _, clips = draw(dataset, uncond_crop_prob=0.0)
    assert "kick" not in {clip.content for clip in clips}
    plan, clips = draw(dataset, uncond_crop_prob=1.0)
    assert "kick" in {clip.content for clip in clips}
    assert (plan.sentence == NULL).all()
    assert "kick" not in dataset.sentences


def test_crops_without_text_are_there_short_and_anywhere(dataset):
    plan, _ = draw(dataset, uncond_crop_prob=0.25, text_dropout=0.0)
    assert (plan.sentence == NULL).mean() == pytest.approx(0.25, abs=0.03)
    plan, clips = draw(dataset, uncond_crop_prob=1.0)
    assert plan.body.frames.min() == 10
    assert plan.body.frames.max() == 60
    ends = np.array([clip.end for clip in clips])
    starts = np.array([clip.start for clip in clips])
    assert (plan.body.start == starts).any()
    assert (plan.body.start + plan.body.frames == ends).any()


def test_texts_are_lost_as_often_as_asked(dataset):
    plan, _ = draw(dataset, uncond_crop_prob=0.0, text_dropout=0.1)
    assert (plan.sentence == NULL).mean() == pytest.approx(0.1, abs=0.02)


def test_sentences_are_drawn_by_their_probabilities(dataset):
    plan, clips = draw(dataset, uncond_crop_prob=0.0, text_dropout=0.0)
    said = [dataset.sentences[s] for s, clip in zip(plan.sentence, clips, strict=True) if clip.content == "walk"]
    assert set(said) == {"walk", "a walk"}
    assert said.count("walk") / len(said) == pytest.approx(0.75, abs=0.03)


@given(
    lengths=st.lists(st.integers(1, 400), min_size=2, max_size=4),
    cyclic=st.booleans(),
    trim=st.floats(0, 0.49),
    uncond_crop_prob=st.sampled_from([0.0, 0.5]),
    speed=st.sampled_from([(1.0, 1.0), (0.5, 2.0), (1.3, 3.0)]),
)
def test_a_row_is_never_empty_never_too_long_and_within_its_clip(lengths, cyclic, trim, uncond_crop_prob, speed):  # R4
    dataset = one_content(lengths, cyclic)
    plan, clips = draw(
        dataset,
        300,
        trim=trim,
        uncond_crop_prob=uncond_crop_prob,
        slowest=speed[0],
        fastest=speed[1],
        shortest=1.0,
        longest=8.0,
    )
    assert plan.body.frames.min() >= 1
    assert plan.body.frames.max() <= 160
    ends = np.array([clip.end for clip in clips])
    assert (plan.body.start + (plan.body.frames - 1) * plan.body.speed <= ends - 1 + 1e-9).all()
    assert (plan.body.end == ends).all()


def test_a_clip_that_is_not_cyclic_keeps_its_middle():
    plan, clips = draw(one_content([50, 100], cyclic=False), trim=0.12, uncond_crop_prob=0.0)
    for start, frames, clip in zip(plan.body.start, plan.body.frames, clips, strict=True):
        most = int(0.12 * (clip.end - clip.start))
        assert clip.start <= start <= clip.start + most
        assert clip.end - most <= start + frames <= clip.end
    assert len({*plan.body.start}) > 10


def test_a_cyclic_clip_is_cut_to_any_stretch_that_is_long_enough():
    plan, _ = draw(one_content([100, 20], cyclic=True), uncond_crop_prob=0.0, shortest=1.5)
    long = plan.body.frames[plan.body.end == 100]
    assert (long.min(), long.max()) == (30, 100)
    assert set(plan.body.frames[plan.body.end == 120]) == {20}  # shorter than the shortest: whole


def test_a_share_of_the_cyclic_crops_begins_where_the_clip_does():
    dataset = one_content([100, 90], cyclic=True)
    shares = {}
    for share in (0.0, 0.5, 1.0):
        plan, clips = draw(dataset, 400, uncond_crop_prob=0.0, shortest=1.5, from_start_prob=share)
        shortened = plan.body.frames < plan.body.end - np.array([clip.start for clip in clips])
        at_start = plan.body.start == np.array([clip.start for clip in clips])
        shares[share] = at_start[shortened].mean()
    assert shares[0.0] < 0.15
    assert 0.4 < shares[0.5] < 0.65
    assert shares[1.0] == 1.0


@pytest.mark.parametrize("cyclic", [True, False])
def test_a_clip_from_its_start_loses_nothing_there_and_unless_it_is_cyclic_nothing_at_its_end(cyclic):
    dataset = one_content([200, 80], cyclic, from_start=True)
    plan, clips = draw(dataset, 300, uncond_crop_prob=0.0, shortest=1.5, longest=30.0, trim=0.2)
    assert (plan.body.start == [clip.start for clip in clips]).all()
    whole = plan.body.frames == [clip.end - clip.start for clip in clips]
    assert whole.all() if not cyclic else not whole.all()


def test_transitions_are_cut_anywhere_also_where_crops_begin_with_their_clip():
    plan, _ = draw(one_content([200], cyclic=True), 100, uncond_crop_prob=1.0, from_start_prob=1.0)
    assert len({*plan.body.start}) > 10


def test_rows_are_normalised_frames_of_their_clips_and_padding_is_zero(dataset):
    batches = ClipBatches(dataset, "train", BalancedBatches(rows=16, pool=1, pieces=1))
    [plan] = batches.plans(0)
    [batch] = batches(0)
    assert batch.frames == plan.body.frames.sum() == batch.mask.sum()
    for row, (start, frames, sentence) in enumerate(zip(plan.body.start, plan.body.frames, plan.sentence, strict=True)):
        raw = dataset.features[start : start + frames]
        torch.testing.assert_close(dataset.motion.restore(batch.motion[row, :frames]), raw)
        assert batch.mask[row, :frames].all()
        assert not batch.mask[row, frames:].any()
        assert not batch.motion[row, frames:].any()
        words, _ = LetterCounts().encode([dataset.sentences[sentence]])
        torch.testing.assert_close(dataset.text.restore(batch.text[row, : words.shape[1]]), words[0])
        assert int(batch.text_mask[row].sum()) == words.shape[1]
        assert not batch.text[row, words.shape[1] :].any()


def test_masks_are_left_out_where_nothing_is_padded():
    [batch] = ClipBatches(
        one_content([40] * 4, cyclic=False), "train", BalancedBatches(trim=0.0, uncond_crop_prob=0.0, pieces=1)
    )(0)
    assert batch.mask is None
    assert batch.text_mask is None


def test_no_text_is_the_empty_text_not_zeros(dataset):
    assert dataset.sentences[NULL] == ""
    [batch] = ClipBatches(dataset, "train", BalancedBatches(rows=3, uncond_crop_prob=1.0, pieces=1))(0)
    torch.testing.assert_close(batch.text[:, 0], dataset.text.normalise(torch.zeros(len(batch.text), 8)))


def test_statistics_are_those_of_the_training_clips_alone():
    data = cache()
    dataset = Dataset(data, LetterCounts(), LAYOUT, floor={name: 0.01 for name in LAYOUT.slices}, min_clips=3)
    rows = torch.cat([data.features[clip.start : clip.end] for clip in data.clips if clip.split == "train"])
    torch.testing.assert_close(dataset.motion.mean, rows.mean(dim=0))
    torch.testing.assert_close(dataset.motion.std, rows.std(dim=0, correction=0).clamp_min(0.01))
    assert dataset.motion.std[4] == 0.01  # a number that never changes
    words = torch.cat([LetterCounts().encode([text])[0][0] for text in ("walk", "a walk", "raise the arm")])
    torch.testing.assert_close(dataset.text.mean, words.mean(dim=0))


def test_a_pool_is_sorted_so_that_little_is_padding_and_nothing_is_lost(dataset):
    recipe = BalancedBatches(rows=32, pool=8, pieces=2)
    batches = ClipBatches(dataset, "train", recipe)
    pieces = [piece for step in range(8) for piece in batches(step)]
    assert sum(len(piece.motion) for piece in pieces) == 32 * 8
    frames, room = sum(p.frames for p in pieces), sum(p.motion.shape[0] * p.motion.shape[1] for p in pieces)
    assert frames / room > 0.9
    assert max(p.frames for p in pieces) < 1.5 * min(p.frames for p in pieces)


def test_a_faster_clip_covers_the_same_distance_in_less_time():
    generator = torch.Generator().manual_seed(0)
    data = cache()
    moving = data.features.clone()
    moving[:, 0] = torch.rand(len(moving), generator=generator)
    dataset = Dataset(dataclasses.replace(data, features=moving), LetterCounts(), LAYOUT, min_clips=3)
    plan, _ = draw(dataset, 100, trim=0.0, uncond_crop_prob=0.0, slowest=0.8, fastest=1.25)
    raw = dataset._cut(plan.body)
    for row, (start, frames, speed) in enumerate(zip(plan.body.start, plan.body.frames, plan.body.speed, strict=True)):
        source = frames * speed
        whole = int(source + 1e-6)
        distance = moving[start : start + whole, 0].sum() + (source - whole) * moving[start + whole - 1, 0]
        assert abs(raw[row, :frames, 0].sum() - distance) < 1.01 * abs(source - whole) + 1e-3
    assert (plan.body.frames < 0.85 * (plan.body.frames * plan.body.speed)).any()


def test_a_change_of_speed_interpolates_poses_and_keeps_rotations_rotations(dataset):
    plan, _ = draw(dataset, 50, uncond_crop_prob=0.0, slowest=0.6, fastest=1.6)
    raw = dataset._cut(plan.body)
    first, second = raw[..., 2:5], raw[..., 5:8]
    for vector in (first, second):
        torch.testing.assert_close(vector.norm(dim=-1), torch.ones(raw.shape[:2]))
    torch.testing.assert_close((first * second).sum(dim=-1), torch.zeros(raw.shape[:2]), atol=1e-5, rtol=0)
    for row, (start, speed) in enumerate(zip(plan.body.start, plan.body.speed, strict=True)):
        place = start + 3 * speed
        low, share = int(place), place - int(place)
        expected = torch.lerp(dataset.features[low, 8:], dataset.features[low + 1, 8:], share)
        torch.testing.assert_close(raw[row, 3, 8:], expected)


def test_unchanged_speed_gives_the_very_frames_by_both_ways(dataset):
    plan, _ = draw(dataset, 20)
    barely = dataclasses.replace(plan.body, speed=plan.body.speed * (1 + 1e-12))
    torch.testing.assert_close(dataset._cut(plan.body), dataset._cut(barely), atol=1e-5, rtol=1e-5)


def test_a_layout_that_does_not_fit_is_an_error():
    with pytest.raises(ValueError, match="11 features, but the layout has 3"):
        Dataset(cache(), LetterCounts(), Layout((Field("positions", 3),)))


def test_nothing_to_train_on_is_an_error(dataset):
    with pytest.raises(ValueError, match="no content has 100 training clips"):
        Dataset(cache(), LetterCounts(), LAYOUT, min_clips=100)
    with pytest.raises(ValueError, match="no clip of split 'tests'"):
        ClipBatches(dataset, "tests", BalancedBatches())


@pytest.mark.parametrize(
    "wrong",
    [
        {"rows": 0},
        {"pieces": 65},
        {"trim": 0.5},
        {"uncond_crop_prob": 1.1},
        {"slowest": 0.0},
        {"shortest": 11.0},
        {"fastest": 0.5},
    ],
)
def test_a_recipe_that_cannot_be_meant_is_an_error(wrong):
    with pytest.raises(ValueError, match=next(iter(wrong))):
        BalancedBatches(**wrong)


def test_what_comes_with_the_data_is_used(dataset):
    given = Statistics(torch.ones(LAYOUT.width), torch.full((LAYOUT.width,), 2.0))
    own = dataclasses.replace(cache(), statistics=given, skeleton=Skeleton.default())
    other = Dataset(own, LetterCounts(), LAYOUT, min_clips=1)
    assert torch.equal(other.motion.std, given.std)
    assert other.skeleton is own.skeleton
    assert dataset.skeleton is None
    assert not torch.equal(dataset.motion.std, given.std)


def composed_cache() -> Cache:
    """Twelve walks (all features 1) and twelve raises of the right arm (all features 2)."""
    clips, start = [], 0
    for i in range(24):
        walk = i % 2 == 0
        name, part, frames = ("walk", "legs", 60) if walk else ("raise", "right arm", 40)
        clips.append(Clip(f"{name}-{i}", name, "normal", name, (part,), walk, False, "train", start, start + frames))
        start += frames
    features = torch.cat([torch.full((clip.end - clip.start, 205), 1.0 + (clip.content == "raise")) for clip in clips])
    texts = {name: ((name, 1.0),) for name in ("walk", "raise")}
    return Cache(20.0, "smpl", features, tuple(clips), texts)


def composing(composed: float) -> ClipBatches:
    return ClipBatches(
        Dataset(composed_cache(), LetterCounts(), SmplRepresentation().layout),
        "train",
        BalancedBatches(rows=96, uncond_crop_prob=0.0, text_dropout=0.0, pool=1, pieces=1, compose_prob=composed),
    )


def rows_of(batches: ClipBatches) -> tuple[BatchPlan, torch.Tensor]:
    [plan] = batches.plans(0)
    return plan, batches.dataset._compose(batches.dataset._cut(plan.body), plan)


def arm() -> torch.Tensor:
    """Columns of the right arm but those of rotations, which do not blend linearly."""
    columns = torch.tensor(SmplRepresentation().columns[BodyPart.RIGHT_ARM])
    return columns[columns >= SmplRepresentation().layout["positions"].start]


def test_a_donor_that_fills_a_row_keeps_its_arm_and_its_text_and_walks_on_another_body() -> None:
    batches = composing(1.0)
    plan, raw = rows_of(batches)
    filled = np.flatnonzero(plan.donor.frames == plan.body.frames)
    assert len(filled) > 10
    legs = SmplRepresentation().layout["root_velocity"]
    for row in filled:
        frames = plan.body.frames[row]
        assert (raw[row, :frames, arm()] == 2).all()
        assert (raw[row, :frames, legs] == 1).all()
        assert batches.dataset.clips[plan.body.clip[row]].content == "walk"
    assert {batches.dataset.sentences[plan.sentence[row]] for row in filled} >= {"raise"}


def test_a_donor_within_a_walk_comes_and_goes_under_the_text_of_the_walk() -> None:
    batches = composing(1.0)
    plan, raw = rows_of(batches)
    within = np.flatnonzero((plan.donor.frames > 0) & (plan.donor.frames < plan.body.frames))
    assert len(within) > 5
    for row in within:
        assert batches.dataset.sentences[plan.sentence[row]] == "walk"
        first, frames = plan.offset[row], plan.donor.frames[row]
        shown = raw[row, : plan.body.frames[row], arm()].mean(dim=1)
        expected = torch.ones(len(shown))
        for frame in range(frames):  # a ramp of `SEAM` frames where the walk goes on beyond the donor
            come = (frame + 1) / (SEAM + 1) if first else 1.0
            go = (frames - frame) / (SEAM + 1) if first + frames < len(shown) else 1.0
            expected[first + frame] += min(come, go, 1.0)
        torch.testing.assert_close(shown, expected)
        assert (raw[row, : len(shown), SmplRepresentation().layout["root_velocity"]] == 1).all()


def test_any_body_with_other_parts_can_be_a_receiver_and_shows_its_own_text_only_where_it_is_whole() -> None:
    clips, start = [], 0
    for number in range(36):
        name, part, frames = [("turn", "legs", 60), ("left", "left arm", 50), ("right", "right arm", 40)][number % 3]
        clips.append(Clip(f"{name}-{number}", name, "", name, (part,), False, False, "train", start, start + frames))
        start += frames
    texts = {name: ((name, 1.0),) for name in ("turn", "left", "right")}
    features = torch.arange(start * 205.0).reshape(start, 205)
    data = Cache(20.0, "smpl", features, tuple(clips), texts)
    dataset = Dataset(data, LetterCounts(), SmplRepresentation().layout)
    settings = {"uncond_crop_prob": 0.0, "text_dropout": 0.0, "trim": 0.0, "pool": 1, "pieces": 1, "compose_prob": 1.0}
    [walking] = ClipBatches(dataset, "train", BalancedBatches(rows=96, **settings)).plans(0)
    assert not walking.donor.frames.any()  # nobody walks
    [plan] = ClipBatches(dataset, "train", BalancedBatches(rows=96, receivers="any", **settings)).plans(0)
    pairs = Counter()
    for row in np.flatnonzero(plan.donor.frames):
        receiver, donor = dataset.clips[plan.body.clip[row]], dataset.clips[plan.donor.clip[row]]
        pairs[receiver.content, donor.content] += 1
        whole = plan.body.frames[row] == receiver.end - receiver.start
        assert whole or plan.body.frames[row] == plan.donor.frames[row]
        said = [dataset.sentences[each[row]] for each in (plan.sentence, plan.other)]
        assert said == [receiver.content if whole else donor.content, donor.content]
    assert set(pairs) == {("turn", "left"), ("turn", "right"), ("left", "right")}
    recipe = BalancedBatches(rows=96, receivers="any", uncomposed=("left",), **settings)
    [plan] = ClipBatches(dataset, "train", recipe).plans(0)
    rows = np.flatnonzero(plan.donor.frames)
    pairs = {tuple(dataset.clips[each.clip[row]].content for each in (plan.body, plan.donor)) for row in rows}
    assert pairs == {("turn", "right")}
    with pytest.raises(ValueError, match=r"uncomposed: unknown contents \['lfet'\]; choose from left, right, turn"):
        ClipBatches(dataset, "train", BalancedBatches(rows=96, uncomposed=("lfet",))).plans(0)


def test_some_compositions_that_show_both_have_a_sentence_about_both_and_the_others_never() -> None:
    joined = {
        frozenset(("walk", "raise")): ("raise while walking", "walk, raising"),
        frozenset(("walk", "fly")): ("?",),
    }
    dataset = Dataset(composed_cache(), LetterCounts(), SmplRepresentation().layout, joined=joined)
    assert dataset.sentences == ["", "raise", "walk", "raise while walking", "walk, raising"]
    settings = {"rows": 512, "pool": 1, "pieces": 1, "text_dropout": 0.3, "compose_prob": 1.0}
    plans, heard = {}, {}
    for share in (0.0, 0.5, 1.0):
        [plans[share]] = ClipBatches(dataset, "train", BalancedBatches(**settings, joined_prob=share)).plans(0)
        heard[share] = Counter(dataset.sentences[place] for place in plans[share].sentence)
    assert set(heard[0.0]) == {"", "raise", "walk"} and heard[0.0][""] == heard[1.0][""]
    about_both = {share: counts["raise while walking"] + counts["walk, raising"] for share, counts in heard.items()}
    assert 0.35 < about_both[0.5] / about_both[1.0] < 0.65
    assert min(heard[1.0]["raise while walking"], heard[1.0]["walk, raising"]) > 0.4 * about_both[1.0]
    plan, is_joined = plans[1.0], plans[1.0].sentence > 2
    assert (plan.donor.frames[is_joined] > 0).all() and (plan.other[is_joined] == plan.sentence[is_joined]).all()


def test_a_body_that_was_cut_off_before_it_showed_its_content_is_not_joined() -> None:
    cache = composed_cache()
    cache = dataclasses.replace(cache, clips=tuple(dataclasses.replace(clip, cyclic=False) for clip in cache.clips))
    dataset = Dataset(
        cache,
        LetterCounts(),
        SmplRepresentation().layout,
        joined={frozenset(("walk", "raise")): ("raise while walking",)},
    )
    settings = {"uncond_crop_prob": 0.0, "text_dropout": 0.0, "compose_prob": 1.0, "joined_prob": 1.0}
    plans = ClipBatches(dataset, "train", BalancedBatches(rows=96, receivers="any", **settings)).plans(0)
    joined = np.concatenate([plan.sentence == 3 for plan in plans])
    lasting = np.concatenate([plan.body.frames >= 45 for plan in plans])
    assert joined.any() and not (joined & ~lasting).any()  # walks of 60 frames, trimmed; raises last 40 at most


def test_without_compositions_no_row_has_a_guest() -> None:
    plan, raw = rows_of(composing(0.0))
    assert not plan.donor.frames.any()
    assert all((raw[row, :frames] == raw[row, 0]).all() for row, frames in enumerate(plan.body.frames))


@pytest.mark.parametrize("statistics", [None, Statistics(torch.zeros(LAYOUT.width), torch.ones(LAYOUT.width))])
def test_data_that_stand_still_are_refused(statistics):
    still = dataclasses.replace(cache(), statistics=statistics)
    still.features[:] = still.features[:1].clone()
    with pytest.raises(ValueError, match="training frames are the same, so there is nothing to learn"):
        Dataset(still, LetterCounts(), LAYOUT)


# Several data sets -----------------------------------------------------------------------------------------------


def test_a_feature_that_hardly_varies_in_most_clips_is_divided_by_its_field_s_floor():
    name = next(iter(LAYOUT.slices))
    plain = Dataset(cache(), LetterCounts(), LAYOUT, min_clips=3)
    floored = Dataset(cache(), LetterCounts(), LAYOUT, min_clips=3, floor={name: 100.0})
    assert (floored.motion.std[LAYOUT[name]] == 100).all()
    rest = torch.ones(LAYOUT.width, dtype=torch.bool)
    rest[LAYOUT[name]] = False
    assert torch.equal(floored.motion.std[rest], plain.motion.std[rest])
    with pytest.raises(ValueError, match=r"unknown fields \['height'\]; choose from"):
        Dataset(cache(), LetterCounts(), LAYOUT, min_clips=3, floor={"height": 1.0})


def test_what_is_far_from_the_mean_is_put_at_the_limit():
    near, far = (Dataset(cache(), LetterCounts(), LAYOUT, min_clips=3, limit=limit) for limit in (0.5, 1e9))
    pieces = [ClipBatches(each, "train", BalancedBatches(rows=8))(0) for each in (near, far)]
    for cut, whole in zip(*pieces, strict=True):
        assert torch.equal(cut.motion, whole.motion.clamp(-0.5, 0.5))
        assert whole.motion.abs().max() > 0.5


def test_text_statistics_that_are_given_are_kept():
    given = Statistics(torch.zeros(8), torch.full((8,), 2.0))
    assert Dataset(cache(), LetterCounts(), LAYOUT, min_clips=3, text=given).text.std.tolist() == [2.0] * 8


@pytest.fixture(scope="module")
def two_data_sets(tmp_path_factory) -> Dataset:
    """Ten walks of zeros and a bit, in one folder; ten drinks of ones and a bit in another."""
    folder, generator = tmp_path_factory.mktemp("caches"), torch.Generator().manual_seed(0)
    for name, parts, value in (("walk", ("legs",), 0.0), ("drink", ("left arm", "right arm"), 1.0)):
        motion = value + 0.01 * torch.randn(400, SmplRepresentation.layout.width, generator=generator)
        clips = tuple(
            Clip(f"{name}_{number}", name, "", name, parts, True, False, "train", 40 * number, 40 * number + 40)
            for number in range(10)
        )
        Cache(20.0, "smpl", motion, clips, {name: ((name, 1.0),)}).write(folder / name)
    cache = read_caches([folder / "walk", str(folder / "drink")])
    return Dataset(cache, LetterCounts(), SmplRepresentation.layout, min_clips=1)


@pytest.mark.parametrize(
    ("shares", "donor", "receiver"),
    [({"compose_prob": 0.5}, "drink", "walk"), ({"compose_legs_prob": 0.5}, "walk", "drink")],
    ids=("arms on a walk", "legs under a drink"),
)
def test_contents_of_two_data_sets_are_drawn_as_one_and_compose_with_each_other(two_data_sets, shares, donor, receiver):
    dataset = two_data_sets
    batches = ClipBatches(
        dataset, "train", BalancedBatches(rows=64, receivers="any", uncond_crop_prob=0.0, text_dropout=0.0, **shares)
    )
    drawn = Counter(dataset.clips[clip].content for plan in batches.plans(0) for clip in plan.body.clip)
    assert set(drawn) == {"walk", "drink"}
    rows = [
        (plan, row, dataset._compose(dataset._cut(plan.body), plan)[row])
        for plan in batches.plans(0)
        for row in np.flatnonzero(plan.donor.frames)
    ]
    assert rows
    for plan, row, motion in rows:
        contents = [dataset.clips[stretch.clip[row]].content for stretch in (plan.body, plan.donor)]
        assert contents == [receiver, donor]
        middle = plan.offset[row] + plan.donor.frames[row] // 2
        assert abs(float(motion[middle, 0])) < 0.1  # the pelvis' height is the legs', and these are a walk's in both
