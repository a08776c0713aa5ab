"""From the field's own data sets to motions, as a researcher goes: prepare, train a few steps, sample, export."""

import json
import os
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path

import numpy as np
import pytest
from helpers.scripts import configured, loaded, run
from helpers.source_folders import Serial, amass, babel, humanml3d, published
from helpers.tiny_model import tiny
from test_body_model import write_body

import stmc
from stmc.data import preparation
from stmc.data.cache import FEATURES, TABLE, Cache
from stmc.data.report import NUMBERS, TEXT
from stmc.io.files import LOCK, FolderInUse, lock_folder
from stmc.run import CARD

TIMELINE = "walk # 0 # 2 # legs\nraise the right arm # 0.5 # 1.5 # right arm\n"

TINY = (
    *("denoiser=mdm_smpl_small", "denoiser.width=32", "denoiser.feedforward=64", "denoiser.layers=1"),
    *("training.steps=4", "training.warmup=1", "training.log_every=2", "training.validate_every=4"),
    *("training.checkpoint_every=4", "training.precision=fp32", "data.sampling.rows=4"),
    *("validation=1", "draw_every=4", "draw=[]", "device=cpu", "threads=1"),
)


@pytest.fixture
def in_this_process(monkeypatch):
    monkeypatch.setenv("COLUMNS", "200")
    monkeypatch.setattr(preparation, "ProcessPoolExecutor", Serial)


def sampled(folder: Path, model: Path) -> stmc.Motion:
    """Trains nothing: samples a timeline with the model and reads the exported motion back."""
    (folder / "timeline.txt").write_text(TIMELINE)
    settings = (f"timeline={folder / 'timeline.txt'}", f"model={model}", f"output={folder / 'out'}", "steps=2")
    run("sample", "sample", *settings, "formats=[npz,bvh]", "device=cpu")
    assert sorted(path.suffix for path in (folder / "out").iterdir()) == [".bvh", ".json", ".npz"]
    return stmc.read(folder / "out" / "timeline_0.npz")


@pytest.mark.slow
def test_amass_with_annotations_goes_from_its_files_to_an_exported_motion(tmp_path, in_this_process, capsys):
    write_body(tmp_path, "smplh")
    places = (f"source={amass(tmp_path / 'amass')}", f"annotations={published(tmp_path / 'texts')}", f"body={tmp_path}")
    run("prepare", "prepare", "data=humanml3d", *places, f"folder={tmp_path / 'cache'}", "workers=2")
    assert "train: 3 clips (1 mirrored) of 3 contents" in capsys.readouterr().out
    assert sorted(os.listdir(tmp_path / "cache")) == sorted([FEATURES, TABLE, TEXT, NUMBERS])
    cache, model = Cache.read(tmp_path / "cache"), tmp_path / "run"
    settings = (f"run={model}", f"data.folder={tmp_path / 'cache'}", f"text_cache={tmp_path / 'sentences'}")
    run("train", "train_humanml3d", *settings, *TINY, "text_encoder=minilm")
    loaded = stmc.load(model)
    assert (loaded.fps, loaded.longest, loaded.config["denoiser"]["width"]) == (20, 200, 32)
    np.testing.assert_allclose(loaded.skeleton.offsets, cache.skeleton.offsets)
    assert sampled(tmp_path, model).frames == 40


def test_the_processed_humanml3d_folder_goes_from_its_files_to_an_exported_motion(tmp_path, in_this_process):
    source, cache, model = humanml3d(tmp_path / "HumanML3D"), tmp_path / "cache", tmp_path / "run"
    run("prepare", "prepare", "data=humanml3d_processed", f"source={source}", f"folder={cache}", "workers=1")
    settings = (f"run={model}", f"data.folder={cache}", f"text_cache={tmp_path / 'sentences'}")
    run("train", "train", "data=humanml3d_processed", "representation=humanml3d", *settings, *TINY)
    loaded = stmc.load(model)
    assert (loaded.representation.width, loaded.longest) == (263, 196)
    np.testing.assert_allclose(loaded.motion_statistics.std, np.load(source / "Std.npy"))
    assert sampled(tmp_path, model).frames == 40


def test_babel_and_what_is_up_to_date(tmp_path, in_this_process, capsys):
    places = (f"source={amass(tmp_path / 'amass')}", f"annotations={babel(tmp_path / 'texts')}")
    settings = ("data=babel", *places, f"folder={tmp_path / 'cache'}", "workers=1")
    run("prepare", "prepare", *settings)
    assert "val: 1 clips (0 mirrored)" in capsys.readouterr().out
    before = {path: path.stat().st_mtime_ns for path in (tmp_path / "cache").iterdir()}
    run("prepare", "prepare", *settings)
    assert "is up to date" in capsys.readouterr().out
    assert {path: path.stat().st_mtime_ns for path in (tmp_path / "cache").iterdir()} == before


def test_what_is_skipped_is_counted_on_the_screen_and_named_in_the_report(tmp_path, in_this_process, capsys):
    bad = {
        f"bad{n}": {"path": f"KIT/3/gone{n}", "annotations": [{"text": "x", "start": 0, "end": 3}]} for n in range(30)
    }
    places = (f"source={amass(tmp_path / 'amass')}", f"annotations={published(tmp_path / 'texts', **bad)}")
    run("prepare", "prepare", "data=humanml3d", *places, f"folder={tmp_path / 'cache'}", "workers=1")
    told = capsys.readouterr().out
    assert "skipped, no file: 30" in told
    assert told.count("gone") == 20
    assert json.loads((tmp_path / "cache" / NUMBERS).read_text())["skipped"] == {"no file": 30}
    assert len(Cache.read(tmp_path / "cache").skipped) == 30


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (["data=humanml3d", "source={0}", "annotations={0}"], r"annotations=.*expected annotations\.json"),
        (["data=humanml3d", "source={0}"], "annotations= is missing .*--help lists"),
        (["data=humanml3d_processed", "source={0}"], "new_joint_vecs/, texts/, Mean.npy.* missing"),
        (["data=humanml3d_processed", "source={0}", "body={0}"], "body= does not apply to this data set"),
        (["source={0}/nowhere"], "nowhere does not exist; it should be the dataset's .tar.xz"),
        ([], "source= is missing"),
    ],
)
def test_what_cannot_be_meant_ends_in_a_sentence_and_leaves_nothing(overrides, message, tmp_path, in_this_process):
    given = [override.format(tmp_path) for override in overrides]
    with pytest.raises(ValueError, match=message):
        run("prepare", "prepare", *given, f"folder={tmp_path / 'cache'}", "workers=1")
    assert os.listdir(tmp_path) == []


def test_where_nothing_can_be_used_no_cache_is_left(tmp_path, in_this_process):
    source = humanml3d(tmp_path / "HumanML3D", clips=2)
    for path in (source / "new_joint_vecs").iterdir():
        path.write_bytes(b"")
    with pytest.raises(ValueError, match="no clip could be used; 4 were skipped; the first: 000000: damaged"):
        run(
            "prepare",
            "prepare",
            "data=humanml3d_processed",
            f"source={source}",
            f"folder={tmp_path / 'c'}",
            "workers=1",
        )
    assert not (tmp_path / "c" / TABLE).exists()


def test_a_worker_that_is_killed_ends_in_a_sentence(tmp_path, monkeypatch, capsys):
    def killed(*_, **__):
        raise BrokenProcessPool

    monkeypatch.setattr(preparation, "ProcessPoolExecutor", killed)
    source = humanml3d(tmp_path / "HumanML3D", clips=2)
    settings = (f"source={source}", f"folder={tmp_path / 'c'}", "workers=1")
    assert loaded("prepare").main(["data=humanml3d_processed", *settings]) == 2
    assert (
        capsys.readouterr().err
        == "a worker process was killed, perhaps for lack of memory; run again with fewer workers=\n"
    )


def test_two_runs_at_once_in_one_folder_are_refused(tmp_path, in_this_process):
    busy, source = tmp_path / "busy", humanml3d(tmp_path / "HumanML3D", clips=2)
    with lock_folder(busy):
        for name in ("train", "train_tmr"):
            with pytest.raises(FolderInUse, match=rf"{busy} is in use by process {os.getpid()} on host"):
                run(name, name, f"run={busy}", "data.folder=nowhere", "device=cpu")
        with pytest.raises(ValueError, match="is in use by process"):
            run("prepare", "prepare", "data=humanml3d_processed", f"source={source}", f"folder={busy}", "workers=1")
        assert os.listdir(busy) == [LOCK]


def test_a_card_tells_which_settings_were_changed_on_the_way(tmp_path):
    config = configured("train", f"run={tmp_path}", "data.folder=cache")
    loaded("train").export(config, tiny(), 8, ["after step 4: cache: abc → abd"])
    assert "Settings changed after step 4: cache: abc → abd" in (tmp_path / CARD).read_text("utf-8")
