"""The published training's rows, counted: on files in the true formats, and against what a slow oracle expects."""

import math
from collections import Counter

import numpy as np
import pytest
import torch
from helpers.scripts import configured
from helpers.source_folders import Serial, amass, published
from helpers.toy_data import FPS, LAYOUT, LetterCounts
from hydra.utils import instantiate
from numpy.random import default_rng
from torch.testing import assert_close

from stmc.data import preparation
from stmc.data.cache import Cache, Clip
from stmc.data.sources.amass.annotated_amass import AnnotatedAmass
from stmc.motion.representation import SmplRepresentation
from stmc.training.data.batches import ClipBatches, SplitClips
from stmc.training.data.dataset import NULL, BatchPlan, Dataset
from stmc.training.data.epoch_batches import EpochBatches, Epochs

RUB, KICK = "BioMotionLab_NTroje/rub001/0000_treadmill_norm_poses", "KIT/3/kick_high_left02_poses"
ENTRIES = {
    "000000": (KICK, "train", (("walks", 0.0, 2.0), ("walks", 0.0, 2.0), ("walks", 0.0, 2.0), ("lifts", 0.5, 3.0))),
    "M000000": (f"M/{KICK}", "train", (("strolls", 0.0, 2.0),)),
    "000001": (RUB, "train", (("goes", 1.0, 3.0), ("a person goes", 1.0, 3.0))),
    "000002": (RUB, "train", (("goes", 0.0, 2.5),)),
    "000003": ("CMU/01/01_01_poses", "val", (("stops", 0.0, 3.0),)),
}
"""By hand: 4 entries for training with 5 clips; of 000000 one clip has three annotations, the other one."""


@pytest.fixture(scope="module")
def dataset(tmp_path_factory) -> Dataset:
    folder, patch = tmp_path_factory.mktemp("humanml3d"), pytest.MonkeyPatch()
    annotations, settings = published(folder / "annotations", ENTRIES), configured("train_humanml3d", "run=x").data
    patch.setattr(preparation, "ProcessPoolExecutor", lambda workers, **_: Serial(workers))
    source = AnnotatedAmass(amass(folder / "AMASS"), annotations, 20, SmplRepresentation())
    cache = source.prepared(folder / "pieces", 1, lambda pieces, total: pieces)
    patch.undo()
    return instantiate(settings.dataset, _partial_=True)(cache, LetterCounts(), SmplRepresentation.layout)


def published_recipe(**changes) -> EpochBatches:
    return instantiate(configured("train_humanml3d", "run=x").data.sampling, **changes)


def drawn(dataset: Dataset, epochs: int, **changes) -> BatchPlan:
    """The rows of so many epochs, as one plan."""
    clips, recipe = SplitClips(dataset, "train"), published_recipe(**changes)
    epoch = Epochs(dataset.clips, clips.described, recipe.rows, [0])
    return recipe.draw_crops(clips, np.concatenate([epoch(number) for number in range(epochs)]), default_rng(0))


def test_every_entry_comes_once_an_epoch_and_the_last_batch_holds_what_is_left(dataset):
    recipe = published_recipe(rows=3)
    batches = ClipBatches(dataset, "train", recipe, seed=1)
    orders = set()
    for epoch in range(20):
        sizes = [len(plan.sentence) for step in (0, 1) for plan in batches.plans(2 * epoch + step)]
        drawn = [
            dataset.clips[clip].content
            for step in (0, 1)
            for plan in batches.plans(2 * epoch + step)
            for clip in plan.body.clip
        ]
        assert sizes == [3, 1]
        assert sorted(drawn) == ["000000", "000001", "000002", "M000000"]
        orders.add(tuple(drawn))
    assert len(orders) > 4
    again = ClipBatches(dataset, "train", recipe, seed=1)
    assert (again.plans(7)[0].body.clip == batches.plans(7)[0].body.clip).all()
    assert published_recipe().rows == 128 and published_recipe().pooling == (1, 1)


def test_annotations_of_an_entry_weigh_alike(dataset):
    count = Counter()
    plan = drawn(dataset, 2000, uncond_crop_prob=0.0, text_dropout=0.0, trim=0.0)
    for clip, sentence in zip(plan.body.clip, plan.sentence, strict=True):
        count[dataset.clips[clip].content, dataset.sentences[sentence]] += 1
    assert count["M000000", "strolls"] == count["000002", "goes"] == 2000
    assert count["000000", "lifts"] == pytest.approx(500, abs=5 * math.sqrt(2000 * 3 / 16))
    assert count["000001", "goes"] == pytest.approx(1000, abs=5 * math.sqrt(500))


def test_a_tenth_has_no_text_and_half_of_it_is_cut_from_the_whole_recording(dataset):
    plan, crops, outside, lengths = drawn(dataset, 5000), 0, 0, Counter()
    for row, clip in enumerate(dataset.clips[index] for index in plan.body.clip):
        first, frames = int(plan.body.start[row]), int(plan.body.frames[row])
        trimmed = clip.start <= first and first + frames <= clip.end and frames >= 0.9 * (clip.end - clip.start)
        begin, end = clip.whole
        assert end - begin == 64 and begin <= first and first + frames <= end
        if not trimmed:
            assert plan.sentence[row] == NULL
            crops, lengths[frames] = crops + 1, lengths[frames] + 1
            outside += first < clip.start or first + frames > clip.end
    total, textless = len(plan.sentence), (plan.sentence == NULL).sum()
    assert total == 20000
    assert textless / total == pytest.approx(0.1, abs=5 * math.sqrt(0.09 / total))
    # of 10 to 60 frames those from 36 on may be within 90 % of a clip of 40 and look like one
    assert crops / total == pytest.approx(0.05, abs=0.01)
    assert set(lengths) == set(range(10, 61)) and outside > crops / 4


@pytest.mark.parametrize("frames", [40, 47, 200])
def test_a_clip_loses_at_most_a_tenth_in_all_as_an_oracle_says(frames):
    clip = Clip("a", "a", "", "a", (), False, False, "train", 0, frames)
    motion = torch.arange(float(frames))[:, None].expand(-1, LAYOUT.width).contiguous()
    one = Dataset(Cache(FPS, "toy", motion, (clip,), {"a": (("a", 1.0),)}), LetterCounts(), LAYOUT, min_clips=0)
    recipe, count = EpochBatches(trim=0.1, uncond_crop_prob=0.0, longest=1e4), 20000
    body = recipe.draw_crops(SplitClips(one, "train"), np.zeros(count, dtype=int), default_rng(0)).body
    seen = Counter(zip(body.start.tolist(), (frames - body.start - body.frames).tolist(), strict=True))
    most = int(0.1 * frames)
    expected = {
        (left, lost - left): 1 / (most + 1) / (lost + 1) for lost in range(most + 1) for left in range(lost + 1)
    }
    assert set(seen) <= set(expected)
    for place, share in expected.items():
        assert seen[place] / count == pytest.approx(share, abs=5 * math.sqrt(share / count))


def test_statistics_are_over_the_first_annotation_of_every_entry(dataset):
    """By hand: clips of 2, 2, 2 and 2.5 seconds, of which two are of one recording; "goes" counts twice."""
    first = [next(clip for clip in dataset.clips if clip.content == name) for name in ENTRIES if name != "000003"]
    assert [clip.end - clip.start for clip in first] == [40, 40, 40, 50]
    frames = torch.cat([dataset.features[clip.start : clip.end] for clip in first]).double()
    assert_close(dataset.motion.mean.double(), frames.mean(dim=0), atol=1e-6, rtol=1e-5)
    words, lengths = LetterCounts().encode(["walks", "strolls", "goes", "goes"])
    every = torch.cat([row[:length] for row, length in zip(words, lengths.tolist(), strict=True)]).double()
    assert_close(dataset.text.mean.double(), every.mean(dim=0), atol=1e-6, rtol=1e-5)


def test_a_recording_is_kept_once_whatever_number_of_entries_it_has(dataset):
    recordings = {clip.whole for clip in dataset.clips}
    assert len(recordings) == 4  # of three files, one of them mirrored, too
    assert len(dataset.features) == sum(last - first for first, last in recordings)
    goes = [clip for clip in dataset.clips if clip.content in ("000001", "000002")]
    assert len({clip.whole for clip in goes}) == 1
    assert [clip.annotations for clip in dataset.clips if clip.content == "000000"] == [3, 1]


def test_processes_go_through_epochs_of_their_own():
    clips = [Clip(f"{n}", f"{n}", "", "", (), False, False, "train", n, n + 1) for n in range(50)]
    epochs = Epochs(clips, np.arange(50), 50, [0])
    assert sorted(epochs(0, 0)) == sorted(epochs(0, 1)) == list(range(50))
    assert (epochs(0, 0) != epochs(0, 1)).any()


@pytest.mark.parametrize(("rows", "whole", "batches"), [(8, 6, 7), (10, 5, 5), (50, 1, 1), (60, 1, 1)])
def test_the_last_batch_is_left_out_where_it_is_smaller_and_not_the_only_one(rows, whole, batches):
    """Of 50 entries; the published loaders of FlowMDM drop it."""
    clips = [Clip(f"{n}", f"{n}", "", f"{n}", (), False, False, "train", 0, 9) for n in range(50)]
    dropping, keeping = (Epochs(clips, np.arange(50), rows, [0], drop) for drop in (True, False))
    assert (dropping.batches, keeping.batches) == (whole, batches)
    sizes = {len(dropping(step)) for step in range(2 * whole)}
    assert sizes == {min(rows, 50)}
