"""The prepared data on disk: it comes back as it was, and a half, stale or foreign folder is never taken for it."""

import dataclasses
import json
import os

import pytest
import torch
from helpers.toy_data import cache as toy

from stmc.data.cache import FEATURES, TABLE, Cache, CacheError, Clip, assemble, fingerprint, is_current, read_caches
from stmc.diffusion.statistics import Statistics
from stmc.motion.body_model import Skeleton


def written(folder, **changes) -> Cache:
    made = dataclasses.replace(toy(), fingerprint="inputs", skipped=(("half", "no MOTION section"),), **changes)
    made.write(folder)
    return made


def test_a_cache_comes_back_as_it_was_written(tmp_path):
    made = written(tmp_path / "deep" / "down")
    back = Cache.read(tmp_path / "deep" / "down")
    assert torch.equal(back.features, made.features)
    for name in ("fps", "representation", "clips", "texts", "skipped", "fingerprint"):
        assert getattr(back, name) == getattr(made, name), name
    assert sorted(os.listdir(tmp_path / "deep" / "down")) == [TABLE, FEATURES]


def test_a_table_from_before_clips_had_a_start_is_read(tmp_path):
    made = written(tmp_path)
    table = json.loads((tmp_path / TABLE).read_text("utf-8"))
    for row in table["clips"]:
        del row["from_start"]
    (tmp_path / TABLE).write_text(json.dumps(table), encoding="utf-8")
    assert Cache.read(tmp_path).clips == made.clips


def test_a_cache_is_fresh_for_the_inputs_it_was_made_from_and_for_no_others(tmp_path):
    written(tmp_path)
    assert is_current(tmp_path, "inputs")
    assert not is_current(tmp_path, "other inputs")
    assert not is_current(tmp_path / "nowhere", "inputs")


@pytest.mark.parametrize("lost", [FEATURES, TABLE])
def test_a_folder_that_lacks_one_of_its_files_is_no_cache(lost, tmp_path):
    written(tmp_path)
    (tmp_path / lost).unlink()
    assert not is_current(tmp_path, "inputs")
    with pytest.raises(CacheError, match=r"holds no prepared data; make it with stmc prepare"):
        Cache.read(tmp_path)


def test_writing_that_is_killed_between_its_files_leaves_no_cache_of_the_old_inputs(tmp_path, monkeypatch):
    written(tmp_path)
    monkeypatch.setattr("stmc.data.cache.json.dumps", lambda *_, **__: (_ for _ in ()).throw(KeyboardInterrupt))
    with pytest.raises(KeyboardInterrupt):
        dataclasses.replace(toy(seed=1), fingerprint="new inputs").write(tmp_path)
    assert not is_current(tmp_path, "inputs")
    assert not is_current(tmp_path, "new inputs")
    with pytest.raises(CacheError):
        Cache.read(tmp_path)


def test_features_that_cannot_be_written_leave_no_file_behind(tmp_path, monkeypatch):
    def full(tensors, path):
        path.write_bytes(b"half")
        raise OSError("no space left on device")

    monkeypatch.setattr("stmc.data.cache.save_file", full)
    with pytest.raises(OSError, match="no space"):
        written(tmp_path)
    assert os.listdir(tmp_path) == []


@pytest.mark.parametrize(
    ("name", "damage", "message"),
    [
        (FEATURES, lambda data: data[: len(data) // 2], f"{FEATURES} is damaged"),
        (FEATURES, lambda data: b"", f"{FEATURES} is damaged"),
        (TABLE, lambda data: data[: len(data) // 2], f"{TABLE} is not a cache's table"),
        (TABLE, lambda data: b"\xff\xfe\x00", f"{TABLE} is not a cache's table"),
        (TABLE, lambda data: b"[]", "it holds a list"),
        (TABLE, lambda data: b"{}", "KeyError"),
        (TABLE, lambda data: data.replace(b'"content"', b'"contents"'), "'content'"),
    ],
)
def test_a_damaged_file_is_named(name, damage, message, tmp_path):
    written(tmp_path)
    (tmp_path / name).write_bytes(damage((tmp_path / name).read_bytes()))
    with pytest.raises(CacheError) as error:
        Cache.read(tmp_path)
    assert str(tmp_path / name) in str(error.value)
    assert message in str(error.value)


def test_a_damaged_table_is_not_fresh(tmp_path):
    written(tmp_path)
    for text in ("", "[]", "{}", '{"finger'):
        (tmp_path / TABLE).write_text(text)
        assert not is_current(tmp_path, "inputs")


def test_features_must_be_finite_and_the_clip_that_is_not_is_named():
    made = toy()
    spoilt = made.features.clone()
    spoilt[made.clips[3].start + 1, 4] = torch.nan
    with pytest.raises(CacheError, match=rf"clip {made.clips[3].name}: .* frame {made.clips[3].start + 1}$"):
        dataclasses.replace(made, features=spoilt)


@pytest.mark.parametrize("change", [{"start": -1}, {"end": 10**6}, {"start": 40, "end": 40}])
def test_a_clip_beyond_the_features_is_named(change):
    made = toy()
    first = dataclasses.replace(made.clips[0], **change)
    with pytest.raises(CacheError, match=rf"clip {first.name}: frames \[{first.start}, {first.end}\)"):
        dataclasses.replace(made, clips=(first, *made.clips[1:]))


def test_a_clip_without_sentences_is_named():
    made = toy()
    with pytest.raises(CacheError, match="clip kick-0: no sentences under 'kick'"):
        dataclasses.replace(made, texts={key: made.texts[key] for key in ("walk", "raise")})


def test_clips_are_laid_end_to_end():
    def row(frames: int) -> tuple[Clip, torch.Tensor]:
        clip = Clip(str(frames), "walk", "normal", "walk", ("legs",), True, False, "train", 0, frames)
        return clip, torch.full((frames, 2), float(frames))

    clips, features = assemble([row(frames) for frames in (3, 1, 4)])
    assert [(clip.start, clip.end) for clip in clips] == [(0, 3), (3, 4), (4, 8)]
    for clip in clips:
        assert (features[clip.start : clip.end] == float(clip.name)).all()


@pytest.fixture
def sources(tmp_path):
    folder = tmp_path / "clips"
    (folder / "one").mkdir(parents=True)
    (folder / "one" / "a.bvh").write_text("abc")
    (folder / "b.bvh").write_text("de")
    code = tmp_path / "code.py"
    code.write_text("pass\n")
    return [folder, code]


def test_the_fingerprint_stays_while_nothing_changes_also_where_all_was_moved(sources, tmp_path):
    before = fingerprint(sources, [20])
    assert fingerprint(sources, [20]) == before
    os.utime(sources[1])  # a fresh checkout of the same code
    (tmp_path / "elsewhere").mkdir()
    moved = [source.rename(tmp_path / "elsewhere" / source.name) for source in sources]
    assert fingerprint(moved, [20]) == before


@pytest.mark.parametrize(
    "change",
    [
        lambda folder, code: (folder / "b.bvh").write_text("def"),
        lambda folder, code: os.utime(folder / "b.bvh", ns=(1, 1)),
        lambda folder, code: (folder / "one" / "a.bvh").unlink(),
        lambda folder, code: (folder / "c.bvh").write_text(""),
        lambda folder, code: (folder / "b.bvh").rename(folder / "one" / "b.bvh"),
        lambda folder, code: (folder / "b.bvh").rename(folder / "c.bvh"),
        lambda folder, code: code.write_text("pas\n\n"),
    ],
    ids=["size", "time", "fewer", "more", "moved", "renamed", "code"],
)
def test_the_fingerprint_changes_with_every_input(change, sources):
    before = fingerprint(sources, [20])
    change(*sources)
    assert fingerprint(sources, [20]) != before


def test_the_fingerprint_changes_with_the_settings(sources):
    assert fingerprint(sources, [20]) != fingerprint(sources, [30])


def test_a_source_that_is_not_there_is_an_error(sources):
    with pytest.raises(FileNotFoundError):
        fingerprint([*sources, sources[0] / "none.py"], [20])


def test_the_table_is_plain_json_that_people_can_read(tmp_path):
    written(tmp_path)
    table = json.loads((tmp_path / TABLE).read_text())
    assert table["fps"] == 20.0
    assert table["clips"][0]["name"] == "walk-0"


def test_several_caches_are_read_as_one_without_the_statistics_of_the_first(tmp_path):
    width = toy().features.shape[1]
    one = written(tmp_path / "one", statistics=Statistics(torch.zeros(width), torch.ones(width)))
    written(tmp_path / "two")
    both = read_caches([tmp_path / "one", str(tmp_path / "two")])
    assert len(both.clips) == 2 * len(one.clips) and len(both.features) == 2 * len(one.features)
    assert both.statistics is None
    assert read_caches(tmp_path / "one").statistics is not None


def test_caches_of_different_bodies_are_not_one(tmp_path):
    written(tmp_path / "one")
    written(tmp_path / "two", skeleton=Skeleton(2 * Skeleton.default().offsets))
    with pytest.raises(CacheError, match="one body"):
        read_caches([tmp_path / "one", tmp_path / "two"])
