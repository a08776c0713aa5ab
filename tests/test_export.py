import dataclasses
import math
import re

import numpy as np
import pytest
import torch
from helpers.motions import walking
from scipy.spatial.transform import Rotation

from stmc.formats import motion_files, read, write
from stmc.motion.body import JOINTS, NUM_ROTATIONS, PARENTS
from stmc.motion.body_model import Skeleton
from stmc.motion.geometry import axis_angle_to_matrix
from stmc.motion.motion import Motion
from stmc.timeline import Timeline

Y_UP_TO_Z_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])


@pytest.fixture(scope="module")
def motion() -> Motion:
    return walking(seconds=3.0)


def tumbling(frames: int = 40, seed: int = 0) -> Motion:
    """Any pose at all: every joint turns through large angles."""
    generator = torch.Generator().manual_seed(seed)
    axis_angle = torch.randn(frames, NUM_ROTATIONS, 3, generator=generator, dtype=torch.float64) * 2
    translation = torch.randn(frames, 3, generator=generator, dtype=torch.float64)
    return Motion.posed(axis_angle_to_matrix(axis_angle), translation, 30.0, Skeleton.default())


class Bvh:
    """An independent reader: a stack of nodes, channels in the order the file gives them."""

    def __init__(self, text: str) -> None:
        head, tail = text.split("MOTION")
        self.nodes: list[dict] = []
        stack: list[dict] = []
        for line in head.splitlines()[1:]:
            words = line.split()
            if words and words[0] in ("ROOT", "JOINT", "End"):
                name = words[1] if words[0] != "End" else f"end of {stack[-1]['name']}"
                parent = self.nodes.index(stack[-1]) if stack else None
                stack.append({"name": name, "parent": parent, "channels": [], "offset": None})
                self.nodes.append(stack[-1])
            elif words and words[0] == "OFFSET":
                stack[-1]["offset"] = np.array([float(word) for word in words[1:]])
            elif words and words[0] == "CHANNELS":
                assert int(words[1]) == len(words) - 2
                stack[-1]["channels"] = words[2:]
            elif words == ["}"]:
                stack.pop()
        lines = tail.strip().splitlines()
        self.frames = int(lines[0].split(":")[1])
        self.frame_time = float(lines[1].split(":")[1])
        self.rows = np.array([[float(word) for word in line.split()] for line in lines[2:]])

    def places(self, row: np.ndarray) -> dict[str, np.ndarray]:
        values = iter(row)
        placed: list[tuple[np.ndarray, np.ndarray]] = []
        for node in self.nodes:
            turned, place = placed[node["parent"]] if node["parent"] is not None else (np.eye(3), np.zeros(3))
            place, turned = place + turned @ node["offset"], turned.copy()
            for channel in node["channels"]:
                axis, kind, value = channel[0], channel[1:], next(values)
                unit = np.eye(3)["XYZ".index(axis)]
                if kind == "position":
                    place = place + unit * value
                else:
                    turned = turned @ Rotation.from_rotvec(unit * math.radians(value)).as_matrix()
            placed.append((turned, place))
        assert next(values, None) is None
        return {node["name"]: place for node, (_, place) in zip(self.nodes, placed, strict=True)}


def bvh(motion: Motion, folder) -> Bvh:
    write(motion, folder / "motion.bvh")
    return Bvh((folder / "motion.bvh").read_text("ascii"))


@pytest.mark.parametrize("make", [lambda: walking(seconds=3.0), tumbling])
def test_a_bvh_s_own_kinematics_put_every_joint_where_the_motion_has_it(make, tmp_path):
    motion = make()
    file = bvh(motion, tmp_path)
    assert file.frames == motion.frames == len(file.rows)
    assert file.frame_time == pytest.approx(1 / motion.fps)
    for frame in range(0, motion.frames, 7):
        places = file.places(file.rows[frame])
        for side in ("left", "right"):
            places[f"{side}_hand"] = places[f"end of {side}_wrist"]
        written = np.array([places[name] for name in JOINTS]) @ Y_UP_TO_Z_UP.T
        assert np.abs(written - motion.joints[frame].numpy()).max() < 1e-4


@pytest.mark.parametrize("fps", [10, 30, 60])
@pytest.mark.parametrize("make", [lambda: walking(seconds=3.0, speed=3.0), tumbling])
def test_files_of_one_motion_agree_at_any_frame_rate(make, fps, tmp_path):
    motion = make()
    for kind in ("npz", "bvh"):
        write(motion, tmp_path / f"motion.{kind}", fps=fps)
    file = Bvh((tmp_path / "motion.bvh").read_text("ascii"))
    joints = np.load(tmp_path / "motion.npz")["joints"]
    assert len(joints) == file.frames
    for frame in range(0, file.frames, 7):
        places = file.places(file.rows[frame])
        written = np.array([places[name] for name in JOINTS[:NUM_ROTATIONS]]) @ Y_UP_TO_Z_UP.T
        assert np.abs(written - joints[frame, :NUM_ROTATIONS]).max() < 1e-4


def test_a_bvh_rests_in_a_t_pose_with_y_up_and_arms_stretched_sideways(motion, tmp_path):
    file = bvh(motion, tmp_path)
    places = file.places(np.zeros(file.rows.shape[1]))
    rest = Skeleton.default().rest.numpy()
    for name, joint in zip(JOINTS[:NUM_ROTATIONS], rest, strict=False):
        assert places[name] == pytest.approx(joint - rest[0], abs=1e-5)
    assert places["head"][1] > places["pelvis"][1] + 0.3
    assert places["left_wrist"][0] > 0.4
    assert places["end of left_foot"][2] > places["left_foot"][2]


def test_a_bvh_has_22_joints_and_closes_hands_feet_and_head_with_end_sites(motion, tmp_path):
    file = bvh(motion, tmp_path)
    ends = {node["name"] for node in file.nodes if not node["channels"]}
    assert ends == {f"end of {name}" for name in ("head", "left_wrist", "right_wrist", "left_foot", "right_foot")}
    assert {node["name"] for node in file.nodes if node["channels"]} == set(JOINTS[:NUM_ROTATIONS])
    for node in file.nodes:
        if node["name"] in JOINTS[1:]:
            assert file.nodes[node["parent"]]["name"] == JOINTS[PARENTS[JOINTS.index(node["name"])]]


def test_the_angles_of_a_bvh_do_not_jump_from_frame_to_frame(tmp_path):
    spin = torch.linspace(0, 6 * math.pi, 120, dtype=torch.float64)
    axis_angle = torch.zeros(120, NUM_ROTATIONS, 3, dtype=torch.float64)
    axis_angle[:, 0, 1] = spin
    axis_angle[:, JOINTS.index("left_elbow"), 0] = spin  # through both poles of the middle angle
    motion = Motion.posed(axis_angle_to_matrix(axis_angle), torch.zeros(120, 3).double(), 20.0, Skeleton.default())
    steps = np.abs(np.diff(bvh(motion, tmp_path).rows, axis=0))
    assert steps.max() < 15


def test_writing_leaves_the_motion_as_it_was(tmp_path):
    motion = walking(seconds=1.0)
    before = motion.rotations.clone()
    write(motion, tmp_path / "walk.bvh")
    write(motion, tmp_path / "walk.npz")
    assert torch.equal(motion.rotations, before)


def test_an_npz_has_what_readers_of_amass_look_for(motion, tmp_path):
    write(motion, tmp_path / "walk.npz")
    with np.load(tmp_path / "walk.npz", allow_pickle=False) as archive:
        assert archive["poses"].shape == (motion.frames, 156)  # SMPL-H: readers of AMASS cut hands off behind 66
        assert not archive["poses"][:, 66:].any()
        assert archive["trans"].shape == (motion.frames, 3)
        assert archive["betas"].shape == (16,) and not archive["betas"].any()
        assert str(archive["gender"]) == "neutral"
        assert float(archive["mocap_framerate"]) == motion.fps
        assert archive["joints"].shape == (motion.frames, 24, 3)
        root = Rotation.from_rotvec(archive["poses"][:, :3]).as_matrix()
    assert np.abs(root - motion.rotations[:, 0].numpy()).max() < 1e-6


def test_a_body_posed_by_smpl_from_an_npz_has_its_pelvis_at_the_motion_s(motion, tmp_path):
    # SMPL adds its translation to joints posed about the rest pelvis (R9).
    write(motion, tmp_path / "walk.npz")
    with np.load(tmp_path / "walk.npz") as archive:
        pelvis = archive["trans"] + Skeleton.default().rest[0].numpy()
    assert np.abs(pelvis - motion.joints[:, 0].numpy()).max() < 1e-6


def test_reading_an_npz_gives_the_motion_back(motion, tmp_path):
    write(motion, tmp_path / "walk.npz")
    back = read(tmp_path / "walk.npz")
    assert back.fps == motion.fps
    for name in ("rotations", "translation", "joints"):
        assert torch.allclose(getattr(back, name), getattr(motion, name).float(), atol=1e-5)


def test_a_file_of_amass_itself_is_read_without_its_fingers_and_posed(motion, tmp_path):
    write(motion, tmp_path / "walk.npz")
    with np.load(tmp_path / "walk.npz") as archive:
        arrays = {name: archive[name] for name in ("poses", "trans", "betas", "gender")}
    arrays["poses"][:, 66:] = 1
    np.savez(tmp_path / "amass.npz", **arrays, mocap_frame_rate=motion.fps)
    assert torch.allclose(read(tmp_path / "amass.npz").joints, motion.joints.float(), atol=1e-4)


def test_a_file_of_an_earlier_version_without_hands_is_read(motion, tmp_path):
    write(motion, tmp_path / "walk.npz")
    with np.load(tmp_path / "walk.npz") as archive:
        arrays = {**archive, "poses": archive["poses"][:, :66]}
    np.savez(tmp_path / "old.npz", **arrays)
    assert torch.equal(read(tmp_path / "old.npz").rotations, read(tmp_path / "walk.npz").rotations)


def test_the_timeline_goes_along_in_an_npz(motion, tmp_path):
    timeline = Timeline.parse("walk # 0 # 3")
    write(motion, tmp_path / "walk.npz", timeline=timeline)
    with np.load(tmp_path / "walk.npz", allow_pickle=False) as archive:
        assert str(archive["timeline"]) == timeline.to_json()
    assert read(tmp_path / "walk.npz").frames == motion.frames


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"poses": None}, "no array poses"),
        ({"poses": np.zeros((20, 63))}, "63 columns"),
        ({"trans": np.zeros((7, 3))}, re.escape("trans has shape (7, 3); need (20, 3)")),
        ({"mocap_framerate": None}, "no array mocap_framerate"),
        ({"joints": np.zeros((20, 22, 3))}, "joints has shape"),
    ],
)
def test_an_npz_that_is_no_motion_is_named_with_what_is_wrong(change, message, tmp_path):
    write(walking(seconds=1.0), tmp_path / "walk.npz")
    with np.load(tmp_path / "walk.npz") as archive:
        arrays = {**archive, **change}
    np.savez(tmp_path / "other.npz", **{name: array for name, array in arrays.items() if array is not None})
    with pytest.raises(ValueError, match=message) as error:
        read(tmp_path / "other.npz")
    assert "other.npz" in str(error.value)


@pytest.mark.parametrize("act", [lambda path: write(walking(seconds=1.0), path), read])
def test_an_unknown_suffix_is_an_error_that_names_the_choices(act, tmp_path):
    with pytest.raises(ValueError, match=r"fbx.*\.npz"):
        act(tmp_path / "walk.fbx")
    assert not list(tmp_path.iterdir())


def test_a_write_that_fails_leaves_the_old_file_and_no_other(tmp_path, monkeypatch):
    def breaks_off(motion, file, skeleton, timeline):
        file.write(b"half of it")
        raise RuntimeError("the disk is full")

    npz = next(each for each in motion_files.FORMATS if each.suffix == ".npz")
    monkeypatch.setattr(motion_files, "FORMATS", [dataclasses.replace(npz, write=breaks_off)])
    path = tmp_path / "walk.npz"
    path.write_text("old")
    with pytest.raises(RuntimeError, match="full"):
        write(walking(seconds=1.0), path)
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


def test_a_motion_of_other_proportions_keeps_its_own_bones(tmp_path):
    tall = Skeleton(Skeleton.default().offsets.double() * 1.25)
    walk = walking(seconds=1.0)
    motion = Motion.posed(walk.rotations, walk.translation, walk.fps, tall)
    places = bvh(motion, tmp_path).places(np.zeros(6 + 3 * (NUM_ROTATIONS - 1)))
    assert np.linalg.norm(places["left_knee"] - places["left_hip"]) == pytest.approx(0.3908 * 1.25, abs=1e-4)
