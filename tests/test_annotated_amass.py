"""Recordings and annotations become clips: the right frames of the right features under the right texts, and nothing is
lost in silence. Killed and asked again, what was converted stays converted."""

import json
import os
import shutil
from dataclasses import replace

import numpy as np
import pytest
import torch
from helpers.source_folders import PUBLISHED, Serial, amass, babel, published, recorded, smplh_arrays
from test_body_model import write_body
from torch.testing import assert_close

from stmc.data import preparation
from stmc.data.cache import TABLE, Cache, CacheError, merge_caches
from stmc.data.preparation import LayoutError
from stmc.data.report import NUMBERS, TEXT, write_report
from stmc.data.sources.amass.amass_recordings import read_recording
from stmc.data.sources.amass.annotated_amass import AnnotatedAmass
from stmc.motion.body_model import Skeleton, load_body
from stmc.motion.motion import Motion
from stmc.motion.representation import HumanML3DRepresentation, SmplRepresentation

SKELETON = Skeleton.default()


@pytest.fixture(autouse=True)
def in_this_process(monkeypatch):
    monkeypatch.setattr(preparation, "ProcessPoolExecutor", Serial)


@pytest.fixture(scope="module")
def source(tmp_path_factory):
    return amass(tmp_path_factory.mktemp("amass"))


def described(source, annotations, representation=None, **settings) -> AnnotatedAmass:
    return AnnotatedAmass(source, annotations, 20, representation or SmplRepresentation(), **settings)


def prepared(source, annotations, folder, **settings) -> Cache:
    preparing = described(source, annotations, **settings)
    preparing.check()
    return preparing.prepared(folder / "pieces", 1, lambda pieces, total: pieces)


@pytest.fixture(scope="module")
def cache(source, tmp_path_factory):
    folder = tmp_path_factory.mktemp("once")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(preparation, "ProcessPoolExecutor", Serial)
        return prepared(source, published(folder / "texts"), folder)


def features_of(file, mirrored=False) -> torch.Tensor:
    motion = read_recording(file, SKELETON).resampled(20)
    motion = motion.mirrored() if mirrored else motion
    posed = Motion.posed(motion.rotations, motion.translation, 20, SKELETON)
    return SmplRepresentation().encode(posed).float()


def clip(cache, name):
    [found] = [clip for clip in cache.clips if clip.name == name]
    return found, cache.features[found.start : found.end]


def test_every_entry_is_clips_of_its_seconds_with_its_texts(cache, source):
    assert (cache.fps, cache.representation, cache.features.shape[1]) == (20, "smpl", 205)
    assert {clip.name: clip.split for clip in cache.clips} == {
        "000000": "train",
        "M000000": "train",
        "000001": "train",
        "000002/0": "val",
        "000002/1": "val",
        "000003": "test",
    }
    walk, features = clip(cache, "000000")
    assert_close(features, features_of(source / "KIT/3/kick_high_left02_poses.npz")[:60])
    assert cache.texts[walk.texts] == (("someone walks and raises the right arm", 1.0),)
    lift, features = clip(cache, "000002/1")
    assert_close(features, features_of(source / "CMU/01/01_01_stageii.npz")[10:55])
    assert cache.texts[lift.texts] == (("a man lifts his right arm", 1.0),)
    assert (lift.content, lift.parts, lift.cyclic) == ("000002", (), False)
    assert cache.texts["000001"] == (("a person walks", 1.0),), "the same text twice"
    assert cache.skipped == ()


def test_the_mirror_image_is_of_the_motion_not_of_the_features(cache, source):
    image, features = clip(cache, "M000000")
    assert image.mirrored
    assert_close(features, features_of(source / "KIT/3/kick_high_left02_poses.npz", mirrored=True)[:60])
    assert not torch.equal(features, clip(cache, "000000")[1])


def test_clips_overlap_in_the_cache_as_they_do_in_time(cache):
    whole, lift = clip(cache, "000002/0")[0], clip(cache, "000002/1")[0]
    assert (lift.start - whole.start, lift.end - whole.start) == (10, 55)
    assert whole.whole == lift.whole == (whole.start, whole.start + 64)
    assert len(cache.features) == 5 * 64  # of four whole recordings, one of them mirrored, too


def test_babel_s_labels_are_clips_too_and_those_for_training_are_mirrored(source, tmp_path):
    cache = prepared(source, babel(tmp_path / "texts"), tmp_path, shortest=1.0)
    said = {clip.name: cache.texts[clip.texts][0][0] for clip in cache.clips}
    assert said == {
        "1/0": "walk",
        "1/1": "raise right arm",
        "M1/0": "walk",
        "M1/1": "raise left arm",
        "2": "walking",
    }
    assert [clip.end - clip.start for clip in cache.clips if clip.name in ("1/0", "1/1", "2")] == [30, 25, 64]


def test_the_263_features_can_be_prepared_from_amass_as_well(source, tmp_path):
    cache = prepared(source, published(tmp_path / "texts"), tmp_path, representation=HumanML3DRepresentation())
    assert (cache.representation, cache.features.shape[1]) == ("humanml3d", 263)


def test_a_body_of_smpl_h_poses_the_joints_and_goes_with_the_cache(source, tmp_path):
    write_body(tmp_path, "smplh")
    cache = prepared(source, published(tmp_path / "texts"), tmp_path, body=tmp_path)
    skeleton = load_body(tmp_path, "smplh").skeleton
    assert_close(cache.skeleton.offsets, skeleton.offsets)
    _, features = clip(cache, "000000")
    motion = SmplRepresentation().decode(features.double(), 20)
    measured = Skeleton.measured(motion.rotations, motion.joints, skeleton.offsets[0].double())
    assert_close(measured.offsets, skeleton.offsets.double(), atol=1e-5, rtol=0)
    cache.write(tmp_path / "cache")
    assert_close(Cache.read(tmp_path / "cache").skeleton.offsets, skeleton.offsets)


def segment(start, end, path="KIT/3/kick_high_left02_poses"):
    return {"path": path, "annotations": [{"text": "walks", "start": start, "end": end}]}


@pytest.mark.parametrize(
    ("entry", "reason"),
    [
        (segment(0.0, 1.9), "too short: 1.9 s, not 2 to 10"),
        (segment(0.0, 10.5), "after the end: 0 to 10.5 s of a recording of 3.2 s"),
        (segment(5.0, 8.0), "after the end: 5 to 8 s"),
        (segment(0.0, 3.0, "KIT/9/gone_poses"), "no file: KIT/9/gone_poses.npz"),
        (segment(0.0, 3.0, "KIT/3/shape"), "no motion: a subject's shape alone"),
        (segment(0.0, 3.0, "KIT/3/nan_poses"), "not finite: poses from frame 7 on"),
        (segment(0.0, 3.0, "KIT/3/cut_poses"), "damaged: "),
        (segment(0.0, 3.0, "KIT/3/brief_poses"), "too short: 3 frames at 120 fps"),
    ],
)
def test_an_entry_that_cannot_become_clips_is_named_and_the_others_do(entry, reason, tmp_path):
    source = amass(tmp_path / "amass")
    arrays = smplh_arrays(recorded())
    np.savez(source / "KIT/3/brief_poses.npz", **arrays | {name: arrays[name][:3] for name in ("poses", "trans")})
    whole = (source / "KIT/3/kick_high_left02_poses.npz").read_bytes()
    (source / "KIT/3/cut_poses.npz").write_bytes(whole[: len(whole) // 3])
    arrays["poses"][7, 3] = np.nan
    np.savez(source / "KIT/3/nan_poses.npz", **arrays)
    cache = prepared(source, published(tmp_path / "texts", bad=entry), tmp_path)
    assert len(cache.clips) == 6
    [(name, why)] = cache.skipped
    assert name == "bad"
    assert reason in why


def test_a_segment_for_testing_may_be_of_any_length(cache):
    assert clip(cache, "000003")[1].shape == (20, 205)


def test_an_annotation_may_end_a_little_after_its_recording(source, tmp_path):
    cache = prepared(source, published(tmp_path / "texts", late=segment(0.5, 3.4)), tmp_path)
    assert clip(cache, "late")[1].shape == (54, 205)


def test_nothing_that_can_be_used_is_an_error_and_leaves_no_cache(tmp_path):
    source = amass(tmp_path / "amass")
    for file in source.rglob("*_poses.npz"):
        file.write_bytes(b"")
    entries = {name: row for name, row in PUBLISHED.items() if name != "000002"}
    entries |= {"000009": ("KIT/3/kick_high_left02_poses", "val", (("walks", 0.0, 3.0),))}
    with pytest.raises(ValueError, match="no clip could be used; 5 were skipped; the first: 000000: damaged: "):
        prepared(source, published(tmp_path / "texts", entries), tmp_path)
    assert not list(tmp_path.glob(TABLE))


def test_a_wrong_folder_is_named_before_anything_is_converted(source, tmp_path):
    folder = published(tmp_path / "texts")
    (tmp_path / "KIT/4").mkdir(parents=True)
    np.savez(tmp_path / "KIT/4/other_poses.npz", poses=np.zeros((3, 156)))
    with pytest.raises(
        LayoutError, match=r"none of the 4 annotated recordings; expected, for instance, .*KIT/4/other_poses"
    ):
        described(tmp_path / "KIT", folder).check()
    with pytest.raises(LayoutError, match=r"annotations=.*expected annotations\.json"):
        described(source, tmp_path).check()
    with pytest.raises(FileNotFoundError, match="no smplh body for gender 'neutral'"):
        described(source, folder, body=tmp_path).check()
    (folder / "annotations.json").write_text(json.dumps({"000000": {"path": "humanact12/humanact12/x"}}))
    with pytest.raises(LayoutError, match="none can be used; the first: 000000: "):
        described(source, folder).check()


def counted(monkeypatch) -> list:
    """Every piece that is converted from now on."""
    pieces, convert = [], preparation.write_piece
    monkeypatch.setattr(
        preparation, "write_piece", lambda piece, folder: (pieces.append(piece.name), convert(piece, folder))
    )
    return pieces


def test_a_run_that_was_killed_converts_only_what_is_left(source, tmp_path, monkeypatch, cache):
    pieces, folder = counted(monkeypatch), published(tmp_path / "texts")
    preparing = described(source, folder)
    with pytest.raises(KeyboardInterrupt):
        preparing.prepared(tmp_path / "pieces", 1, interrupted)
    done = len(pieces)
    half = next((tmp_path / "pieces").iterdir()) / TABLE
    half.unlink()  # as if it had been killed while it wrote this one
    again = preparing.prepared(tmp_path / "pieces", 1, lambda pieces, total: pieces)
    assert len(pieces) == max(done, 4) + 1
    assert torch.equal(again.features, cache.features)
    assert (again.clips, again.texts) == (cache.clips, cache.texts)


def interrupted(pieces, total):
    for number, piece in enumerate(pieces):
        yield piece
        if number == 1:
            raise KeyboardInterrupt


def test_what_changed_is_converted_again_and_a_cache_of_other_inputs_is_stale(tmp_path, monkeypatch):
    source, folder, pieces = amass(tmp_path / "amass"), published(tmp_path / "texts"), counted(monkeypatch)
    before = described(source, folder).fingerprint()
    described(source, folder).prepared(tmp_path / "pieces", 1, lambda pieces, total: pieces)
    assert described(source, folder).fingerprint() == before
    pieces.clear()
    np.savez(source / "CMU/01/01_01_stageii.npz", **smplh_arrays(recorded(4)))
    assert described(source, folder).fingerprint() != before
    described(source, folder).prepared(tmp_path / "pieces", 1, lambda pieces, total: pieces)
    assert pieces == ["CMU/01/01_01_poses"]
    now = described(source, folder).fingerprint()
    for change in ({"shortest": 1.0}, {"longest": 9.0}, {"representation": HumanML3DRepresentation()}):
        assert described(source, folder, **change).fingerprint() != now
    shutil.rmtree(folder)
    fewer = {name: row for name, row in PUBLISHED.items() if name != "000003"}
    assert described(source, published(folder, fewer)).fingerprint() != now


def test_the_report_counts_all_that_is_there_and_all_that_is_not(source, tmp_path):
    bad = {f"bad{number}": segment(0.0, 0.5 + number / 10) for number in range(3)}
    cache = prepared(source, published(tmp_path / "texts", gone=segment(0, 3, "A/b/c"), **bad), tmp_path)
    write_report(cache, tmp_path / "out")
    numbers = json.loads((tmp_path / "out" / NUMBERS).read_text())
    assert numbers["splits"]["train"] == {"clips": 3, "of_which_mirrored": 1, "contents": 3, "hours": 0.0024}
    assert numbers["skipped"] == {"too short": 3, "no file": 1}
    text = (tmp_path / "out" / TEXT).read_text()
    assert "train: 3 clips (1 mirrored) of 3 contents, 0.00 hours" in text
    assert "skipped, too short: 3" in text
    for name in ("gone: no file: A/b/c.npz", *(f"{name}: too short" for name in bad)):
        assert name in text
    assert sorted(os.listdir(tmp_path / "out")) == [NUMBERS, TEXT]


def test_caches_of_two_kinds_or_with_two_texts_under_one_name_are_not_merged(cache):
    assert len(merge_caches([cache, replace(cache, texts=cache.texts)]).clips) == 12
    with pytest.raises(CacheError, match="caches must have one kind"):
        merge_caches([cache, replace(cache, fps=30)])
    other = cache.texts | {"000000": (("something else", 1.0),)}
    with pytest.raises(CacheError, match="the texts of 000000 differ"):
        merge_caches([cache, replace(cache, texts=other)])
