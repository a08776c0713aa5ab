"""Batches: reproducible, balanced, never empty, and of real frames only."""

import dataclasses
from collections import Counter

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from toys import FPS, LAYOUT, LetterCounts, cache

from stmc.body import BodyPart
from stmc.body_model import Skeleton
from stmc.data.batches import ClipBatches, Sampling
from stmc.data.cache import Cache, Clip, read_caches
from stmc.data.dataset import NULL, SEAM, Corpus, Draws
from stmc.representation import Field, Layout, SmplRepresentation
from stmc.statistics import Statistics


@pytest.fixture(scope="module")
def corpus() -> Corpus:
    return Corpus(cache(), LetterCounts(), LAYOUT, least=3)


def draw(corpus: Corpus, count: int = 4000, split: str = "train", **settings):
    """Many draws, and the clip that each is from."""
    batches = ClipBatches(corpus, split, Sampling(**settings))
    draws = batches._draw(count, np.random.default_rng(0))
    starts = np.array([clip.start for clip in corpus.clips])
    return draws, [corpus.clips[index] for index in np.searchsorted(starts, draws.body.start, side="right") - 1]


def same(one, other) -> bool:
    tensors = ((getattr(one, name), getattr(other, name)) for name in ("motion", "mask", "text", "text_mask"))
    return all((a is None and b is None) or torch.equal(a, b) for a, b in tensors)


def one_content(lengths: list[int], cyclic: bool) -> Corpus:
    starts = np.cumsum([0, *lengths])
    clips = tuple(
        Clip(
            f"clip-{i}", "walk", "normal", "walk", ("legs",), cyclic, False, "train", int(starts[i]), int(starts[i + 1])
        )
        for i in range(len(lengths))
    )
    motion = torch.arange(float(starts[-1]))[:, None].expand(-1, LAYOUT.width)  # every frame knows its place
    texts = {"walk": (("walk", 1.0),)}
    return Corpus(Cache(FPS, "toy", motion.contiguous(), clips, texts), LetterCounts(), LAYOUT, least=1)


def test_a_steps_batch_is_the_same_whenever_it_is_asked_for(corpus):
    sampling = Sampling(rows=6, pool=3, pieces=2, slowest=0.8, fastest=1.25)
    in_order = ClipBatches(corpus, "train", sampling, seed=7)
    batches = [in_order(step) for step in range(8)]
    again = ClipBatches(corpus, "train", sampling, seed=7)
    for step in (5, 0, 7):
        assert all(same(a, b) for a, b in zip(again(step), batches[step], strict=True))


def test_seeds_processes_steps_and_splits_draw_differently(corpus):
    sampling = Sampling(rows=6, pool=2, pieces=1)
    train, other = ClipBatches(corpus, "train", sampling), ClipBatches(corpus, "train", sampling, seed=1)
    [first] = train(0)
    for different in (train(1), train(2), train(0, process=1), other(0), ClipBatches(corpus, "val", sampling)(0)):
        assert not same(first, different[0])


def test_only_clips_of_the_split_are_drawn(corpus):
    for split in ("train", "val"):
        assert {clip.split for clip in draw(corpus, split=split, crops=0.3)[1]} == {split}


@pytest.mark.parametrize("balance", [0.0, 0.5, 1.0])
def test_contents_are_drawn_by_the_power_of_their_number_of_clips(corpus, balance):
    _, clips = draw(corpus, balance=balance, crops=0.0)
    walks, raises = 10, 5  # training clips
    share = sum(clip.content == "walk" for clip in clips) / len(clips)
    assert share == pytest.approx(walks**balance / (walks**balance + raises**balance), abs=0.03)


def test_a_content_of_too_few_clips_is_seen_only_without_text(corpus):
    _, clips = draw(corpus, crops=0.0)
    assert "kick" not in {clip.content for clip in clips}
    draws, clips = draw(corpus, crops=1.0)
    assert "kick" in {clip.content for clip in clips}
    assert (draws.sentence == NULL).all()
    assert "kick" not in corpus.sentences


def test_crops_without_text_are_there_short_and_anywhere(corpus):
    draws, _ = draw(corpus, crops=0.25, silent=0.0)
    assert (draws.sentence == NULL).mean() == pytest.approx(0.25, abs=0.03)
    draws, clips = draw(corpus, crops=1.0)
    assert draws.body.frames.min() == 10
    assert draws.body.frames.max() == 60
    ends = np.array([clip.end for clip in clips])
    starts = np.array([clip.start for clip in clips])
    assert (draws.body.start == starts).any()
    assert (draws.body.start + draws.body.frames == ends).any()


def test_texts_are_lost_as_often_as_asked(corpus):
    draws, _ = draw(corpus, crops=0.0, silent=0.1)
    assert (draws.sentence == NULL).mean() == pytest.approx(0.1, abs=0.02)


def test_sentences_are_drawn_by_their_probabilities(corpus):
    draws, clips = draw(corpus, crops=0.0, silent=0.0)
    said = [corpus.sentences[s] for s, clip in zip(draws.sentence, clips, strict=True) if clip.content == "walk"]
    assert set(said) == {"walk", "a walk"}
    assert said.count("walk") / len(said) == pytest.approx(0.75, abs=0.03)


@given(
    lengths=st.lists(st.integers(1, 400), min_size=2, max_size=4),
    cyclic=st.booleans(),
    trim=st.floats(0, 0.49),
    crops=st.sampled_from([0.0, 0.5]),
    speed=st.sampled_from([(1.0, 1.0), (0.5, 2.0), (1.3, 3.0)]),
)
def test_a_row_is_never_empty_never_too_long_and_within_its_clip(lengths, cyclic, trim, crops, speed):  # R4
    corpus = one_content(lengths, cyclic)
    draws, clips = draw(
        corpus, 300, trim=trim, crops=crops, slowest=speed[0], fastest=speed[1], shortest=1.0, longest=8.0
    )
    assert draws.body.frames.min() >= 1
    assert draws.body.frames.max() <= 160
    ends = np.array([clip.end for clip in clips])
    assert (draws.body.start + (draws.body.frames - 1) * draws.body.speed <= ends - 1 + 1e-9).all()
    assert (draws.body.end == ends).all()


def test_a_clip_that_is_not_cyclic_keeps_its_middle():
    draws, clips = draw(one_content([50, 100], cyclic=False), trim=0.12, crops=0.0)
    for start, frames, clip in zip(draws.body.start, draws.body.frames, clips, strict=True):
        most = int(0.12 * (clip.end - clip.start))
        assert clip.start <= start <= clip.start + most
        assert clip.end - most <= start + frames <= clip.end
    assert len({*draws.body.start}) > 10


def test_a_cyclic_clip_is_cut_to_any_stretch_that_is_long_enough():
    draws, _ = draw(one_content([100, 20], cyclic=True), crops=0.0, shortest=1.5)
    long = draws.body.frames[draws.body.end == 100]
    assert (long.min(), long.max()) == (30, 100)
    assert set(draws.body.frames[draws.body.end == 120]) == {20}  # shorter than the shortest: whole


def test_rows_are_normalised_frames_of_their_clips_and_padding_is_zero(corpus):
    batches = ClipBatches(corpus, "train", Sampling(rows=16, pool=1, pieces=1))
    draws = batches._draw_pool(0, 0)[0]
    [batch] = batches(0)
    assert batch.frames == draws.body.frames.sum() == batch.mask.sum()
    for row, (start, frames, sentence) in enumerate(
        zip(draws.body.start, draws.body.frames, draws.sentence, strict=True)
    ):
        raw = corpus.features[start : start + frames]
        torch.testing.assert_close(corpus.motion.restore(batch.motion[row, :frames]), raw)
        assert batch.mask[row, :frames].all()
        assert not batch.mask[row, frames:].any()
        assert not batch.motion[row, frames:].any()
        words, _ = LetterCounts().encode([corpus.sentences[sentence]])
        torch.testing.assert_close(corpus.text.restore(batch.text[row, : words.shape[1]]), words[0])
        assert int(batch.text_mask[row].sum()) == words.shape[1]
        assert not batch.text[row, words.shape[1] :].any()


def test_masks_are_left_out_where_nothing_is_padded():
    [batch] = ClipBatches(one_content([40] * 4, cyclic=False), "train", Sampling(trim=0.0, crops=0.0, pieces=1))(0)
    assert batch.mask is None
    assert batch.text_mask is None


def test_no_text_is_the_empty_text_not_zeros(corpus):
    assert corpus.sentences[NULL] == ""
    [batch] = ClipBatches(corpus, "train", Sampling(rows=3, crops=1.0, pieces=1))(0)
    torch.testing.assert_close(batch.text[:, 0], corpus.text.normalise(torch.zeros(len(batch.text), 8)))


def test_statistics_are_those_of_the_training_clips_alone():
    data = cache()
    corpus = Corpus(data, LetterCounts(), LAYOUT, floor={name: 0.01 for name in LAYOUT.slices}, least=3)
    rows = torch.cat([data.features[clip.start : clip.end] for clip in data.clips if clip.split == "train"])
    torch.testing.assert_close(corpus.motion.mean, rows.mean(dim=0))
    torch.testing.assert_close(corpus.motion.std, rows.std(dim=0, correction=0).clamp_min(0.01))
    assert corpus.motion.std[4] == 0.01  # a number that never changes
    words = torch.cat([LetterCounts().encode([text])[0][0] for text in ("walk", "a walk", "raise the arm")])
    torch.testing.assert_close(corpus.text.mean, words.mean(dim=0))


def test_a_pool_is_sorted_so_that_little_is_padding_and_nothing_is_lost(corpus):
    sampling = Sampling(rows=32, pool=8, pieces=2)
    batches = ClipBatches(corpus, "train", sampling)
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
    corpus = Corpus(dataclasses.replace(data, features=moving), LetterCounts(), LAYOUT, least=3)
    draws, _ = draw(corpus, 100, trim=0.0, crops=0.0, slowest=0.8, fastest=1.25)
    raw = corpus._cut(draws.body)
    for row, (start, frames, speed) in enumerate(
        zip(draws.body.start, draws.body.frames, draws.body.speed, strict=True)
    ):
        source = frames * speed
        whole = int(source + 1e-6)
        distance = moving[start : start + whole, 0].sum() + (source - whole) * moving[start + whole - 1, 0]
        assert abs(raw[row, :frames, 0].sum() - distance) < 1.01 * abs(source - whole) + 1e-3
    assert (draws.body.frames < 0.85 * (draws.body.frames * draws.body.speed)).any()


def test_a_change_of_speed_interpolates_poses_and_keeps_rotations_rotations(corpus):
    draws, _ = draw(corpus, 50, crops=0.0, slowest=0.6, fastest=1.6)
    raw = corpus._cut(draws.body)
    first, second = raw[..., 2:5], raw[..., 5:8]
    for vector in (first, second):
        torch.testing.assert_close(vector.norm(dim=-1), torch.ones(raw.shape[:2]))
    torch.testing.assert_close((first * second).sum(dim=-1), torch.zeros(raw.shape[:2]), atol=1e-5, rtol=0)
    for row, (start, speed) in enumerate(zip(draws.body.start, draws.body.speed, strict=True)):
        place = start + 3 * speed
        low, share = int(place), place - int(place)
        expected = torch.lerp(corpus.features[low, 8:], corpus.features[low + 1, 8:], share)
        torch.testing.assert_close(raw[row, 3, 8:], expected)


def test_unchanged_speed_gives_the_very_frames_by_both_ways(corpus):
    draws, _ = draw(corpus, 20)
    barely = dataclasses.replace(draws.body, speed=draws.body.speed * (1 + 1e-12))
    torch.testing.assert_close(corpus._cut(draws.body), corpus._cut(barely), atol=1e-5, rtol=1e-5)


def test_a_layout_that_does_not_fit_is_an_error():
    with pytest.raises(ValueError, match="11 features, the layout 3"):
        Corpus(cache(), LetterCounts(), Layout((Field("positions", 3),)))


def test_nothing_to_train_on_is_an_error(corpus):
    with pytest.raises(ValueError, match="no content has 100 training clips"):
        Corpus(cache(), LetterCounts(), LAYOUT, least=100)
    with pytest.raises(ValueError, match="no clip of split 'tests'"):
        ClipBatches(corpus, "tests", Sampling())


@pytest.mark.parametrize(
    "wrong",
    [
        {"rows": 0},
        {"pieces": 65},
        {"trim": 0.5},
        {"crops": 1.1},
        {"slowest": 0.0},
        {"shortest": 11.0},
        {"fastest": 0.5},
    ],
)
def test_sampling_that_cannot_be_meant_is_an_error(wrong):
    with pytest.raises(ValueError, match=next(iter(wrong))):
        Sampling(**wrong)


def test_what_comes_with_the_data_is_used(corpus):
    given = Statistics(torch.ones(LAYOUT.width), torch.full((LAYOUT.width,), 2.0))
    own = dataclasses.replace(cache(), statistics=given, skeleton=Skeleton.default())
    other = Corpus(own, LetterCounts(), LAYOUT, least=1)
    assert torch.equal(other.motion.std, given.std)
    assert other.skeleton is own.skeleton
    assert corpus.skeleton is None
    assert not torch.equal(corpus.motion.std, given.std)


def composing(composed: float) -> ClipBatches:
    """Twelve walks (all features 1) and twelve raises of the right arm (all features 2)."""
    clips, start = [], 0
    for i in range(24):
        walk = i % 2 == 0
        name, part, frames = ("walk", "legs", 60) if walk else ("raise", "right arm", 40)
        clips.append(Clip(f"{name}-{i}", name, "normal", name, (part,), walk, False, "train", start, start + frames))
        start += frames
    features = torch.cat([torch.full((clip.end - clip.start, 205), 1.0 + (clip.content == "raise")) for clip in clips])
    texts = {name: ((name, 1.0),) for name in ("walk", "raise")}
    corpus = Corpus(Cache(20.0, "smpl", features, tuple(clips), texts), LetterCounts(), SmplRepresentation().layout)
    return ClipBatches(corpus, "train", Sampling(rows=96, crops=0.0, silent=0.0, pool=1, pieces=1, composed=composed))


def rows_of(batches: ClipBatches) -> tuple[Draws, torch.Tensor]:
    batches(0)
    [draws] = batches._pool[1]
    return draws, batches.corpus._composed(batches.corpus._cut(draws.body), draws)


def arm() -> torch.Tensor:
    """Columns of the right arm but those of rotations, which do not blend linearly."""
    columns = torch.tensor(SmplRepresentation().columns[BodyPart.RIGHT_ARM])
    return columns[columns >= SmplRepresentation().layout["positions"].start]


def test_a_guest_that_fills_a_row_keeps_its_arm_and_its_text_and_walks_on_another_body() -> None:
    batches = composing(1.0)
    draws, raw = rows_of(batches)
    filled = np.flatnonzero(draws.guest.frames == draws.body.frames)
    assert len(filled) > 10
    legs = SmplRepresentation().layout["root_velocity"]
    for row in filled:
        frames = draws.body.frames[row]
        assert (raw[row, :frames, arm()] == 2).all()
        assert (raw[row, :frames, legs] == 1).all()
        assert batches.corpus.clips[draws.body.clip[row]].content == "walk"
    assert {batches.corpus.sentences[draws.sentence[row]] for row in filled} >= {"raise"}


def test_a_guest_within_a_walk_comes_and_goes_under_the_text_of_the_walk() -> None:
    batches = composing(1.0)
    draws, raw = rows_of(batches)
    within = np.flatnonzero((draws.guest.frames > 0) & (draws.guest.frames < draws.body.frames))
    assert len(within) > 5
    for row in within:
        assert batches.corpus.sentences[draws.sentence[row]] == "walk"
        first, frames = draws.offset[row], draws.guest.frames[row]
        shown = raw[row, : draws.body.frames[row], arm()].mean(dim=1)
        expected = torch.ones(len(shown))
        for frame in range(frames):  # a ramp of `SEAM` frames where the walk goes on beyond the guest
            come = (frame + 1) / (SEAM + 1) if first else 1.0
            go = (frames - frame) / (SEAM + 1) if first + frames < len(shown) else 1.0
            expected[first + frame] += min(come, go, 1.0)
        torch.testing.assert_close(shown, expected)
        assert (raw[row, : len(shown), SmplRepresentation().layout["root_velocity"]] == 1).all()


def test_any_body_with_other_parts_can_be_a_host_and_shows_its_own_text_only_where_it_is_whole() -> None:
    clips, start = [], 0
    for number in range(36):
        name, part, frames = [("turn", "legs", 60), ("left", "left arm", 50), ("right", "right arm", 40)][number % 3]
        clips.append(Clip(f"{name}-{number}", name, "", name, (part,), False, False, "train", start, start + frames))
        start += frames
    texts = {name: ((name, 1.0),) for name in ("turn", "left", "right")}
    features = torch.arange(start * 205.0).reshape(start, 205)
    data = Cache(20.0, "smpl", features, tuple(clips), texts)
    corpus = Corpus(data, LetterCounts(), SmplRepresentation().layout)
    settings = {"crops": 0.0, "silent": 0.0, "trim": 0.0, "pool": 1, "pieces": 1, "composed": 1.0}
    [walking] = ClipBatches(corpus, "train", Sampling(rows=96, **settings)).draws(0)
    assert not walking.guest.frames.any()  # nobody walks
    [draws] = ClipBatches(corpus, "train", Sampling(rows=96, hosts="any", **settings)).draws(0)
    pairs = Counter()
    for row in np.flatnonzero(draws.guest.frames):
        host, guest = corpus.clips[draws.body.clip[row]], corpus.clips[draws.guest.clip[row]]
        pairs[host.content, guest.content] += 1
        whole = draws.body.frames[row] == host.end - host.start
        assert whole or draws.body.frames[row] == draws.guest.frames[row]
        said = [corpus.sentences[each[row]] for each in (draws.sentence, draws.other)]
        assert said == [host.content if whole else guest.content, guest.content]
    assert set(pairs) == {("turn", "left"), ("turn", "right"), ("left", "right")}


def test_without_compositions_no_row_has_a_guest() -> None:
    draws, raw = rows_of(composing(0.0))
    assert not draws.guest.frames.any()
    assert all((raw[row, :frames] == raw[row, 0]).all() for row, frames in enumerate(draws.body.frames))


# Several data sets -----------------------------------------------------------------------------------------------


def test_a_feature_that_hardly_varies_in_most_clips_is_divided_by_its_field_s_floor():
    name = next(iter(LAYOUT.slices))
    plain = Corpus(cache(), LetterCounts(), LAYOUT, least=3)
    floored = Corpus(cache(), LetterCounts(), LAYOUT, least=3, floor={name: 100.0})
    assert (floored.motion.std[LAYOUT[name]] == 100).all()
    rest = torch.ones(LAYOUT.width, dtype=torch.bool)
    rest[LAYOUT[name]] = False
    assert torch.equal(floored.motion.std[rest], plain.motion.std[rest])
    with pytest.raises(KeyError, match="no field 'height'; choose from"):
        Corpus(cache(), LetterCounts(), LAYOUT, least=3, floor={"height": 1.0})


def test_what_is_far_from_the_mean_is_put_at_the_limit():
    near, far = (Corpus(cache(), LetterCounts(), LAYOUT, least=3, limit=limit) for limit in (0.5, 1e9))
    pieces = [ClipBatches(each, "train", Sampling(rows=8))(0) for each in (near, far)]
    for cut, whole in zip(*pieces, strict=True):
        assert torch.equal(cut.motion, whole.motion.clamp(-0.5, 0.5))
        assert whole.motion.abs().max() > 0.5


def test_text_statistics_that_are_given_are_kept():
    given = Statistics(torch.zeros(8), torch.full((8,), 2.0))
    assert Corpus(cache(), LetterCounts(), LAYOUT, least=3, text=given).text.std.tolist() == [2.0] * 8


@pytest.fixture(scope="module")
def two_data_sets(tmp_path_factory) -> Corpus:
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
    return Corpus(cache, LetterCounts(), SmplRepresentation.layout, least=1)


@pytest.mark.parametrize(
    ("shares", "guest", "host"),
    [({"composed": 0.5}, "drink", "walk"), ({"composed_legs": 0.5}, "walk", "drink")],
    ids=("arms on a walk", "legs under a drink"),
)
def test_contents_of_two_data_sets_are_drawn_as_one_and_compose_with_each_other(two_data_sets, shares, guest, host):
    corpus = two_data_sets
    batches = ClipBatches(corpus, "train", Sampling(rows=64, hosts="any", crops=0.0, silent=0.0, **shares))
    drawn = Counter(corpus.clips[clip].content for draws in batches.draws(0) for clip in draws.body.clip)
    assert set(drawn) == {"walk", "drink"}
    rows = [
        (draws, row, corpus._composed(corpus._cut(draws.body), draws)[row])
        for draws in batches.draws(0)
        for row in np.flatnonzero(draws.guest.frames)
    ]
    assert rows
    for draws, row, motion in rows:
        contents = [corpus.clips[stretch.clip[row]].content for stretch in (draws.body, draws.guest)]
        assert contents == [host, guest]
        middle = draws.offset[row] + draws.guest.frames[row] // 2
        assert abs(float(motion[middle, 0])) < 0.1  # the pelvis' height is the legs', and these are a walk's in both


@pytest.mark.parametrize("statistics", [None, Statistics(torch.zeros(LAYOUT.width), torch.ones(LAYOUT.width))])
def test_data_that_stand_still_are_refused(statistics):
    still = dataclasses.replace(cache(), statistics=statistics)
    still.features[:] = still.features[:1].clone()
    with pytest.raises(ValueError, match="training frames is the same: there is nothing to learn"):
        Corpus(still, LetterCounts(), LAYOUT)
