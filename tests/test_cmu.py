"""CMU's database: made-up recordings in each of its formats, and what becomes of them."""

import csv
import dataclasses
import json
import tarfile
from importlib.resources import files

import pytest
import torch
from conftest import data_file
from helpers.acclaim_files import Actor, moving
from helpers.source_folders import Serial

from stmc.data import preparation
from stmc.data.sources.cmu import asf, cmu_clips
from stmc.data.sources.cmu import catalogue as cmu
from stmc.data.sources.cmu.asf import AcclaimError, parse_amc, parse_asf
from stmc.data.sources.contents import CONTENTS, FORWARD_WALKS
from stmc.data.sources.segments import Segment, read_segments, splits, table
from stmc.formats.bvh_parser import parse_bvh
from stmc.motion.body import JOINTS, NUM_ROTATIONS, PARENTS
from stmc.motion.body_model import Skeleton
from stmc.motion.geometry import axis_angle_to_matrix, global_rotations

UP = torch.tensor([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]], dtype=torch.float64)
BODY = Skeleton(Skeleton.default().offsets.double())
TRUNK = [JOINTS.index(joint) for joint in ("pelvis", "spine1", "spine3", "neck", "head", "left_collar", "right_wrist")]


def actor(names=cmu.FORMATS[0], frames=240, **settings):
    return Actor(dict(names), *moving(frames), **settings)


def shown(motion, recorded):
    """World rotations of a motion at CMU's rate beside those that were recorded, in our axes."""
    return global_rotations(motion.rotations, PARENTS[:NUM_ROTATIONS]), UP @ recorded.turns


@pytest.mark.parametrize("names", cmu.FORMATS, ids=("native", "MotionBuilder", "MotionBuilder 131", "Daz"))
def test_every_format_gives_the_recorded_turns_of_the_trunk_and_directions_of_the_limbs(names):
    recorded = actor(names)
    text = recorded.bvh(t_pose=names is not cmu.FORMATS[0])
    motion = cmu.read(cmu.Source("01_01", text), BODY, 120)
    assert (motion.frames, motion.fps) == (240, 120)
    found, turns = shown(motion, recorded)
    torch.testing.assert_close(found[:, TRUNK], turns[:, TRUNK], atol=1e-6, rtol=0)
    for side in ("left", "right"):
        for joint, end in (("hip", "knee"), ("knee", "ankle"), ("shoulder", "elbow"), ("elbow", "wrist")):
            joint, end = f"{side}_{joint}", f"{side}_{end}"
            bone = motion.joints[:, JOINTS.index(end)] - motion.joints[:, JOINTS.index(joint)]
            rest = torch.from_numpy(recorded.offsets[end] / (recorded.offsets[end] @ recorded.offsets[end]) ** 0.5)
            expected = turns[:, JOINTS.index(joint)] @ rest
            torch.testing.assert_close(bone / bone.norm(dim=-1, keepdim=True), expected, atol=1e-5, rtol=0)


def test_asf_and_amc_say_what_bvh_says():
    recorded = actor()
    native = parse_amc(recorded.amc(), parse_asf(recorded.asf()), 120)
    motion = cmu.retarget(native, BODY, 20)
    same = cmu.retarget(parse_bvh(recorded.bvh()), BODY, 20)
    torch.testing.assert_close(motion.rotations, same.rotations, atol=1e-6, rtol=0)
    torch.testing.assert_close(motion.translation, same.translation, atol=1e-6, rtol=0)


def test_an_asf_bone_turns_about_the_axes_of_its_own_frame():
    bone = " id 1\n name arm\n direction 1 0 0\n length 2\n axis 0 0 90 XYZ\n dof rx\n limits (0 1)\n"
    head = ":units\n angle deg\n:root\n order TX TY TZ RX RY RZ\n:bonedata\n begin\n"
    skeleton = parse_asf(f"{head}{bone} end\n:hierarchy\n begin\n root arm\n end\n")
    recording = parse_amc(":DEGREES\n1\nroot 1 2 3 0 0 0\narm 90\n", skeleton, 120)
    turned = recording.rotations[0, 1] @ torch.tensor([1.0, 0.0, 0.0], dtype=torch.float64)
    torch.testing.assert_close(turned, torch.tensor([0.0, 0.0, -1.0], dtype=torch.float64))  # about y, not about x
    assert recording.positions[0, 0].tolist() == [1, 2, 3]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda asf, amc: (asf.replace("angle deg", "angle rad"), amc), "must be in degrees"),
        (lambda asf, amc: (asf.replace(":hierarchy", ":nothing"), amc), "hierarchy are missing"),
        (lambda asf, amc: (asf.replace("name head\n", "name thorax\n"), amc), "bone 'thorax': it is duplicated"),
        (lambda asf, amc: (asf.replace("length 1\n", "length long\n", 1), amc), "could not convert"),
        (lambda asf, amc: (asf.replace("length 1\n", "length\n", 1), amc), "one or three numbers"),
        (lambda asf, amc: (asf.replace("length 1\n", "length inf\n", 1), amc), "one or three numbers below"),
        (lambda asf, amc: (asf, amc.replace("\nhead ", "\nhead 1e300 ", 1).replace("e300 ", "e300", 1)), "bone 'head'"),
        (lambda asf, amc: (asf, amc.replace("\nhead ", f"\nhead {'9' * 50} ")), "one of more than 40 letters"),
        (lambda asf, amc: (asf, amc.replace(":DEGREES", "")), "no frames"),
        (lambda asf, amc: (asf, amc.replace("\nhead ", "\ntail ")), "'tail' is not a bone of the skeleton"),
        (lambda asf, amc: (asf, amc.rstrip().rpartition(" ")[0]), "truncated or damaged"),
        (lambda asf, amc: (asf, amc.replace("\nhead ", "\nhead nan ", 1).replace("nan ", "nan", 1)), "bone 'head'"),
    ],
)
def test_files_that_are_no_acclaim_recording_say_why(change, message):
    recorded = actor(frames=3)
    asf, amc = change(recorded.asf(), recorded.amc())
    with pytest.raises(AcclaimError, match=message):
        parse_amc(amc, parse_asf(asf), 120)


def test_the_unit_does_not_matter_and_the_path_is_scaled_by_the_legs():
    inches, centimetres = actor(unit=0.06), actor(unit=0.01)
    motions = [cmu.retarget(parse_bvh(each.bvh()), BODY, 20) for each in (inches, centimetres)]
    torch.testing.assert_close(motions[0].joints, motions[1].joints, atol=1e-5, rtol=0)
    small = dataclasses.replace(inches, path=inches.path / 2)
    small.offsets = {joint: offset / 2 for joint, offset in small.offsets.items()}
    child = cmu.retarget(parse_bvh(small.bvh()), BODY, 20)
    torch.testing.assert_close(child.joints, motions[0].joints, atol=1e-5, rtol=0)


def test_feet_stand_on_the_floor_wherever_the_recording_has_it():
    recorded = actor()
    low = dataclasses.replace(recorded, path=recorded.path - torch.tensor([0.0, 0.4, 0.0]))
    for each in (recorded, low):
        motion = cmu.retarget(parse_bvh(each.bvh()), BODY, 20)
        toes = motion.joints[:, [JOINTS.index("left_foot"), JOINTS.index("right_foot")], 2].amin(dim=1)
        assert float(toes.quantile(cmu.CONTACT)) == pytest.approx(0, abs=1e-9)


def test_salsa_is_half_as_fast_as_its_header_says():
    text = actor(cmu.DAZ).bvh(t_pose=True)
    assert cmu.read(cmu.Source("salsa_01", text), BODY, 20).frames == 80
    assert cmu.read(cmu.Source("13_01", text), BODY, 20).frames == 40


def test_a_bone_that_flips_away_and_back_goes_the_direct_way():
    angle = torch.linspace(0, 1, 30, dtype=torch.float64)
    smooth = axis_angle_to_matrix(torch.stack([angle, 0 * angle, 0 * angle], dim=-1))[:, None]
    flipped = smooth.clone()
    flipped[10:14] = flipped[10:14] @ axis_angle_to_matrix(torch.tensor([0.0, 3.0, 0.0], dtype=torch.float64))
    torch.testing.assert_close(cmu.remove_spikes(flipped), smooth)
    turning = smooth.clone()
    turning[10:] = turning[10:] @ axis_angle_to_matrix(torch.tensor([0.0, 3.0, 0.0], dtype=torch.float64))
    torch.testing.assert_close(cmu.remove_spikes(turning), turning)  # it never came back


def test_recordings_that_cannot_be_used_say_why():
    leaping = actor()
    leaping.path[100:] += 3.0
    with pytest.raises(cmu.CmuError, match=r"the pelvis leaps \d\.\d\d m"):
        cmu.retarget(parse_bvh(leaping.bvh()), BODY, 20)
    with pytest.raises(cmu.CmuError, match="unknown skeleton with joints Spine"):
        cmu.read(cmu.Source("01_01", actor().bvh().replace("root", "Spine")), BODY, 20)
    with pytest.raises(cmu.CmuError, match="frames are too few"):
        cmu.read(cmu.Source("01_01", actor(cmu.DAZ, frames=1).bvh(t_pose=True)), BODY, 20)


def test_a_skeleton_without_legs_is_refused():
    recorded = actor()
    for joint in ("knee", "ankle"):
        recorded.offsets[f"left_{joint}"] = 0 * recorded.offsets[f"left_{joint}"]
    with pytest.raises(cmu.CmuError, match="legs have no length"):
        cmu.retarget(parse_bvh(recorded.bvh()), BODY, 20)


def test_more_frames_of_bones_than_anybody_records_are_refused(monkeypatch):
    recorded = actor(frames=3)
    monkeypatch.setattr(asf, "MOST_VALUES", 100)
    with pytest.raises(AcclaimError, match=r"3 frames of \d+ bones: more than 100, the limit"):
        parse_amc(recorded.amc(), parse_asf(recorded.asf()), 120)


# Folders, archives and the cache ----------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A subject with a skeleton, one who borrows it, a conversion, a copy and a damaged file."""
    folder, recorded = tmp_path_factory.mktemp("cmu"), actor(frames=600)
    (folder / "subjects" / "16").mkdir(parents=True)
    (folder / "subjects" / "16" / "16.asf").write_text(recorded.asf())
    for name in ("16_01", "16_02", "16_03"):
        (folder / "subjects" / "16" / f"{name}.amc").write_text(recorded.amc())
    (folder / "subjects" / "16" / "16_04.amc").write_text(recorded.amc()[:-40])
    (folder / "35").mkdir()
    (folder / "35" / "35_17.amc").write_text(recorded.amc())
    (folder / "bvh").mkdir()
    converted = actor(cmu.DAZ, frames=600).bvh(t_pose=True)
    for name in ("13_11", "16_03"):
        (folder / "bvh" / f"{name}.bvh").write_text(converted)
    return folder


def test_sources_are_named_once_and_read_with_their_own_or_a_known_skeleton(folder, tmp_path):
    found = list(cmu.read_sources(folder))
    names = [source.name for source in found if isinstance(source, cmu.Source)]
    assert names == ["35_17", "13_11", "16_03", "16_01", "16_02", "16_04"]
    assert ("16_03 (subjects/16/16_03.amc)", "a second recording of this name") in found
    with tarfile.open(tmp_path / "cmu.tar.xz", "w:xz", preset=0) as archive:
        archive.add(folder, arcname="cmu")
    assert [each.text for each in cmu.read_sources(tmp_path / "cmu.tar.xz") if isinstance(each, cmu.Source)] == [
        each.text for each in found if isinstance(each, cmu.Source)
    ]
    (tmp_path / "07").mkdir()
    (tmp_path / "07" / "07_01.amc").write_text("")
    assert next(cmu.read_sources(tmp_path / "07"))[1].startswith("no skeleton")


def test_what_cannot_be_read_is_named_with_the_reason_and_skeletons_are_few_and_short(tmp_path, monkeypatch):
    (tmp_path / "16_01.amc").mkdir()
    (tmp_path / "16.asf").write_text("too long")
    (tmp_path / "16_02.amc").write_text("")
    monkeypatch.setattr(cmu, "LONGEST_SKELETON", 4)
    found = dict(cmu.read_sources(tmp_path))
    assert found["16_01"] == "a directory, not a file"
    assert found["16_02"].startswith("no skeleton")
    monkeypatch.setattr(cmu, "MOST_SKELETONS", 1)
    for name in ("17", "18"):
        (tmp_path / f"{name}.asf").write_text("asf")
    with pytest.raises(ValueError, match=r"more than 1 \.asf files, the limit"):
        next(cmu.read_sources(tmp_path))


def test_a_cache_depends_on_the_files_the_frame_rate_and_the_version(folder, monkeypatch):
    first, second = (cmu_clips.CmuClips(folder, fps).fingerprint() for fps in (20, 30))
    assert first != second == cmu_clips.CmuClips(str(folder), 30).fingerprint()
    monkeypatch.setattr(cmu_clips, "CACHE_VERSION", cmu_clips.CACHE_VERSION + 1)
    assert cmu_clips.CmuClips(folder, 20).fingerprint() != first


def test_a_place_without_recordings_is_an_error(tmp_path):
    with pytest.raises(FileNotFoundError, match="does not exist"):
        list(cmu.read_sources(tmp_path / "nowhere"))
    with pytest.raises(ValueError, match=r"contains no \.amc or \.bvh"):
        list(cmu.read_sources(tmp_path))
    (tmp_path / "half.tar.xz").write_bytes(b"\xfd7zXZ\x00")
    with pytest.raises(ValueError, match="truncated or damaged"):
        list(cmu.read_sources(tmp_path / "half.tar.xz"))


@pytest.fixture(scope="module")
def cache(folder, tmp_path_factory):
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(preparation, "ProcessPoolExecutor", Serial)
        clips = cmu_clips.CmuClips(folder, 20)
        clips.check()
        return clips.prepared(tmp_path_factory.mktemp("scratch"), 1, lambda items, total: items)


def test_the_cache_holds_every_segment_beside_its_mirror_image_and_names_what_is_missing(cache):
    rows = [segment for name in ("13_11", "16_01", "16_02", "16_03", "35_17") for segment in read_segments("cmu")[name]]
    assert [clip.content for clip in cache.clips if not clip.mirrored] == [segment.content for segment in rows]
    assert len(cache.clips) == 2 * len(rows)
    for clip in cache.clips:
        assert clip.split == splits().get(clip.name.removeprefix("M/").partition("/")[0], "train")
        assert [text for text, _ in cache.texts[clip.texts]] == list(CONTENTS[clip.content].sentences)
    skipped = dict(cache.skipped)
    assert "truncated or damaged" in skipped["16_04"]
    assert skipped["14_06"] == "not among the recordings"


def test_heights_are_above_the_recording_s_floor_and_not_above_the_segment_s_lowest_joint(folder):
    recorded = actor(frames=600)
    source = cmu.Source("16_01", recorded.amc(), recorded.asf())
    motion = cmu.read(source, BODY, 20)
    [(_, features), *_] = cmu_clips.convert(source, 20)
    first = round(read_segments("cmu")["16_01"][0].start * 20)
    torch.testing.assert_close(
        features[:, 0].double(), motion.translation[first : first + len(features), 2], atol=1e-6, rtol=0
    )


# Segments and sentences -------------------------------------------------------------------------------------------


def test_every_segment_lies_in_time_and_shows_a_known_content():
    for dataset in ("cmu", "bandai"):
        for name, rows in read_segments(dataset).items():
            for row in rows:
                assert isinstance(row, Segment) and row.recording == name
                assert 0 <= row.start < row.end and row.content in CONTENTS
        assert len({tuple(row) for row in table()[dataset]}) == len(table()[dataset])
    assert {row.content for rows in read_segments("cmu").values() for row in rows} >= set(splits()) & set(CONTENTS)


def test_nothing_held_out_is_unknown():
    assert set(splits()) <= set(read_segments("cmu"))


def test_a_content_has_many_sentences_and_three_that_no_training_sees():
    said = {text for content in CONTENTS.values() for text in content.sentences}
    asked = [text for content in CONTENTS.values() if content.name not in FORWARD_WALKS[1:] for text in content.unseen]
    assert len(asked) == len(set(asked)) and not said & set(asked)
    assert all(len(content.sentences) >= 30 for content in CONTENTS.values())
    assert {len(content.unseen) for content in CONTENTS.values()} == {0, 3}


@pytest.mark.parametrize("name", ["contents", "segments"])
def test_the_files_are_json_in_lines_that_people_can_read(name):
    text = (files("stmc") / "assets" / f"{name}.json").read_text("utf-8")
    assert json.loads(text)
    assert max(map(len, text.splitlines())) < 1000


@pytest.mark.data
def test_segments_lie_within_the_real_recordings():
    with data_file("cmu/trials.csv").open(newline="") as file:
        seconds = {row["trial"]: float(row["seconds"]) for row in csv.DictReader(file)}
    for name, rows in read_segments("cmu").items():
        assert max(row.end for row in rows) <= seconds[name], name
