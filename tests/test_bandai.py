"""The Bandai data set: made-up clips with its skeleton, whose every number is known, and a few real ones."""

import io
import json
import math
import os
import sys
import tarfile
from collections import Counter
from importlib.resources import files

import pytest
import torch
from conftest import data_file
from helpers.bandai_files import UP, bvh_text, posed, skeleton, standing, tumbling
from helpers.source_folders import Serial

from stmc.data import preparation
from stmc.data.cache import Cache
from stmc.data.sources import archives
from stmc.data.sources.bandai import bandai_clips
from stmc.data.sources.bandai import recordings as bandai
from stmc.data.sources.bandai.bandai_clips import BandaiClips
from stmc.data.sources.contents import CONTENTS, STYLES, describe
from stmc.data.sources.segments import read_segments
from stmc.evaluation.metrics.liveliness import motion_energy
from stmc.formats.bvh_parser import Bvh, BvhError, parse_bvh
from stmc.io.untrusted import UnreadableError
from stmc.motion.body import JOINTS, MIRROR, NUM_ROTATIONS, PARENTS
from stmc.motion.body_model import Skeleton
from stmc.motion.geometry import mirror_positions
from stmc.motion.kinematics import forward_speed, turn, wrist_height
from stmc.motion.motion import Motion
from stmc.motion.representation import SmplRepresentation

FPS = 20


def source_joints(bvh: Bvh) -> dict[str, torch.Tensor]:
    """Where the file itself puts each joint that SMPL has too: metres, z up."""
    _, positions = bvh.world()
    return {joint: 0.01 * positions[:, bvh.names.index(name)] @ UP.T for joint, name in bandai.SOURCE_JOINTS.items()}


def distances(motion: Motion, bvh: Bvh) -> torch.Tensor:
    """From each joint to the file's own, in metres, once the clip's floor is taken away; [frames, joints]."""
    own = source_joints(bvh)
    floor = (own["pelvis"][:, 2] - motion.translation[:, 2]).mean()
    moved = [motion.joints[:, JOINTS.index(joint)] - place for joint, place in own.items()]
    return (torch.stack(moved, dim=1) + torch.tensor([0.0, 0.0, float(floor)])).norm(dim=-1)


# Retargeting made-up clips ----------------------------------------------------------------------------------------


def test_any_clip_s_joints_are_the_file_s_own_up_to_the_floor():
    bvh = parse_bvh(bvh_text(tumbling()))
    motion = bandai.retarget(bvh, skeleton())
    assert distances(motion, bvh).max() < 1e-4
    assert motion.fps == 30


def test_any_clip_s_rotations_come_back_as_they_were_written():
    original = tumbling(seed=1)
    motion = bandai.retarget(parse_bvh(bvh_text(original)), skeleton())
    torch.testing.assert_close(motion.rotations, original.rotations, atol=1e-6, rtol=0)


def test_the_lowest_foot_of_the_clip_stands_on_the_floor():
    for height in (0.2, 1.0, 7.0):
        motion = bandai.retarget(parse_bvh(bvh_text(standing(height=height))), skeleton())
        assert motion.joints[..., 2].min() == pytest.approx(0, abs=1e-6)
    jump = tumbling()
    motion = bandai.retarget(parse_bvh(bvh_text(jump)), skeleton())
    shift = motion.translation - jump.translation
    assert shift[:, :2].abs().max() < 1e-6, "only up and down"
    assert shift[:, 2].std() < 1e-6, "as much in every frame"


def test_a_hand_below_the_feet_lifts_nobody():
    feet = [JOINTS.index(f"{side}_{name}") for side in ("left", "right") for name in ("ankle", "foot")]
    motions = [bandai.retarget(parse_bvh(bvh_text(tumbling(seed=seed))), skeleton()) for seed in range(4)]
    assert all(motion.joints[:, feet, 2].min() == pytest.approx(0, abs=1e-6) for motion in motions)
    assert any(motion.joints[..., 2].min() < -0.02 for motion in motions), "in some, another joint is lower"


def test_a_t_pose_gives_no_rotations_but_standing_upright():
    motion = bandai.retarget(parse_bvh(bvh_text(standing())), skeleton())
    torch.testing.assert_close(motion.rotations[:, 0], UP.expand(motion.frames, 3, 3), atol=1e-7, rtol=0)
    identity = torch.eye(3, dtype=torch.float64).expand(motion.frames, NUM_ROTATIONS - 1, 3, 3)
    torch.testing.assert_close(motion.rotations[:, 1:], identity, atol=1e-7, rtol=0)
    assert motion.heading.abs().max() < 1e-7


def test_the_constants_lay_the_dataset_s_bones_where_smpl_s_rest_pose_has_them():
    """The dataset's bones run along +x of their own joint, on the right along -x (its description says)."""
    offsets = skeleton().offsets
    for child in ("neck", "head", *(f"{s}_{j}" for s in ("left", "right") for j in ("elbow", "wrist", "knee", "foot"))):
        parent = JOINTS[PARENTS[JOINTS.index(child)]]
        [rest] = bandai.rest_rotations([bandai.SOURCE_JOINTS[parent]])
        along = rest[:, 0] * (-1 if child.startswith("right") else 1)
        bone = offsets[JOINTS.index(child)]
        assert torch.dot(along, bone / bone.norm()) > 0.98, child
    everything = bandai.rest_rotations(bandai.SOURCE_JOINTS.values())
    torch.testing.assert_close(everything @ everything.mT, torch.eye(3).double().expand(len(everything), 3, 3))
    assert (torch.linalg.det(everything) > 0).all()


def test_a_raised_left_arm_is_a_raised_left_arm():
    up = torch.tensor([[0.0, 0.0, math.pi / 2]], dtype=torch.float64).repeat(10, 1)
    clip = posed({"left_shoulder": up}, torch.tensor([[0.0, 0.0, 1.0]], dtype=torch.float64).repeat(10, 1))
    motion = bandai.retarget(parse_bvh(bvh_text(clip)), skeleton())
    assert wrist_height(motion, "left", "shoulder").min() > 0.4
    assert wrist_height(motion, "right", "shoulder").abs().max() < 0.1


def test_a_clip_that_lacks_joints_says_which():
    text = bvh_text(standing()).replace("JOINT Neck", "JOINT Nck").replace("JOINT Toes_L", "JOINT Toe")
    with pytest.raises(BvhError, match="joints Neck, Toes_L are missing"):
        bandai.retarget(parse_bvh(text), skeleton())


# Clips as rows of the cache ---------------------------------------------------------------------------------------


def walking(frames: int = 45) -> Motion:
    """Leaning, turning and swinging a raised left arm while going sideways: nothing in it is its own mirror image."""
    time = torch.arange(frames, dtype=torch.float64) / 30
    zero = torch.zeros_like(time)
    pelvis = torch.stack([0.5 * time, -1.2 * time, 1 + 0.02 * torch.sin(9 * time)], dim=-1)
    turns = {
        "left_shoulder": torch.stack([zero, 0.3 * torch.sin(5 * time), zero + 1.0], dim=-1),
        "right_shoulder": torch.stack([zero, zero, zero + 1.2], dim=-1),
        "left_hip": torch.stack([0.5 * torch.sin(6 * time), zero, zero], dim=-1),
        "spine1": torch.stack([zero + 0.2, zero, zero + 0.1], dim=-1),
    }
    return posed(turns, pelvis, heading=0.4 * time + 0.3)


@pytest.fixture(scope="module")
def rows() -> list:
    return bandai.convert("dataset-2_raise-up-left-hand_active_007", bvh_text(walking()), FPS)


def test_a_clip_becomes_two_rows_with_what_its_name_says_and_the_mirror_image_of_it(rows):
    (clip, features), (image, mirrored) = rows
    assert (clip.name, clip.content, clip.style) == (
        "dataset-2_raise-up-left-hand_active_007", "raise-up-left-hand", "active",
    )  # fmt: skip
    assert (image.name, image.content, image.style) == (f"M/{clip.name}", "raise-up-right-hand", "active")
    assert (clip.mirrored, image.mirrored) == (False, True)
    assert (clip.texts, image.texts) == ("raise-up-left-hand/active", "raise-up-right-hand/active")
    assert not clip.cyclic
    assert (clip.parts, image.parts) == (("left arm",), ("right arm",))
    assert (clip.start, clip.end) == (0, 30), "45 frames at 30 fps are 30 at 20"
    assert features.shape == mirrored.shape == (30, 205)
    assert features.dtype == torch.float32


def test_the_features_are_those_of_the_clip_at_the_new_rate_on_the_bundled_skeleton(rows):
    clip = walking()
    time = torch.arange(30) / FPS + 0.5 / FPS - 0.5 / 30  # the middles of the new frames among those of the old
    decoded = SmplRepresentation().decode(rows[0][1], FPS, Skeleton.default(), heading=float(0.3 + 0.4 * time[0]))
    torch.testing.assert_close(decoded.heading, (0.3 + 0.4 * time).float(), atol=1e-3, rtol=0)
    expected = torch.stack([0.5 * time, -1.2 * time], dim=-1).float()
    way = decoded.translation[:, :2] - decoded.translation[0, :2]
    torch.testing.assert_close(way, expected - expected[0], atol=2e-3, rtol=0)
    arm = clip.rotations[0, JOINTS.index("right_shoulder")].float()
    torch.testing.assert_close(decoded.rotations[5, JOINTS.index("right_shoulder")], arm, atol=1e-5, rtol=0)


def test_the_mirrored_row_is_the_mirror_image_seen_from_the_body(rows):
    representation = SmplRepresentation()
    motion, image = (representation.decode(features, FPS) for _, features in rows)
    torch.testing.assert_close(image.joints, mirror_positions(motion.joints, MIRROR), atol=1e-4, rtol=0)
    assert wrist_height(motion, "left", "shoulder").min() > 0.3
    assert wrist_height(image, "right", "shoulder").min() > 0.3
    assert turn(image) == pytest.approx(-turn(motion), abs=1e-5)


def test_a_content_without_a_side_is_its_own_mirror_image():
    (clip, _), (image, _) = bandai.convert("dataset-1_walk_normal_001", bvh_text(walking()), FPS)
    assert clip.content == image.content == "walk"
    assert clip.cyclic


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("walk_normal_001", "'walk_normal_001' is not dataset-N_content_style_NNN"),
        ("dataset-3_walk_normal_001", "is not dataset-N"),
        ("dataset-1_walk_normal", "is not dataset-N"),
        ("dataset-1_fly_normal_001", "unknown action 'fly'; choose from walk"),
        ("dataset-1_walk_grumpy_001", "unknown style 'grumpy'; choose from normal"),
    ],
)
def test_a_name_that_is_not_the_dataset_s_says_why(name, message):
    with pytest.raises(ValueError, match=message):
        bandai.convert(name, "", FPS)


# Splits -----------------------------------------------------------------------------------------------------------


def all_names() -> list[bandai.ClipName]:
    """As many clips as the data set has of its contents, styles turn by turn."""
    counts = {"walk": 205, "run": 332, "dash": 15, "bow": 15, "raise-up-left-hand": 444, "wave-both-hands": 208}
    counts |= {"kick": 1, "slash": 2, "dance-short": 9}
    styles = list(STYLES)[:15]
    return [
        bandai.ClipName.parse(f"dataset-1_{content}_{styles[i % len(styles)]}_{i:03d}")
        for content, count in counts.items()
        for i in range(count)
    ]


def test_a_split_keeps_eighty_ten_ten_of_every_frequent_content():
    names = all_names()
    parts = bandai.split(names)
    assert set(parts) == {clip.name for clip in names}
    for content in ("walk", "run", "dash", "bow", "raise-up-left-hand", "wave-both-hands"):
        shares = Counter(parts[clip.name] for clip in names if clip.content == content)
        tenth = shares.total() // 10
        assert shares["val"] in (tenth, tenth + 1), content
        assert shares["test"] in (tenth, tenth + 1), content


def test_every_style_of_a_frequent_content_is_in_each_part():
    names = all_names()
    parts = bandai.split(names)
    for content in ("walk", "run", "raise-up-left-hand"):
        for part in ("train", "val", "test"):
            styles = {clip.style for clip in names if clip.content == content and parts[clip.name] == part}
            assert styles == {clip.style for clip in names if clip.content == content}, (content, part)


def test_rare_contents_are_for_training_alone():
    names = all_names()
    parts = bandai.split(names)
    rare = {parts[clip.name] for clip in names if clip.content in ("kick", "slash", "dance-short")}
    assert rare == {"train"}


def test_a_split_is_a_function_of_the_names_whatever_their_order():
    names = all_names()
    assert bandai.split(reversed(names)) == bandai.split(names)


# From files to a cache --------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def source(tmp_path_factory):
    """A folder as the archive unpacks, with one broken and one half file in it, and one that is not the dataset's."""
    folder = tmp_path_factory.mktemp("source")
    data = folder / "dataset" / "Bandai-Namco-Research-Motiondataset-1" / "data"
    data.mkdir(parents=True)
    text = bvh_text(standing(frames=8))
    for number in range(12):
        (data / f"dataset-1_wave-left-hand_normal_{number:03d}.bvh").write_text(text)
    (data / "dataset-1_wave-left-hand_normal_000.json").write_text("{}")
    (data / "dataset-1_walk_normal_001.bvh").write_text(text[: len(text) * 2 // 3])
    (data / "dataset-1_walk_normal_002.bvh").write_bytes(b"\xff\x00garbage")
    (data / "dataset-1_fly_normal_001.bvh").write_text(text)
    return folder


@pytest.fixture(scope="module")
def cache(source) -> Cache:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(preparation, "ProcessPoolExecutor", Serial)
        return bandai.gather(bandai.read_clips(source, FPS, workers=1), FPS)


def test_every_readable_clip_is_in_the_cache_beside_its_mirror_image_in_the_same_part(cache):
    assert len(cache.clips) == 24
    assert Counter(clip.content for clip in cache.clips) == {"wave-left-hand": 12, "wave-right-hand": 12}
    parts = {clip.name: clip.split for clip in cache.clips}
    for clip in cache.clips:
        assert parts[clip.name] == parts[clip.name.removeprefix("M/")]
    assert Counter(parts.values()) == {"train": 20, "val": 2, "test": 2}
    assert cache.texts["wave-left-hand/normal"] == describe("wave-left-hand", "normal")
    assert (cache.fps, cache.representation, cache.fingerprint) == (FPS, "smpl", "")


def test_files_that_cannot_be_used_are_skipped_with_their_names_and_the_reasons(cache):
    skipped = dict(cache.skipped)
    assert set(skipped) == {"dataset-1_walk_normal_001", "dataset-1_walk_normal_002", "dataset-1_fly_normal_001"}
    assert "numbers for 8 frames" in skipped["dataset-1_walk_normal_001"]
    assert "no MOTION section" in skipped["dataset-1_walk_normal_002"]
    assert "unknown action 'fly'" in skipped["dataset-1_fly_normal_001"]


def packed(source, path, mode: str = "w:xz"):
    with tarfile.open(path, mode) as archive:
        for file in reversed(sorted((source / "dataset").rglob("*.*"))):
            archive.add(file, arcname=file.relative_to(source))
    return path


def test_an_archive_gives_the_same_cache_as_the_folder_it_unpacks_to(source, cache, tmp_path):
    texts = dict(bandai.read_sources(packed(source, tmp_path / "dataset.tar.xz")))
    assert texts == dict(bandai.read_sources(source))
    clips = [(name, _converted(name, text)) for name, text in texts.items()]
    other = bandai.gather(clips, FPS)
    assert other.clips == cache.clips
    assert torch.equal(other.features, cache.features)
    assert dict(other.skipped) == dict(cache.skipped)


def _converted(name: str, text: str) -> list | str:
    try:
        return bandai.convert(name, text, FPS)
    except ValueError as error:
        return str(error)


@pytest.mark.skipif(sys.platform == "win32", reason="links and pipes")
def test_what_is_no_file_is_skipped_with_its_name_and_the_reason_and_the_rest_goes_on(tmp_path, monkeypatch):
    monkeypatch.setattr(archives, "MOST_BYTES", 100)
    os.mkfifo(tmp_path / "a_pipe.bvh")
    (tmp_path / "b_folder.bvh").mkdir()
    for name, target in (("c_loop", "c_loop.bvh"), ("d_gone", "nowhere"), ("e_zeros", "/dev/zero")):
        (tmp_path / f"{name}.bvh").symlink_to(target)
    with (tmp_path / "f_large.bvh").open("wb") as file:
        file.truncate(2**40)
    (tmp_path / "g_good.bvh").write_text("HIERARCHY")
    found = dict(bandai.read_sources(tmp_path))
    assert {name: str(text) for name, text in found.items()} == {
        "a_pipe": "a pipe or a device, not a file",
        "b_folder": "a directory, not a file",
        "c_loop": "not a path to a file (Too many levels of symbolic links)",
        "d_gone": "cannot be read (No such file or directory)",
        "e_zeros": "a pipe or a device, not a file",
        "f_large": f"larger than {100 / 2**20:g} MiB, the limit for such a file",
        "g_good": "HIERARCHY",
    }
    assert isinstance(found["a_pipe"], UnreadableError)


def archive(path, *members: tuple[str, bytes, int]) -> None:
    """A .tar.xz of members with these names, types and numbers of zeros."""
    with tarfile.open(path, "w:xz", preset=0) as file:
        for name, kind, size in members:
            member = tarfile.TarInfo(name)
            member.type, member.size, member.linkname = kind, size, "elsewhere"
            file.addfile(member, io.BytesIO(bytes(size)))


def test_members_of_an_archive_that_are_no_files_or_too_large_are_skipped(tmp_path, monkeypatch):
    monkeypatch.setattr(archives, "MOST_BYTES", 2**20)
    kinds = {"link": tarfile.SYMTYPE, "hard": tarfile.LNKTYPE, "pipe": tarfile.FIFOTYPE, "folder": tarfile.DIRTYPE}
    members = [(f"{name}.bvh", kind, 0) for name, kind in kinds.items()]
    archive(tmp_path / "a.tar.xz", *members, ("bomb.bvh", tarfile.REGTYPE, 2**24), ("good.bvh", tarfile.REGTYPE, 3))
    found = dict(bandai.read_sources(tmp_path / "a.tar.xz"))
    assert {name: str(text) for name, text in found.items()} == dict.fromkeys(
        kinds, "a member of the archive that is not a regular file"
    ) | {"bomb": "16,777,216 bytes, more than 1 MiB", "good": "\0\0\0"}


def test_archives_of_too_many_members_or_bytes_and_of_endless_headers_are_refused(tmp_path, monkeypatch):
    archive(tmp_path / "a.tar.xz", *[(f"{number}.bvh", tarfile.REGTYPE, 2**20) for number in range(4)])
    for name, limit in (("MOST_MEMBERS", 3), ("MOST_ARCHIVE", 3 * 2**20)):
        with monkeypatch.context() as patch, pytest.raises(ValueError, match=r"unpacks to more than .*read up to 2"):
            patch.setattr(archives, name, limit)
            list(bandai.read_sources(tmp_path / "a.tar.xz"))
    archive(tmp_path / "b.tar.xz", ("headers", tarfile.XHDTYPE, 2**24), ("a.bvh", tarfile.REGTYPE, 0))
    with pytest.raises(ValueError, match="headers of more than 1 MiB"):
        list(bandai.read_sources(tmp_path / "b.tar.xz"))


def test_a_clip_that_float32_cannot_hold_is_skipped_and_not_the_whole_data_set():
    good = bvh_text(standing(frames=8))
    lines = good.splitlines()
    for number in ("1e300", "3e38"):
        mad = "\n".join([*lines[:-1], f"{number} {lines[-1].partition(' ')[2]}"])
        cache = bandai.gather(
            [(name, _converted(name, text)) for name, text in (("dataset-1_walk_normal_001", mad), (GOOD, good))], FPS
        )
        assert [name for name, _ in cache.skipped] == ["dataset-1_walk_normal_001"]
        assert "finite" in cache.skipped[0][1]


GOOD = "dataset-1_wave-left-hand_normal_000"


def test_an_archive_that_breaks_off_is_an_error_and_not_a_smaller_data_set(source, tmp_path):
    whole = packed(source, tmp_path / "dataset.tar.xz").read_bytes()
    for kept in (len(whole) // 4, len(whole) // 2, len(whole) - 20, 100):
        (tmp_path / "half.tar.xz").write_bytes(whole[:kept])
        with pytest.raises(ValueError, match=r"half\.tar\.xz is not a \.tar\.xz, or is truncated or damaged"):
            list(bandai.read_sources(tmp_path / "half.tar.xz"))
    (tmp_path / "text.tar.xz").write_text("not an archive at all")
    with pytest.raises(ValueError, match=r"not a \.tar\.xz"):
        list(bandai.read_sources(tmp_path / "text.tar.xz"))


def test_a_place_without_clips_is_an_error_that_says_what_should_be_there(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"nowhere does not exist; it should be the dataset's \.tar\.xz"):
        list(bandai.read_sources(tmp_path / "nowhere"))
    (tmp_path / "notes.txt").write_text("nothing here")
    with pytest.raises(ValueError, match=r"holds no \.bvh file"):
        list(bandai.read_sources(tmp_path))


def test_nothing_but_broken_clips_is_an_error_that_names_the_first():
    with pytest.raises(ValueError, match="no clip could be read; the first: a: no MOTION"):
        bandai.gather([("a", "no MOTION section"), ("b", "no MOTION section")], FPS)


def test_a_second_clip_of_one_name_is_skipped_and_named(rows):
    cache = bandai.gather([(rows[0][0].name, rows)] * 2, FPS)
    assert len(cache.clips) == 2
    assert cache.skipped == ((rows[0][0].name, "a second clip of this name"),)


def test_the_fingerprint_is_of_the_clips_the_version_of_the_cache_and_the_frame_rate(source, monkeypatch):
    own = BandaiClips(source, FPS).fingerprint()
    assert BandaiClips(source, FPS).fingerprint() == own != BandaiClips(source, FPS + 1).fingerprint()
    monkeypatch.setattr(bandai_clips, "CACHE_VERSION", bandai_clips.CACHE_VERSION + 1)
    assert BandaiClips(source, FPS).fingerprint() != own


# The real thing ---------------------------------------------------------------------------------------------------

FIGURES = {
    "dataset-1_walk_normal_001": (1.2, 0),
    "dataset-1_run_normal_001": (2.7, 0),
    "dataset-1_dash_normal_001": (3.3, 0),
    "dataset-1_walk-back_normal_001": (-0.8, 0),
    "dataset-1_walk-left_normal_001": (0.85, 0),
    "dataset-1_bow_normal_001": (0.0, 0),
    "dataset-2_raise-up-left-hand_normal_001": (0.0, 0),
    "dataset-2_raise-up-right-hand_active_001": (0.0, 0),
    "dataset-2_wave-both-hands_normal_001": (0.0, 0),
    "dataset-2_walk_normal_001": (1.2, 0),
    "dataset-2_run_normal_001": (2.7, 0),
    "dataset-2_walk-turn-left_normal_001": (1.1, 90),
    "dataset-2_walk-turn-right_normal_001": (1.1, -90),
}
"""Metres a second along the heading and degrees turned to the left: the means over all clips of each content."""


DANCE = "dataset-1_dance-short_normal_001"


@pytest.fixture(scope="module")
def real() -> dict[str, Bvh]:
    """Those above and every two-hundredth clip: the archive has to be read through once, which takes its time."""
    archive = data_file("bandai/Bandai-Namco-Research-Motiondataset.tar.xz")
    chosen = {}
    for number, (name, text) in enumerate(bandai.read_sources(archive)):
        if name in FIGURES or name == DANCE or number % 200 == 50:
            chosen[name] = parse_bvh(text)
    assert number + 1 == bandai.CLIPS
    assert set(FIGURES) <= set(chosen)
    return chosen


@pytest.mark.data
@pytest.mark.slow
def test_real_clips_keep_their_joints_on_the_one_skeleton(real):
    errors = {name: distances(bandai.retarget(bvh, Skeleton.default()), bvh) for name, bvh in real.items()}
    assert len(errors) > 20
    assert max(error.mean() for error in errors.values()) < 0.005
    assert max(error.max() for error in errors.values()) < 0.02


def measured_offsets(bvh: Bvh) -> dict[str, tuple[float, float, float]]:
    """Measure every joint's rest offset to its parent, in metres and SMPL's axes, as stored in `assets/skeleton.json`.

    The hands (8 cm beyond the wrists) and the rest position of the pelvis (that of SMPL's neutral body) are not the
    dataset's, which has neither.
    """
    index = {joint: bvh.names.index(name) for joint, name in bandai.SOURCE_JOINTS.items()}
    local = bvh.positions.mean(dim=0) * 0.01
    offsets = {"pelvis": (-0.0018, -0.2233, 0.0282), "left_hand": (0.08, 0.0, 0.0), "right_hand": (-0.08, 0.0, 0.0)}
    for joint in JOINTS[1:NUM_ROTATIONS]:
        if joint.startswith("right_"):  # they differ from the left ones by half a millimetre
            x, y, z = offsets[joint.replace("right", "left")]
            offsets[joint] = (-x + 0.0, y, z)
            continue
        source = "spine3" if joint == "spine2" else joint
        parent = bvh.names[bvh.parents[index[source]]]
        offset = bandai.rest_rotations([parent])[0] @ local[index[source]]
        offset = offset / 2 if joint in ("spine2", "spine3") else offset  # spine2 is halfway between Spine and Chest
        offsets[joint] = tuple(round(value, 4) + 0.0 for value in offset.tolist())
    return {joint: offsets[joint] for joint in JOINTS}


@pytest.mark.data
@pytest.mark.slow
def test_the_bundled_skeleton_is_measured_on_the_real_clips(real):
    asset = json.loads((files("stmc") / "assets" / "skeleton.json").read_text("utf-8"))
    assert list(asset) == list(JOINTS)
    for bvh in list(real.values())[::5]:
        measured = measured_offsets(bvh)
        for joint in JOINTS:
            assert asset[joint] == pytest.approx(measured[joint], abs=2e-4), joint


@pytest.mark.data
@pytest.mark.slow
def test_real_clips_move_as_their_description_says(real):
    for name, (speed, degrees) in FIGURES.items():
        motion = bandai.retarget(real[name], Skeleton.default())
        assert float(forward_speed(motion).mean()) == pytest.approx(speed, abs=0.1 + 0.4 * abs(speed)), name
        assert math.degrees(turn(motion)) == pytest.approx(degrees, abs=30), name
        assert motion.joints[..., 2].min() == pytest.approx(0, abs=1e-6)


@pytest.mark.data
@pytest.mark.slow
def test_real_raises_lift_the_hand_that_their_name_says_and_lower_it_again(real):
    for name, raised, other in (
        ("dataset-2_raise-up-left-hand_normal_001", "left", "right"),
        ("dataset-2_raise-up-right-hand_active_001", "right", "left"),
    ):
        motion = bandai.retarget(real[name], Skeleton.default())
        height = wrist_height(motion, raised, "shoulder")
        assert height.max() > 0.1
        assert height[0] < -0.2
        assert height[-1] < -0.2
        assert wrist_height(motion, other, "shoulder").max() < -0.2


@pytest.mark.data
@pytest.mark.slow
def test_the_dance_is_labelled_without_the_seconds_in_which_its_dancer_waits(real):
    """A model whose "dance" began with them stood still."""
    motion = bandai.retarget(real[DANCE], Skeleton.default()).resampled(FPS)
    [segment] = read_segments("bandai")[DANCE]
    first, last = round(segment.start * FPS), round(segment.end * FPS)
    dance = motion_energy(motion.trimmed(first, last))
    assert motion_energy(motion.trimmed(0, first - FPS)) < 0.001 * dance
    for begin in (first, last - FPS):
        assert motion_energy(motion.trimmed(begin, begin + FPS)) > 0.05 * dance


@pytest.mark.data
@pytest.mark.slow
def test_every_real_clip_s_name_is_understood(real):
    for name in real:
        named = bandai.ClipName.parse(name)
        assert named.content in CONTENTS
        assert named.style in STYLES
