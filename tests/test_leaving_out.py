"""Recordings and sentences that a training leaves out."""

import torch
from helpers.scripts import configured

from stmc.data.cache import Cache, Clip
from stmc.evaluation.benchmarks.mtt_checks import MTT_CHECKS
from stmc.training.data.leaving_out import leave_out


def test_clips_of_an_actor_are_held_out_with_what_was_edited_from_them_and_a_sentence_is_gone():
    names = ("13_09/1", "M/13_09/1", "hop-left/edited/000/13_11", "113_01/0", "14_01/0")
    clips = tuple(Clip(name, "walk", "", "key", (), True, False, "train", 0, 5) for name in names)
    cache = Cache(20, "smpl", torch.zeros(5, 205), clips, {"key": (("walk", 0.5), ("go", 0.3), ("march", 0.2))})
    left = leave_out(cache, ["13_*"], ["walk"])
    assert [clip.split for clip in left.clips] == ["test", "test", "test", "train", "train"]
    assert left.texts == {"key": (("go", 0.6), ("march", 0.4))}


def test_the_second_judge_of_mtt_has_not_read_its_texts():
    assert set(configured("train_tmr_mtt").data.dataset.without_texts) == set(MTT_CHECKS)
