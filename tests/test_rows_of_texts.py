"""Rows of several texts: what follows what, what each frame shows, and which text it belongs to."""

import dataclasses

import numpy as np
import pytest
import torch
from helpers.toy_data import LetterCounts
from test_training import QUICK

from stmc.data.cache import Cache, Clip
from stmc.denoisers import FlowMdm
from stmc.diffusion.schedule import Schedule
from stmc.motion.representation import SmplRepresentation
from stmc.training import Denoising, Settings, Trainer
from stmc.training.data import packed_rows
from stmc.training.data.batches import ClipBatches
from stmc.training.data.dataset import NULL, Dataset
from stmc.training.data.joining import Arrangement
from stmc.training.data.packed_rows import PackedRows, following
from stmc.training.data.pair_batches import PairBatches

FADE, FRAMES = 10, 40
ROTATIONS = SmplRepresentation().layout["rotations"]


class OneWord:
    """Each text one word: how many letters it has, and how many of each of the first ones."""

    name, width = "one word", 4

    def encode(self, texts):
        counts = [[float(text.count(letter)) for letter in "aeit"] for text in texts]
        return torch.tensor(counts)[:, None], torch.ones(len(texts), dtype=torch.long)


def features(value: float, frames: int = FRAMES) -> torch.Tensor:
    raw = torch.full((frames, 205), value)
    raw[:, ROTATIONS] = torch.tensor([1.0, 0, 0, 0, 1.0, 0]).repeat(22)
    raw[:, 0] += torch.linspace(0, 0.01, frames)
    return raw


def dataset(values: list[float], recording: str = "", words=None, **changes) -> Dataset:
    """Clips of a constant value each, end to end; with a `recording`, one that passes from each to the next."""
    clips = [
        Clip(f"clip-{i}", f"content {i}", "", f"text {i}", (), False, False, "train", FRAMES * i, FRAMES * (i + 1))
        for i in range(len(values))
    ]
    clips = tuple(dataclasses.replace(clip, recording=recording, **changes) for clip in clips)
    texts = {f"text {i}": ((f"say {'a' * i}", 1.0),) for i in range(len(values))}
    every = torch.cat([features(value) for value in values])
    cache = Cache(20.0, "smpl", every, clips, texts)
    return Dataset(cache, words or OneWord(), SmplRepresentation().layout, min_clips=1)


def batches(data: Dataset, **settings) -> ClipBatches:
    plain = {"rows": 48, "pool": 1, "pieces": 1, "uncond_crop_prob": 0.0, "text_dropout": 0.0, "trim": 0.0}
    return ClipBatches(data, "train", PackedRows(**plain | {"texts_per_row": (1, 4)} | settings))


# Arrangements ------------------------------------------------------------------------------------------------------


def arrangement() -> Arrangement:
    return Arrangement(np.array([0, 0, 0, 1, 2, 2]), np.array([8, 9, 5, 7, 6, 4]), np.array([0, 4, 0, 0, 0, 2]))


def test_crops_stand_one_after_the_other_and_share_the_frames_of_their_fades():
    rows = arrangement()
    assert rows.begin.tolist() == [0, 4, 13, 0, 0, 4]
    assert rows.lengths.tolist() == [18, 7, 8]
    assert rows.place.tolist() == [0, 1, 2, 0, 0, 1]


def test_a_frame_belongs_to_the_crop_of_which_it_shows_more():
    segments = arrangement().segments()
    assert segments[0].tolist() == [0] * 6 + [1] * 7 + [2] * 5
    assert segments[1].tolist() == [0] * 18
    assert segments[2, :8].tolist() == [0] * 5 + [1] * 3


def test_joined_rows_are_the_crops_and_straight_lines_between_them():
    rows, crops = arrangement(), torch.tensor([1.0, 5.0, 7.0, 2.0, 3.0, 9.0])[:, None, None].expand(6, 9, 1)
    mixed = []

    def blended(frames):
        mixed.append(len(frames))
        return frames

    found = rows.cross_fade(crops.clone(), blended)
    fade = [1 + 4 * k / 5 for k in (1, 2, 3, 4)]
    torch.testing.assert_close(found[0, :, 0], torch.tensor([1.0] * 4 + fade + [5.0] * 5 + [7.0] * 5))
    torch.testing.assert_close(found[1, :7, 0], torch.full((7,), 2.0))
    torch.testing.assert_close(found[2, :8, 0], torch.tensor([3.0] * 4 + [5.0, 7.0] + [9.0] * 2))
    assert mixed == [6]


def test_crops_alone_in_their_rows_are_left_as_they_are():
    crops = torch.randn(3, 5, 2)
    alone = Arrangement(np.arange(3), np.array([5, 4, 3]), np.zeros(3, dtype=int))
    assert alone.cross_fade(crops, lambda frames: frames) is crops


# What follows what -------------------------------------------------------------------------------------------------


def test_a_clip_is_followed_by_the_one_that_its_recording_passes_into_and_by_no_other():
    def clip(name, start, end, recording="r"):
        return Clip(name, name, "", name, (), False, False, "train", start, end, recording)

    clips = [clip("a", 0, 40), clip("b", 44, 80), clip("whole", 0, 80), clip("c", 78, 120), clip("far", 140, 160)]
    clips += [clip("other", 160, 200, "s"), clip("nobody's", 200, 240, ""), clip("nobody's either", 240, 280, "")]
    chosen = np.ones(len(clips), dtype=bool)
    assert following(clips, chosen, 20).tolist() == [1, 3, 3, -1, -1, -1, -1, -1]
    chosen[3] = False
    assert following(clips, chosen, 20).tolist() == [1, -1, -1, -1, -1, -1, -1, -1]


def test_a_recording_that_passes_from_one_action_to_the_next_is_a_row_as_it_was_recorded():
    data = dataset([0.0, 0.5, 1.0], recording="r")
    made, several = batches(data), 0
    for plan, batch in zip(made.plans(0), made(0), strict=True):
        rows = plan.arrangement
        for row in range(len(rows.lengths)):
            mine = np.flatnonzero(plan.row == row)
            passing = plan.fade[mine] == 0
            if len(mine) < 2 or not passing.all():
                continue
            several += 1
            first = plan.body.start[mine[0]]
            raw = data.features[first : first + rows.lengths[row]]
            torch.testing.assert_close(data.motion.restore(batch.motion[row, : rows.lengths[row]]), raw)
            expected = data.features.new_tensor(np.arange(first, first + rows.lengths[row]) // FRAMES).long()
            assert torch.equal(batch.segment[row, : rows.lengths[row]], expected - expected[0])
    assert several > 5


def test_other_crops_follow_where_their_poses_are_near_and_no_crop_is_lost():
    data = dataset([0.0, 0.01, 5.0, 5.01])
    [plan] = batches(data).plans(0)
    assert len(plan.sentence) == 48
    assert (np.bincount(plan.row) > 1).any()
    for row in range(plan.row.max() + 1):
        clips = plan.body.clip[plan.row == row]
        assert len({clip // 2 for clip in clips}) == 1, "near and far values are never in a row"
        assert (np.diff(clips) != 0).all(), "nor the same content twice in a row"


def test_a_cross_fade_leaves_rotations_rotations_and_no_jump():
    data = dataset([0.0, 0.2, 0.4, 0.6])
    made = batches(data)
    [plan], [batch] = made.plans(0), made(0)
    rows = plan.arrangement
    raw = data.motion.restore(batch.motion)
    for row, length in enumerate(rows.lengths):
        steps = raw[row, :length, 100].diff().abs()
        assert len(steps) == 0 or float(steps.max()) <= 0.6 / (FADE + 1) + 1e-4
        first = raw[row, :length, ROTATIONS].unflatten(-1, (22, 6))[..., :3]
        torch.testing.assert_close(first.norm(dim=-1), torch.ones(length, 22), atol=1e-4, rtol=0)


def test_each_frame_is_told_the_sentence_of_its_crop():
    data = dataset([0.0, 0.2, 0.4, 0.6])
    made = batches(data)
    [plan], [batch] = made.plans(0), made(0)
    assert batch.text.shape[1] == np.bincount(plan.row).max() > 1
    assert batch.text_mask is None
    told = batch.text.take_along_dim(batch.segment[..., None], dim=1)
    segments = plan.arrangement.segments()
    for row in range(len(batch.motion)):
        crops = np.flatnonzero(plan.row == row)
        for frame in range(int(plan.arrangement.lengths[row])):
            torch.testing.assert_close(told[row, frame], data._text[plan.sentence[crops[segments[row, frame]]], 0])


def test_a_row_has_a_text_throughout_or_none():
    data = dataset([0.0, 0.1, 0.2, 0.3])
    [plan] = batches(data, rows=96, text_dropout=0.4).plans(0)
    silent = plan.sentence == NULL
    assert silent.any()
    for row in range(plan.row.max() + 1):
        assert len({*silent[plan.row == row]}) == 1
    assert (np.bincount(plan.row[silent]) > 1).any()


def test_the_number_of_texts_is_bounded():
    data = dataset([0.0, 0.1, 0.2, 0.3])
    [plan] = batches(data, texts_per_row=[2, 3]).plans(0)
    counts = np.bincount(plan.row)
    assert counts.max() == 3
    assert (counts > 1).mean() > 0.5  # the last rows find nobody left


def test_pieces_share_out_whole_rows_and_are_the_same_when_asked_again():
    data = dataset([0.0, 0.1, 0.2, 0.3])
    made, again = (batches(data, pool=3, pieces=2) for _ in range(2))
    plans = [plan for step in range(3) for plan in made.plans(step)]
    assert sum(len(plan.sentence) for plan in plans) == 3 * 48
    for plan in plans:
        assert plan.row[0] == 0
        assert set(np.diff(plan.row)) <= {0, 1}
        assert (plan.fade[plan.arrangement.first] == 0).all()
    for one, other in zip(made(2), again(2), strict=True):
        assert torch.equal(one.motion, other.motion)
        assert torch.equal(one.segment, other.segment)


def test_crops_too_short_to_fade_are_rows_of_their_own(monkeypatch):
    monkeypatch.setattr(packed_rows, "FADE", 1.0)
    assert np.bincount(batches(dataset([0.0, 0.1, 0.2])).plans(0)[0].row).max() == 1  # 40 frames, of which 20 and 20


# Who may have them -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("wrong", [(0, 2), (3, 2), (1, 2, 3), (1, 1), (1, 2.5)])
def test_a_number_of_texts_that_cannot_be_meant_is_an_error(wrong):
    with pytest.raises(ValueError, match="texts_per_row"):
        PackedRows(texts_per_row=wrong)


def test_texts_of_several_words_and_pairs_are_refused():
    with pytest.raises(ValueError, match="PackedRows needs a text encoder that returns one word per text"):
        batches(dataset([0.0, 0.1], words=LetterCounts()))
    with pytest.raises(ValueError, match="pairs need one text per row: PackedRows makes rows of several"):
        PairBatches(batches(dataset([0.0, 0.1])))


def flow(folder, steps: int) -> Trainer:
    torch.manual_seed(0)
    data = dataset([0.0, 0.2, 0.4, 0.6])
    network = FlowMdm(205, 4, absolute_from=10, width=16, feedforward=32, layers=2, heads=2, attention_window=20)
    sampling = {"rows": 8, "pool": 2}
    return Trainer(
        network,
        Denoising(Schedule.cosine(20), fields=SmplRepresentation().layout.slices),
        batches(data, **sampling),
        folder,
        Settings(**QUICK | {"steps": steps, "lr_decay_steps": 24, "precision": "fp32"}),
    )


def test_training_on_several_texts_learns_and_goes_on_exactly_where_it_was(tmp_path):
    whole = flow(tmp_path / "whole", 24)
    pieces = [piece for step in range(4) for piece in whole.batches(step)]
    assert any(piece.segment is not None for piece in pieces)

    def loss(network):
        network.eval()
        noise = torch.Generator().manual_seed(0)
        with torch.no_grad():
            terms = sum(whole.objective(network, piece, noise) for piece in pieces)
        return float(terms.mean()) / sum(piece.frames for piece in pieces)

    before = loss(whole.network)
    whole.network.train()
    whole.run()
    assert loss(whole.network) < 0.9 * before
    flow(tmp_path / "two", 12).run()
    resumed = flow(tmp_path / "two", 24)
    assert resumed.step == 12
    resumed.run()
    for one, other in zip(whole.network.parameters(), resumed.network.parameters(), strict=True):
        assert torch.equal(one, other)
