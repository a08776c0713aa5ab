"""Annotations of AMASS: TMR's and BABEL's files are read, entries that cannot be used are named, others untouched."""

import json

import pytest
from helpers.source_folders import PUBLISHED, babel, published

from stmc.data.preparation import LayoutError
from stmc.data.sources.amass.annotations import Segment, read_annotations, with_mirror_images


def by_name(annotations):
    return {entry.name: entry for entry in annotations.entries}


def test_published_annotations_are_read_split_by_split(tmp_path):
    annotations = read_annotations(published(tmp_path))
    assert annotations.skipped == ()
    entries = by_name(annotations)
    assert {name: entry.split for name, entry in entries.items()} == {k: v[1] for k, v in PUBLISHED.items()}
    assert entries["000002"].path == "CMU/01/01_01_poses"
    assert entries["000002"].segments == (Segment("walks", 0.0, 3.0), Segment("a man lifts his right arm", 0.5, 2.75))
    image = entries["M000000"]
    assert (image.path, image.mirrored) == ("KIT/3/kick_high_left02_poses", True)
    assert not entries["000000"].mirrored


def test_a_mirror_image_that_is_listed_but_not_annotated_has_its_original_s_texts_with_sides_exchanged(tmp_path):
    folder = published(tmp_path, {name: PUBLISHED[name] for name in ("000000", "000002")})
    (folder / "splits/train.txt").write_text("000000\nM000000\n")
    image = by_name(read_annotations(folder))["M000000"]
    assert image.mirrored
    assert image.segments == (Segment("someone walks and raises the left arm", 0.0, 3.0),)


def test_an_id_that_begins_with_m_is_a_mirror_image_whether_its_path_says_so_or_not(tmp_path):
    entries = {"000000": PUBLISHED["000000"], "M000000": ("KIT/3/kick_high_left02_poses", "train", (("left", 0, 3),))}
    entries |= {"000002": PUBLISHED["000002"]}
    assert by_name(read_annotations(published(tmp_path, entries)))["M000000"].mirrored


def test_annotations_without_mirror_images_get_some_for_training_only(tmp_path):
    annotations = with_mirror_images(read_annotations(babel(tmp_path)))
    images = [entry for entry in annotations.entries if entry.mirrored]
    assert [(entry.name, entry.split) for entry in images] == [("M1", "train")]
    assert images[0].segments[1].text == "raise left arm"
    own = read_annotations(published(tmp_path / "own"))
    assert with_mirror_images(own) is own


def test_babel_s_frames_are_segments_its_transitions_are_none_and_a_whole_sequence_is_one(tmp_path):
    entries = by_name(read_annotations(babel(tmp_path)))
    assert entries["1"].path == "KIT/3/kick_high_left02_poses"
    assert entries["1"].segments == (Segment("walk", 0.0, 1.5), Segment("raise right arm", 1.75, 3.0))
    assert entries["2"].path == "BioMotionLab_NTroje/rub001/0000_treadmill_norm_poses"
    assert entries["2"].segments == (Segment("walking", 0.0, None),)
    assert (entries["1"].split, entries["2"].split) == ("train", "val")


def entry(path="KIT/3/kick_poses", **changes):
    annotation = {"seg_id": "x_0", "text": "walks", "start": 0.0, "end": 3.0} | changes
    return {"path": path, "duration": 3.0, "annotations": [annotation]}


BAD = {
    "humanact12": (entry("humanact12/humanact12/P01G01R01F0001T0064A0101"), "HumanAct12: it has no SMPL poses"),
    "mirrored humanact12": (entry("M/humanact12/humanact12/P01"), "HumanAct12: it has no SMPL poses"),
    "above": (entry("../../etc/passwd"), "path outside of AMASS: '../../etc/passwd'"),
    "absolute": (entry("/etc/passwd/x"), "path outside of AMASS"),
    "backslashes": (entry("KIT\\..\\..\\x"), "path outside of AMASS"),
    "drive": (entry("C:/KIT/3/x"), "path outside of AMASS"),
    "no folder": (entry("kick"), "malformed annotation: path is 'kick'"),
    "M alone": (entry("M"), "malformed annotation: path is 'M'"),
    "no path": (entry(None), "malformed annotation: path is None"),
    "no text": (entry(text="  "), "malformed annotation: no text"),
    "text a number": (entry(text=3), "malformed annotation: no text"),
    "end before start": (entry(start=2.0, end=1.0), "malformed annotation: from 2.0 to 1.0 s"),
    "before the beginning": (entry(start=-1.0), "malformed annotation: from -1.0"),
    "words for seconds": (entry(start="0"), "must be seconds"),
    "no end": (entry(end=None), "must be seconds"),
    "endless": (entry(end=float("inf")), "must be seconds"),
    "NaN": (entry(end=float("nan")), "must be seconds"),
    "a list": ([], "it must have a path and a list of annotations"),
    "empty": ({"path": "KIT/3/x_poses", "annotations": []}, "it must have a path and a list of annotations"),
}


@pytest.mark.parametrize(("value", "reason"), BAD.values(), ids=BAD)
def test_an_entry_that_cannot_be_used_is_named_and_the_others_are_read(value, reason, tmp_path):
    annotations = read_annotations(published(tmp_path, bad=value))
    assert len(annotations.entries) == len(PUBLISHED)
    [(name, why)] = annotations.skipped
    assert name == "bad"
    assert reason in why


def test_entries_in_no_split_and_names_without_entries_are_counted(tmp_path):
    folder = published(tmp_path)
    (folder / "splits/test.txt").write_text("999999\n")
    assert read_annotations(folder).skipped == (
        ("999999", "listed but not annotated: in splits/test.txt alone"),
        ("000003", "in no split"),
    )


@pytest.mark.parametrize(
    ("value", "reason"),
    [
        ({"feat_p": "KIT/../../x.npz"}, "path outside of AMASS"),
        ({"feat_p": None}, "malformed annotation: path is None"),
        ({"frame_ann": None, "seq_ann": None}, "neither frame_ann nor seq_ann has labels"),
        ({"frame_ann": {"labels": 3}}, "neither frame_ann nor seq_ann has labels"),
        ({"frame_ann": {"labels": [{"proc_label": "transition", "raw_label": "x"}]}}, "no label but transitions"),
        ({"frame_ann": {"labels": [{"raw_label": "x", "start_t": 2, "end_t": 1}]}}, "from 2 to 1 s"),
        ({"frame_ann": {"labels": ["walk"]}}, "no raw_label in 'walk'"),
        ("text", "malformed annotation"),
    ],
)
def test_a_sequence_of_babel_s_that_cannot_be_used_is_named(value, reason, tmp_path):
    folder = babel(tmp_path)
    table = json.loads((folder / "train.json").read_text())
    bad = table["1"] | value if isinstance(value, dict) else value
    (folder / "train.json").write_text(json.dumps(table | {"bad": bad}))
    annotations = read_annotations(folder)
    assert [name for name, _ in annotations.skipped] == ["bad"]
    assert reason in annotations.skipped[0][1]
    assert len(annotations.entries) == 2


@pytest.mark.parametrize(
    ("file", "content", "message"),
    [
        ("annotations.json", "{", r"annotations\.json is not JSON"),
        ("annotations.json", "[" * 100_000, r"annotations\.json is not JSON"),
        ("annotations.json", "[]", "must be a JSON object with an entry for every sequence"),
        ("splits/train.txt", None, r"splits/train\.txt is missing"),
        ("splits/val.txt", "", r"val\.txt lists nothing"),
        ("annotations.json", None, r"expected annotations\.json with splits.*BABEL's.*found \['splits'\]"),
    ],
)
def test_a_folder_that_holds_no_annotations_says_what_was_expected(file, content, message, tmp_path):
    folder = published(tmp_path)
    (folder / file).unlink()
    if content is not None:
        (folder / file).write_text(content)
    with pytest.raises(LayoutError, match=message):
        read_annotations(folder)


def test_annotations_may_have_no_test_split_and_no_folder_is_an_error(tmp_path):
    folder = published(tmp_path / "a")
    (folder / "splits/test.txt").unlink()
    assert {entry.split for entry in read_annotations(folder).entries} == {"train", "val"}
    with pytest.raises(LayoutError, match="no such folder"):
        read_annotations(tmp_path / "nowhere")
