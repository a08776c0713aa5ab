"""Recordings and sentences that a training leaves out."""

import pytest
import torch
from helpers.scripts import configured

from stmc.data.cache import Cache, Clip
from stmc.evaluation.benchmarks.mtt_checks import MTT_CHECKS
from stmc.training.data.leaving_out import leave_out

NAMES = ("13_09/1", "M/13_09/1", "hop-left/edited/000/13_11", "113_01/0", "14_01/0")
CLIPS = tuple(Clip(name, "walk", "", "key", (), True, False, "train", 0, 5) for name in NAMES)
CACHE = Cache(20, "smpl", torch.zeros(5, 205), CLIPS, {"key": (("walk", 0.5), ("go", 0.3), ("march", 0.2))})


def test_clips_of_an_actor_are_held_out_with_what_was_edited_from_them_and_a_sentence_is_gone():
    left = leave_out(CACHE, ["13_*"], ["walk"])
    assert [clip.split for clip in left.clips] == ["test", "test", "test", "train", "train"]
    assert left.texts == {"key": (("go", 0.6), ("march", 0.4))}


def test_a_pattern_that_matches_nothing_is_named():
    with pytest.raises(
        ValueError, match=r"no recording matches 31_\*, elderly; a pattern matches a part of a name such as 13_09/1"
    ):
        leave_out(CACHE, ["13_*", "31_*", "elderly"], [])


def test_the_second_judge_of_mtt_has_not_read_its_texts():
    assert set(configured("train_tmr_mtt").data.dataset.without_texts) == set(MTT_CHECKS)
