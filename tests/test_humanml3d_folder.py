"""HumanML3D's processed folder: features, captions and statistics as they are there, by the published rules."""

import re
import shutil

import numpy as np
import pytest
import torch
from helpers.smpl_pickles import run_code
from helpers.source_folders import Serial, humanml3d
from torch.testing import assert_close

from stmc.data import preparation
from stmc.data.cache import Cache
from stmc.data.preparation import LayoutError
from stmc.data.sources.humanml3d import humanml3d_folder as module
from stmc.data.sources.humanml3d.humanml3d_folder import ProcessedHumanML3D
from stmc.data.sources.humanml3d.humanml3d_texts import Caption, read_captions


@pytest.fixture(autouse=True)
def in_this_process(monkeypatch):
    monkeypatch.setattr(preparation, "ProcessPoolExecutor", Serial)
    monkeypatch.setattr(module, "AT_ONCE", 5)


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    return humanml3d(tmp_path_factory.mktemp("made") / "HumanML3D")


@pytest.fixture
def source(made, tmp_path):
    return shutil.copytree(made, tmp_path / "HumanML3D")


def prepared(source, **choices) -> Cache:
    preparing = ProcessedHumanML3D(source, **choices)
    preparing.check()
    return preparing.prepared(source.parent / "pieces", 2, lambda pieces, total: pieces)


def vectors(source, name) -> torch.Tensor:
    return torch.from_numpy(np.load(source / "new_joint_vecs" / f"{name}.npy"))


def test_clips_are_the_folder_s_features_with_its_captions_splits_and_statistics(source):
    cache = prepared(source)
    assert (cache.fps, cache.representation, cache.skipped) == (20, "humanml3d", ())
    clips = {clip.name: clip for clip in cache.clips}
    assert sorted(clips) == sorted(
        [f"{m}{n:06d}" for n in range(6) for m in ("", "M") if (m, n) != ("", 1)] + ["000001/0", "000001/1"]
    )
    assert {split: sum(clip.split == split for clip in cache.clips) for split in ("train", "val", "test")} == {
        "train": 9,
        "val": 2,
        "test": 2,
    }
    assert [name for name, clip in clips.items() if clip.mirrored] == [f"M{n:06d}" for n in range(6)]
    for name in ("000000", "M000003"):
        assert_close(cache.features[clips[name].start : clips[name].end], vectors(source, name))
        assert cache.texts[name] == (("a person walks in a circle.", 0.5), (f"someone walks {name}", 0.5))
    part = clips["000001/1"]
    assert_close(cache.features[part.start : part.end], vectors(source, "000001")[20:65])
    assert cache.texts["000001/1"] == (("raises an arm", 1.0),)
    assert_close(cache.statistics.mean, torch.from_numpy(np.load(source / "Mean.npy")))
    cache.write(source.parent / "cache")
    back = Cache.read(source.parent / "cache")
    assert_close(back.statistics.std, torch.from_numpy(np.load(source / "Std.npy")))
    assert back.skeleton is None


def test_a_caption_of_a_part_is_an_entry_of_its_own_where_it_is_asked_for(source):
    together, apart = prepared(source), prepared(source, part_entries=True)
    assert {clip.content for clip in together.clips if clip.name.startswith("000001")} == {"000001"}
    own = {clip.name: clip for clip in apart.clips if clip.name.startswith("000001")}
    assert sorted(own) == ["000001", "000001-0"] and own["000001-0"].content == "000001-0"
    assert apart.texts["000001-0"] == (("raises an arm", 1.0),)
    assert own["000001-0"].end - own["000001-0"].start == 45 and len(apart.clips) == len(together.clips)


def test_a_caption_s_line_has_four_parts_and_times_that_are_no_numbers_mean_the_whole_clip(tmp_path):
    lines = [
        "a man  kicks.#a/DET man/NOUN#0.0#0.0",
        "",
        "walks#walk/VERB#nan#nan",
        "runs#run/VERB#1.5#4",
        "no times#no/DET",
        "#x#0.0#0.0",
        "back#back/ADV#4.0#1.0",
        "words#words/NOUN#one#two",
        "far#far/ADV#0.0#inf",
    ]
    (tmp_path / "a.txt").write_text("\n".join(lines))
    *good, no_times, no_text, back, words, far = read_captions(tmp_path / "a.txt")
    assert good == [
        Caption("a man kicks.", 0.0, 0.0, "a/DET man/NOUN"),
        Caption("walks", 0.0, 0.0, "walk/VERB"),
        Caption("runs", 1.5, 4.0, "run/VERB"),
    ]
    assert "line 5 must be caption#tagged words#start#end, not 'no times#no/DET'" in no_times
    assert "line 6" in no_text
    assert "line 7 is from 4 to 1 s" in back
    assert "line 8" in words
    assert "line 9 is from 0 to inf s" in far


def save(folder):
    return lambda source, array: np.save(source / folder / "000002.npy", array)


def text(source, content):
    (source / "texts" / "000002.txt").write_bytes(content)


def raw(source, content):
    (source / "new_joint_vecs" / "000002.npy").write_bytes(content)


def gone(source, folder):
    next((source / folder).glob("000002.*")).unlink()


NAN = np.zeros((90, 263), dtype=np.float32)
NAN[80:, 5] = np.nan
DAMAGE = {
    "NaN": (save("new_joint_vecs"), NAN, "not finite: new_joint_vecs/000002.npy, 10 rows from 80 on"),
    "39 frames": (save("new_joint_vecs"), np.zeros((39, 263)), "too short: 39 frames, not 40 to 199"),
    "200 frames": (save("new_joint_vecs"), np.zeros((200, 263)), "too long: 200 frames, not 40 to 199"),
    "no frames": (save("new_joint_vecs"), np.zeros((0, 263)), "too short: 0 frames"),
    "251 features": (save("new_joint_vecs"), np.zeros((90, 251)), r"wrong shape: features are \(90, 251\)"),
    "words": (save("new_joint_vecs"), np.full((90, 263), "a"), "damaged: 000002.npy holds <U1, not numbers"),
    "objects": (save("new_joint_vecs"), np.array([{}], dtype=object), "damaged: .*pickled Python objects"),
    "cut off": (raw, b"\x93NUMPY\x01", "damaged: "),
    "hostile": (raw, run_code("os.system", "false", 2), "damaged: .*pickled Python objects"),
    "other joints": (save("new_joints"), np.zeros((60, 22, 3)), r"mislabelled: new_joints is \(60, 22, 3\), but"),
    "no features": (gone, "new_joint_vecs", "no file: new_joint_vecs/000002.npy"),
    "no texts": (gone, "texts", "no file: texts/000002.txt"),
    "empty texts": (text, b"\n", "no caption: the file is empty"),
    "texts in bytes": (text, b"\xff\xfe#\x00", "damaged: .*000002.txt: not UTF-8 text"),
    "malformed texts": (text, b"walks", "malformed caption: line 1"),
    "a moment": (text, b"walks#w/VERB#1.0#1.5", "too short: 10 frames, not 40 to 199"),
    "after the end": (text, b"walks#w/VERB#60#63", "too short: "),
}


@pytest.mark.parametrize(("damage", "value", "reason"), DAMAGE.values(), ids=DAMAGE)
def test_a_clip_that_cannot_be_used_is_named_and_the_others_are_used(damage, value, reason, source):
    damage(source, value)
    cache = prepared(source)
    assert len(cache.clips) == 12
    [(name, why)] = cache.skipped
    assert name == "000002"
    assert re.match(reason, why), why


def test_one_bad_caption_does_not_cost_the_good_ones(source):
    text(source, b"walks#walk/VERB#0.0#0.0\nbroken\n")
    cache = prepared(source)
    assert cache.texts["000002"] == (("walks", 1.0),)
    assert cache.skipped == (
        ("000002", "malformed caption: line 2 must be caption#tagged words#start#end, not 'broken'"),
    )


def test_names_that_are_paths_are_refused_and_names_in_two_lists_count_once(source):
    with (source / "val.txt").open("a") as file:
        file.write("../../etc/passwd\n000000\n")
    cache = prepared(source)
    assert ("../../etc/passwd", "malformed name: it is a path") in cache.skipped
    assert [clip.split for clip in cache.clips if clip.name == "000000"] == ["train"]


@pytest.mark.parametrize(
    ("lost", "message"),
    [
        (["texts"], r"texts/ missing, found \["),
        (["Mean.npy", "train.txt"], r"Mean\.npy, train\.txt missing"),
        (["new_joint_vecs"], "new_joint_vecs/ missing"),
    ],
)
def test_a_folder_that_lacks_something_says_what(lost, message, source):
    for name in lost:
        (source / name).rename(source.parent / name)
    with pytest.raises(LayoutError, match=message):
        ProcessedHumanML3D(source).check()


def test_the_likely_mistakes_get_a_hint(source):
    with pytest.raises(LayoutError, match=r"is .*HumanML3D meant\?"):
        ProcessedHumanML3D(source.parent).check()
    with pytest.raises(LayoutError, match="no such folder"):
        ProcessedHumanML3D(source / "nowhere").check()
    (source / "texts").rename(source / "unpacked")
    (source / "texts.zip").write_bytes(b"")
    with pytest.raises(LayoutError, match=r"texts\.zip must be unpacked"):
        ProcessedHumanML3D(source).check()


@pytest.mark.parametrize(
    ("mean", "message"),
    [
        (np.zeros(251), "KIT-ML's 251 features.*data=kitml"),
        (np.zeros(205), r"Mean\.npy and Std\.npy are \(205,\) and \(263,\), not \(263,\)"),
        (np.full(263, np.nan), r"not finite: .*Mean\.npy"),
    ],
)
def test_statistics_of_something_else_are_refused_before_anything_is_read(mean, message, source):
    np.save(source / "Mean.npy", mean)
    with pytest.raises(LayoutError, match=message):
        ProcessedHumanML3D(source).check()


def test_a_std_of_zero_and_lists_of_other_clips_are_refused(source):
    std = np.load(source / "Std.npy")
    np.save(source / "Std.npy", np.zeros(263))
    with pytest.raises(LayoutError, match="std must be above 0"):
        ProcessedHumanML3D(source).check()
    np.save(source / "Std.npy", std)
    for split in ("train", "val", "test"):
        (source / f"{split}.txt").write_text(f"of_another_data_set_{split}\n")
    with pytest.raises(LayoutError, match="new_joint_vecs/ has none of the 3 names in the lists"):
        ProcessedHumanML3D(source).check()
