"""A motion's frames, seconds, frame rate and places are bounded before an array of them exists."""

import io
import re
import subprocess
import sys
import zipfile
from pathlib import Path

import numpy as np
import pytest
import torch

import stmc
from stmc.data.sources.amass.amass_recordings import RecordingError, read_recording
from stmc.io.arrays import ArraysError, npz_headers, read_npy, read_npz
from stmc.io.bounds import MOST_FRAMES, BoundsError, check_fps, check_frames
from stmc.motion.body_model import load_body
from stmc.motion.geometry import axis_angle_to_matrix

STILL = stmc.Motion.posed(torch.eye(3).repeat(40, 22, 1, 1), torch.zeros(40, 3), 20, stmc.Skeleton.default())


@pytest.mark.parametrize("fps", [0, 1e-308, 0.99, 1000.5, 1e6, float("inf"), float("nan"), -20])
def test_a_frame_rate_beyond_all_real_ones_is_refused(fps):
    for call in (check_fps, STILL.resampled, lambda fps: stmc.Motion(*parts(), fps)):
        with pytest.raises(BoundsError, match="fps must be from 1 to 1000, not"):
            call(fps)


def parts() -> tuple[torch.Tensor, ...]:
    return STILL.rotations, STILL.translation, STILL.joints


def test_frames_and_seconds_have_limits():
    check_frames(MOST_FRAMES, 30)
    for frames, fps, message in ((MOST_FRAMES + 1, 120, "432,000, the limit"), (14_401, 1, "more than 14,400 s")):
        with pytest.raises(BoundsError, match=message):
            check_frames(frames, fps)


def test_a_motion_is_not_resampled_to_more_frames_than_the_limit():
    slow = stmc.Motion(*parts(), 1).resampled(20)
    assert len(slow) == 800
    long = stmc.Motion.posed(torch.eye(3).expand(1000, 22, 3, 3), torch.zeros(1000, 3), 1, stmc.Skeleton.default())
    with pytest.raises(BoundsError, match="432,000, the limit"):
        long.resampled(1000)


def written(path: Path, **changes: object) -> Path:
    arrays = {"poses": np.zeros((4, 156)), "trans": np.zeros((4, 3)), "mocap_framerate": np.array(20.0)}
    np.savez_compressed(path, **arrays | changes)
    return path


WRONG = {
    "fps 1e-9": ({"mocap_framerate": np.array(1e-9)}, "must be from 1 to 1000"),
    "fps 1e-308": ({"mocap_framerate": np.array(1e-308)}, "must be from 1 to 1000"),
    "frames as bool": ({"poses": np.zeros((4, 156), dtype=bool)}, "poses holds bool; need numbers"),
    "numbers as texts": ({"poses": np.full((4, 156), "0.1")}, "poses holds <U3; need numbers"),
    "too many columns": ({"poses": np.zeros((4, 201))}, "201 columns; need 66 to 200"),
    "too few columns": ({"poses": np.zeros((4, 65))}, "65 columns; need 66 to 200"),
    "far away": ({"trans": np.full((4, 3), 1e30)}, "it must be at most 10000 m"),
    "no frames": ({"poses": np.zeros((0, 156)), "trans": np.zeros((0, 3))}, "no frames"),
    "joints of another": ({"joints": np.zeros((4, 22, 3))}, r"joints has shape \(4, 22, 3\); need \(4, 24, 3\)"),
    "many rates": ({"mocap_framerate": np.zeros(10**6)}, r"mocap_framerate has shape \(1000000,\); need \(\)"),
}


@pytest.mark.parametrize(("changes", "message"), WRONG.values(), ids=WRONG)
def test_an_npz_that_is_no_motion_is_named(changes, message, tmp_path):
    with pytest.raises(ValueError, match=rf"a\.npz: .*{message}"):
        stmc.read(written(tmp_path / "a.npz", **changes))


def test_a_small_npz_of_many_frames_takes_no_memory(tmp_path):
    frames = 2_000_000
    with zipfile.ZipFile(tmp_path / "a.npz", "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        for name, shape, dtype in (("poses", (frames, 66), "|i1"), ("trans", (frames, 3), "|i1")):
            with archive.open(f"{name}.npy", "w") as file:
                np.lib.format.write_array_header_1_0(file, {"descr": dtype, "fortran_order": False, "shape": shape})
                for _ in range(shape[1]):
                    file.write(bytes(frames))
        with archive.open("mocap_framerate.npy", "w") as file:
            np.save(file, np.array(200.0))
    assert (tmp_path / "a.npz").stat().st_size < 2**20
    code = (
        f"import sys; sys.path.insert(0, {str(Path(__file__).parent)!r})\n"
        "from pathlib import Path; import stmc\nfrom helpers.memory import peak\n"
        "from stmc.data.sources.amass.amass_recordings import RecordingError, read_recording\n"
        "stmc.Skeleton.default(); before = peak()\n"
        "for read in (stmc.read, lambda path: read_recording(Path(path), stmc.Skeleton.default())):\n"
        "    try: read(sys.argv[1]); sys.exit('it was read')\n"
        "    except ValueError as error: assert 'frames are more than 432,000' in str(error), error\n"
        "assert peak() - before < 2**16, peak() - before\n"
    )
    subprocess.run([sys.executable, "-c", code, str(tmp_path / "a.npz")], check=True, timeout=60)


@pytest.mark.parametrize("order", ["C", "F"])
@pytest.mark.parametrize("joints", [True, False])
def test_an_npz_is_read_in_chunks_of_frames(order, joints, tmp_path, monkeypatch):
    monkeypatch.setattr("stmc.formats.npz._FRAMES_AT_ONCE", 7)
    rng = np.random.default_rng(0)
    arrays = {"poses": rng.normal(size=(40, 156)), "trans": rng.normal(size=(40, 3))}
    arrays |= {"joints": rng.normal(size=(40, 24, 3))} if joints else {}
    written(tmp_path / "a.npz", **{name: np.asarray(array, order=order) for name, array in arrays.items()})
    expected = stmc.read(written(tmp_path / "b.npz", **arrays))
    motion = stmc.read(tmp_path / "a.npz")
    rotations = axis_angle_to_matrix(torch.from_numpy(arrays["poses"][:, :66].reshape(40, 22, 3)))
    torch.testing.assert_close(motion.rotations, rotations.float())
    assert torch.equal(motion.joints, expected.joints)
    if joints:
        assert np.allclose(motion.joints, arrays["joints"], atol=1e-6)


def test_of_an_npz_only_a_chunk_is_in_memory_and_what_would_be_whole_is_bounded(tmp_path, monkeypatch):
    motion = stmc.read(written(tmp_path / "a.npz"))
    assert motion.frames == 4
    monkeypatch.setattr("stmc.io.arrays.numpy_files.LARGEST_BY_COLUMNS", 4 * 156 * 8 - 1)
    written(tmp_path / "b.npz", poses=np.zeros((4, 156), order="F"))
    with pytest.raises(ArraysError, match=r"b\.npz: poses is too large for Fortran order; save it with order='C'"):
        stmc.read(tmp_path / "b.npz")

    def whole(self, name):
        assert name == "mocap_framerate", f"{name} is read whole"
        return array(self, name)

    array = np.lib.npyio.NpzFile.__getitem__
    monkeypatch.setattr(np.lib.npyio.NpzFile, "__getitem__", whole)
    assert stmc.read(tmp_path / "a.npz").frames == 4


def test_a_recording_of_more_values_than_any_is_refused_before_an_array_of_them_exists(tmp_path):
    frames = 130_000  # 18 minutes at 120 fps; float64 rotations of them would have 2 GB
    path = written(tmp_path / "a.npz", poses=np.zeros((frames, 156), np.int8), trans=np.zeros((frames, 3), np.int8))
    with pytest.raises(RecordingError, match="130000 frames of 156 columns exceed 20,000,000 values"):
        read_recording(path, stmc.Skeleton.default())


def test_the_arrays_of_a_file_are_bounded_together(tmp_path, monkeypatch):
    np.savez_compressed(tmp_path / "a.npz", **{name: np.zeros(1000) for name in "abc"})
    np.save(tmp_path / "a.npy", np.zeros(1000))
    assert set(read_npz(tmp_path / "a.npz", "abc", most=24_000)) == {*"abc"}
    with pytest.raises(ArraysError, match=r"a\.npz: a, b, c have 24000 bytes; the limit is 23999"):
        read_npz(tmp_path / "a.npz", "abc", most=23_999)
    with pytest.raises(ArraysError, match="8000 bytes; the file has 8128, and 8000 are the limit"):
        read_npy(tmp_path / "a.npy", most=8000)
    monkeypatch.setattr("stmc.motion.body_model.MOST_BYTES", 10_000)
    names = ["v_template", "shapedirs", "posedirs", "J_regressor", "weights", "kintree_table", "f"]
    np.savez_compressed(tmp_path / "smpl_neutral.npz", **{name: np.zeros(1000) for name in names})
    with pytest.raises(ValueError, match="have 56000 bytes; the limit is 10000"):
        load_body(tmp_path / "smpl_neutral.npz")


def test_a_recording_whose_frame_rate_fills_the_memory_is_refused_unread(tmp_path):
    path = written(tmp_path / "a.npz", mocap_framerate=np.zeros(10**6))
    with pytest.raises(RecordingError, match="mocap_framerate has shape"):
        read_recording(path, stmc.Skeleton.default())


def test_a_bvh_of_many_hours_is_refused(tmp_path):
    stmc.write(STILL, tmp_path / "a.bvh")
    text = (tmp_path / "a.bvh").read_text()
    rows = text.partition("Frame Time:")[2].splitlines()[1]
    header = text.partition("MOTION")[0]
    (tmp_path / "b.bvh").write_text(f"{header}MOTION\nFrames: 15000\nFrame Time: 1\n" + f"{rows}\n" * 15000)
    with pytest.raises(ValueError, match=r"b\.bvh: 15000 frames at 1 fps last more than 14,400 s"):
        stmc.read(tmp_path / "b.bvh")


def test_a_bvh_far_from_the_origin_is_refused(tmp_path):
    stmc.write(STILL, tmp_path / "a.bvh")
    lines = (tmp_path / "a.bvh").read_text().splitlines()
    lines[-1] = "1e20 " + lines[-1].partition(" ")[2]
    (tmp_path / "a.bvh").write_text("\n".join(lines))
    with pytest.raises(ValueError, match=r"a\.bvh: joints is 1e\+20 m from the origin"):
        stmc.read(tmp_path / "a.bvh")


def header(text: str) -> bytes:
    return b"\x93NUMPY\x01\x00" + len(text).to_bytes(2, "little") + text.encode()


HEADERS = {
    "an open bracket": "{'descr': '<f8', 'fortran_order': False, 'shape': (4, }",
    "an open text": "{'descr': '<f8, 'fortran_order': False, 'shape': (4,), }",
    "an indent": "    {'descr':\n 1\n  2",
    "no dict": "(1, 2)",
    "many frames": "{'descr': '<f8', 'fortran_order': False, 'shape': (1000000000000,), }",
    "a negative axis": "{'descr': '<f8', 'fortran_order': False, 'shape': (-4, -1), }",
    "objects": "{'descr': '|O', 'fortran_order': False, 'shape': (1,), }",
    "a broken type": "{'descr': [('a', 3, 4, 5)], 'fortran_order': False, 'shape': (1,), }",
}


@pytest.mark.parametrize("text", HEADERS.values(), ids=HEADERS)
def test_a_broken_header_is_named(text, tmp_path):
    (tmp_path / "a.npy").write_bytes(header(text + "\n") + bytes(32))
    with zipfile.ZipFile(tmp_path / "a.npz", "w") as archive:
        archive.write(tmp_path / "a.npy", "one.npy")
    for name, read in (("a.npy", read_npy), ("a.npz", npz_headers), ("a.npz", lambda path: read_npz(path, ["one"]))):
        with pytest.raises(ArraysError, match=re.escape(str(tmp_path / name))) as caught:
            read(tmp_path / name)
        assert len(str(caught.value)) < 500


def test_an_npz_with_strange_names_is_named_in_a_short_message(tmp_path):
    np.savez(tmp_path / "a.npz", **{f"strange {number}" + "x" * 100: np.zeros(1) for number in range(40)})
    for read in (
        stmc.read,
        lambda path: read_npz(path, ["poses"]),
        lambda path: read_recording(path, stmc.Skeleton.default()),
    ):
        with pytest.raises(ValueError, match="poses") as caught:
            read(tmp_path / "a.npz")
        assert len(str(caught.value)) < 400 + len(str(tmp_path))


def test_what_is_written_is_read_as_it_was(tmp_path):
    buffer = io.BytesIO()
    np.save(buffer, np.asfortranarray(np.arange(6, dtype=">i4").reshape(2, 3)))
    (tmp_path / "a.npy").write_bytes(buffer.getvalue())
    assert read_npy(tmp_path / "a.npy").tolist() == [[0, 1, 2], [3, 4, 5]]
    stmc.write(STILL, tmp_path / "a.npz")
    assert torch.allclose(stmc.read(tmp_path / "a.npz").joints, STILL.joints, atol=1e-6)
