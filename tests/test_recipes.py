"""Recipes of batches draw the same rows in every version: a training that resumes goes on with the batches it had."""

import dataclasses
import hashlib

import numpy as np
import pytest
import torch
from helpers.scripts import configured
from hydra.utils import instantiate
from test_rows_of_texts import OneWord

from stmc.data.cache import Cache, Clip
from stmc.motion.representation import SmplRepresentation
from stmc.settings.records import SettingError, field_infos
from stmc.training.data.balanced_batches import BalancedBatches
from stmc.training.data.batches import ClipBatches
from stmc.training.data.dataset import BatchPlan, Dataset
from stmc.training.data.epoch_batches import EpochBatches
from stmc.training.data.packed_rows import PackedRows
from stmc.training.data.recorded_rows import RecordedRows

PARTS = [("legs",), ("right arm",), ("left arm", "right arm"), ("head",), (), ("legs", "spine")]


@pytest.fixture(scope="module")
def dataset() -> Dataset:
    """150 contents of one to four clips that follow each other, some of one recording, cyclic or from their start."""
    rng, clips, start = np.random.default_rng(5), [], 0
    for content in range(150):
        whole = start, start + int((lengths := rng.integers(20, 250, 1 + content % 4)).sum())
        for number, frames in enumerate(lengths.tolist()):
            clip = Clip(
                name=f"{content}/{number}",
                content=f"content {content}" if content % 5 else f"shared {content % 3}",
                style="",
                texts=f"{content % 70}",
                parts=PARTS[content % 6],
                cyclic=content % 6 in (0, 3) or content % 11 == 0,
                mirrored=False,
                split="val" if content % 9 == 8 else "train",
                start=start,
                end=start + frames,
                recording=f"{content}" if content % 2 else "",
                annotations=1 + (content + number) % 3,
                whole=() if content % 3 else whole,
                from_start=content % 7 == 0,
            )
            clips.append(clip)
            start += frames
    texts = {f"{n}": ((f"say {'a' * (n % 9)}{'e' * (n // 9)}", 0.5), (f"tell {'it' * n}", 0.5)) for n in range(70)}
    features = 0.5 * torch.randn(start, 205, generator=torch.Generator().manual_seed(3))
    pairs = [(f"content {a}", f"content {b}") for a in range(1, 60) for b in range(60, 130)]
    joined = {frozenset(pair): ("{} while {}".format(*pair), "{1} and {0}".format(*pair)) for pair in pairs}
    cache = Cache(20.0, "smpl", features, tuple(clips), texts)
    return Dataset(cache, OneWord(), SmplRepresentation().layout, min_clips=0, joined=joined)


def digest(plans: list[BatchPlan]) -> str:
    """Of all whole numbers of the plans: clips, first and last frames, lengths, sentences, compositions, rows."""
    found = hashlib.sha256()
    for plan in plans:
        crops = [getattr(each, name) for each in (plan.body, plan.donor) for name in ("clip", "start", "end", "frames")]
        for numbers in (*crops, plan.sentence, plan.offset, plan.other, plan.row, plan.fade):
            found.update(f"{len(numbers)}".encode() + np.ascontiguousarray(numbers).astype("<i8").tobytes())
    return found.hexdigest()[:12]


DRAWN = {
    "train": "fbf8714fd266 9670cc3bc6e2 86d25083be3f",
    "train_wide": "8dfdae5c3cb5 a37064401e0c c96c5dfece55",
    "train_tmr_wide": "9144caa1a14f f15f891ebd82 60f44a491174",
    "train_flow_wide": "fe7f6047fc01 8c80b654f91b 3b5b4a63c073",
    "train_humanml3d": "7701ee4d91a4 1db26f6943d8 8ec5ce042249",
    "train_humanml3d_fast": "bc78865d4608 a58a93b8f2d8 dbf6332cbea2",
    "train_flow_humanml3d": "380d321d4405 d43edfea96e5 59fbc674ba55",
    "train_flow_babel": "1c76693fd5fe 10eccb4ed44c 29616bd5ccfe",
}
"""Digests of the first pool of training, a later one and one of validation."""


@pytest.mark.parametrize("name", DRAWN)
def test_the_rows_of_a_seed_are_those_of_earlier_versions(name, dataset):
    recipe = instantiate(configured(name).data.sampling)
    train, val = (ClipBatches(dataset, split, recipe, 3) for split in ("train", "val"))
    assert [digest(train.plans(0)), digest(train.plans(17, 1)), digest(val.plans(1))] == DRAWN[name].split()


@pytest.mark.parametrize("recipe", [BalancedBatches, PackedRows, EpochBatches, RecordedRows])
def test_every_setting_of_a_recipe_says_what_it_is_and_its_range_is_checked(recipe):
    assert list(field_infos(recipe)) == [field.name for field in dataclasses.fields(recipe)]
    assert recipe() == recipe(rows=64)
    with pytest.raises(SettingError, match=r"text_dropout=1\.5: must be at least 0 and at most 1"):
        recipe(text_dropout=1.5)
    assert sum(name in vars(recipe)["__annotations__"] for name in field_infos(recipe)) <= 10
