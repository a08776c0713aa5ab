"""HumanML3D's sentences on CMU's own recordings: its free files, read as they are shared, on the official layout."""

import os
import tarfile
from pathlib import Path

import pytest
import torch
from helpers.source_folders import PUBLISHED, Serial, babel, published
from test_cmu import actor

from stmc.data import preparation
from stmc.data.preparation import LayoutError
from stmc.data.sources.amass.amass_recordings import repose
from stmc.data.sources.amass.annotated_amass import AnnotatedAmass
from stmc.data.sources.amass.annotations import Segment, read_annotations
from stmc.data.sources.cmu import catalogue as cmu
from stmc.data.sources.cmu import cmu_clips
from stmc.data.sources.cmu.cmu_recordings import CmuRecordings
from stmc.data.sources.segments import splits
from stmc.motion.body_model import Skeleton
from stmc.motion.representation import HumanML3DRepresentation, SmplRepresentation

HEADER = "source_path,start_frame,end_frame,new_name\n"
INDEX = HEADER + (
    "./pose_data/KIT/3/kick_high_left02_poses.npy,0,117,000000.npy\n"
    "./pose_data/humanact12/humanact12/P11G01R02F1812T1847A0402.npy,0,-1,000001.npy\n"
    "./pose_data/CMU/16/16_01_poses.npy,20,80,000002.npy\n"
    "./pose_data/CMU/20_21_rory1/16_02_poses.npy,0,100,000003.npy\n"
    "./pose_data/MPI_HDM05/mm/HDM_mm_08-01_01_120_poses.npy,157,309,000004.npy\n"
)
CAPTIONS = {
    "000000": "a man kicks.#a/DET man/NOUN kick/VERB#0.0#0.0\n",
    "000001": "a person runs.#a/DET person/NOUN run/VERB#0.0#0.0\n",
    "000002": "a man lifts his right arm#a/DET man/NOUN lift/VERB#0.0#0.0\nhe waves right#he/PRON wave/VERB#0.5#2.75\n",
    "M000002": "a man lifts his left arm#a/DET man/NOUN lift/VERB#nan#nan\n",
    "000003": "walks#walk/VERB#0.0#0.0\nno times\n",
    "000004": "sits#sit/VERB#1.0#3.0\n",
}


def shared(folder: Path, index: str = INDEX, captions: dict[str, str] = CAPTIONS) -> Path:
    """HumanML3D's repository with texts.zip unpacked."""
    (folder / "HumanML3D" / "texts").mkdir(parents=True)
    (folder / "index.csv").write_text(index)
    for name, lines in captions.items():
        (folder / "HumanML3D" / "texts" / f"{name}.txt").write_text(lines)
    lists = {"train": ["000000", "M000000", "000001", "000002", "M000002", "000009"], "val": ["000003"]}
    for split, names in (lists | {"test": ["000004"]}).items():
        (folder / "HumanML3D" / f"{split}.txt").write_text("\n".join(names))
    return folder


@pytest.fixture(autouse=True)
def in_this_process(monkeypatch):
    monkeypatch.setattr(preparation, "ProcessPoolExecutor", Serial)


@pytest.fixture(scope="module")
def source(tmp_path_factory):
    """CMU's official layout: five seconds each."""
    folder, recorded = tmp_path_factory.mktemp("cmu"), actor(frames=600)
    (folder / "16").mkdir()
    (folder / "16" / "16.asf").write_text(recorded.asf())
    for name in ("16_01", "16_02", "16_03"):
        (folder / "16" / f"{name}.amc").write_text(recorded.amc())
    (folder / "16" / "16_04.amc").write_text(recorded.amc()[:-40])
    return folder


def prepared(source, annotations, scratch, **settings):
    preparing = AnnotatedAmass(source, annotations, 20, SmplRepresentation(), recordings=CmuRecordings, **settings)
    preparing.check()
    return preparing.prepared(scratch, 1, lambda pieces, total: pieces)


def whole(source: Path, name: str, mirrored: bool = False) -> torch.Tensor:
    text, skeleton = (source / "16" / f"{name}.amc").read_text(), (source / "16" / "16.asf").read_text()
    motion = cmu.read(cmu.Source(name, text, skeleton), Skeleton(Skeleton.default().offsets.double()), 20)
    return cmu_clips.encode_above_floor(repose(motion, Skeleton(Skeleton.default().offsets.double()), mirrored))


def test_humanml3d_s_own_files_are_annotations_with_the_seconds_of_the_recording(tmp_path):
    annotations = read_annotations(shared(tmp_path))
    entries = {entry.name: entry for entry in annotations.entries}
    assert set(entries) == {"000000", "000002", "M000002", "000003", "000004"}
    lift = entries["000002"]
    assert (lift.path, lift.mirrored, lift.split) == ("CMU/16/16_01_poses", False, "train")
    assert lift.segments == (Segment("a man lifts his right arm", 1.0, 4.0), Segment("he waves right", 1.5, 3.75))
    image = entries["M000002"]
    assert (image.path, image.mirrored) == (lift.path, True)
    assert image.segments == (Segment("a man lifts his left arm", 1.0, 4.0),)
    [sits] = entries["000004"].segments
    assert (sits.start, sits.end) == pytest.approx((3 + 157 / 20 + 1, 3 + 157 / 20 + 3)), "HDM05's first three seconds"
    skipped = dict(annotations.skipped)
    assert skipped["000001"] == "HumanAct12: it has no SMPL poses"
    assert skipped["M000000"] == "no file: texts/M000000.txt"
    assert skipped["000009"] == "listed but not in index.csv"
    assert skipped["000003"].startswith("malformed caption: line 2 must be caption#")


@pytest.mark.parametrize(
    ("index", "reason"),
    [
        (HEADER + "./pose_data/CMU/16/16_01_poses.npy,9,3,000002.npy\n", "malformed index: frames 9 to 3"),
        (HEADER + "./pose_data/CMU/16/16_01_poses.npy,a,3,000002.npy\n", "malformed index: frames 'a' to '3'"),
        (HEADER + "../../CMU/16/16_01_poses.npy,0,3,000002.npy\n", "path outside of AMASS"),
    ],
)
def test_a_row_of_the_index_that_cannot_be_used_is_named(index, reason, tmp_path):
    assert reason in dict(read_annotations(shared(tmp_path, index)).skipped)["000002"]


def test_files_that_are_not_humanml3d_s_say_what_was_expected(tmp_path):
    with pytest.raises(LayoutError, match="columns must be source_path, start_frame, end_frame, new_name, not a, b"):
        read_annotations(shared(tmp_path / "other", "a,b\n1,2\n"))
    folder = shared(tmp_path / "bare")
    (folder / "index.csv").unlink()
    with pytest.raises(LayoutError, match=r"index\.csv is missing, there and above"):
        read_annotations(folder)
    zipped = tmp_path / "zipped"
    zipped.mkdir()
    (zipped / "texts.zip").touch()
    with pytest.raises(LayoutError, match=r"texts\.zip must be unpacked"):
        read_annotations(zipped)


@pytest.mark.parametrize("packed", [False, True])
def test_human_written_sentences_are_on_the_seconds_of_cmu_s_own_recordings(packed, source, tmp_path):
    place = source
    if packed:
        place = tmp_path / "cmu.tar.xz"
        with tarfile.open(place, "w:xz", preset=0) as archive:
            archive.add(source, arcname="cmu")
    cache = prepared(place, shared(tmp_path / "texts"), tmp_path / "scratch")
    assert (cache.fps, cache.representation) == (20, "smpl")
    clips = {clip.name: clip for clip in cache.clips}
    assert set(clips) == {"000002/0", "000002/1", "M000002", "000003"}
    for name, recording, mirrored, frames in (
        ("000002/0", "16_01", False, slice(20, 80)),
        ("000002/1", "16_01", False, slice(30, 75)),
        ("M000002", "16_01", True, slice(20, 80)),
        ("000003", "16_02", False, slice(0, 100)),
    ):
        clip = clips[name]
        torch.testing.assert_close(
            cache.features[clip.start : clip.end], whole(source, recording, mirrored)[frames], atol=1e-5, rtol=0
        )
    assert cache.texts["M000002"] == (("a man lifts his left arm", 1.0),)
    assert dict(cache.skipped)["000000"] == "not CMU's: KIT/3/kick_high_left02_poses"


def test_a_recording_that_our_segments_keep_from_training_is_kept_from_it_here_too(source, tmp_path):
    held = next(name for name in splits() if name.startswith("16_"))
    (tmp_path / "cmu").mkdir()
    (tmp_path / "cmu" / "16.asf").write_text((source / "16" / "16.asf").read_text())
    for name in (held, "16_02"):
        (tmp_path / "cmu" / f"{name}.amc").write_text((source / "16" / "16_01.amc").read_text())
    index = INDEX.replace("16_01", held)
    cache = prepared(tmp_path / "cmu", shared(tmp_path / "texts", index), tmp_path / "scratch")
    assert {clip.split for clip in cache.clips if clip.name.lstrip("M").startswith("000002")} == {splits()[held]}


@pytest.mark.parametrize("bodies", [published, babel])
def test_tmr_s_and_babel_s_annotations_are_read_by_the_same_reader(bodies, source, tmp_path):
    if bodies is published:
        entries = {"000002": ("CMU/16/16_01_poses", "train", (("lifts", 0.5, 2.75),)), "000000": PUBLISHED["000000"]}
        folder = published(tmp_path / "texts", entries | {"000001": ("CMU/16/16_04_poses", "val", (("x", 0.0, 3.0),))})
        for split in ("train", "val"):
            assert (folder / "splits" / f"{split}.txt").read_text()
        cache = prepared(source, folder, tmp_path / "scratch")
        assert {clip.name: clip.end - clip.start for clip in cache.clips} == {"000002": 45, "M000002": 45}
        skipped = dict(cache.skipped)
        assert "truncated or damaged" in skipped["000001"]
        assert skipped["000000"].startswith("not CMU's")
    else:
        with pytest.raises(LayoutError, match="none of the 2 annotated recordings is CMU's; the first: KIT/3/kick"):
            prepared(source, babel(tmp_path / "texts"), tmp_path / "scratch")


def test_a_source_that_is_not_there_and_other_features_are_errors(source, tmp_path):
    texts = shared(tmp_path / "texts")
    with pytest.raises(LayoutError, match="nowhere does not exist; it should be a folder of CMU's recordings"):
        prepared(tmp_path / "nowhere", texts, tmp_path / "scratch")
    wrong = AnnotatedAmass(source, texts, 20, HumanML3DRepresentation(), recordings=CmuRecordings)
    with pytest.raises(LayoutError, match="have 205 features; use SmplRepresentation instead of HumanML3DR"):
        wrong.check()


def test_a_cache_depends_on_the_recordings_and_the_sentences(source, tmp_path):
    def inputs(folder):
        return AnnotatedAmass(source, folder, 20, SmplRepresentation(), recordings=CmuRecordings).fingerprint()

    first = inputs(shared(tmp_path / "a"))
    assert first == inputs(shared(tmp_path / "b"))
    assert first != inputs(shared(tmp_path / "c", captions=CAPTIONS | {"000002": "jumps#jump/VERB#0.0#0.0\n"}))


@pytest.mark.slow
def test_a_real_recording_gets_the_seconds_that_humanml3d_cut_from_it(tmp_path):
    archive = Path(os.environ.get("STMC_DATA", "../shared/data")) / "cmu" / "cmu.tar.xz"
    if not archive.is_file():
        pytest.skip("STMC_DATA is not set or has no cmu/cmu.tar.xz")
    wanted = ("01.asf", "01_01.amc")
    with tarfile.open(archive, "r:xz") as file:
        for member in file:
            if Path(member.name).name in wanted:
                (tmp_path / "cmu").mkdir(exist_ok=True)
                (tmp_path / "cmu" / Path(member.name).name).write_bytes(file.extractfile(member).read())
            if (tmp_path / "cmu" / wanted[1]).exists():
                break
    index = HEADER + "./pose_data/CMU/01/01_01_poses.npy,201,401,000002.npy\n"
    index += "./pose_data/CMU/01/01_01_poses.npy,19,219,000003.npy\n"
    cache = prepared(tmp_path / "cmu", shared(tmp_path / "texts", index), tmp_path / "scratch", longest=30.0)
    [jumps] = [clip for clip in cache.clips if clip.name == "000002/0"]
    assert jumps.end - jumps.start == 200
    height = cache.features[jumps.start : jumps.end, SmplRepresentation().layout["root_height"]]
    assert height.max() - height.median() > 0.2, "he jumps forward"
