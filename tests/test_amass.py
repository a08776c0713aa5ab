"""AMASS's recordings: both releases are read, all else in its folders is told apart, old paths find new files."""

import io
import zipfile

import numpy as np
import pytest
import torch
from conftest import checked, golden, golden_sets
from einops import rearrange
from helpers.smpl_pickles import run_code
from helpers.source_folders import amass, recorded, smplh_arrays, smplx_arrays
from torch.testing import assert_close

from stmc.data.preparation import LayoutError
from stmc.data.sources.amass.amass_recordings import RecordingError, Recordings, read_recording
from stmc.motion.body import MIRROR, NUM_ROTATIONS
from stmc.motion.body_model import Skeleton
from stmc.motion.geometry import axis_angle_to_matrix, resample_positions, resample_rotations, sampling_positions
from stmc.motion.motion import Motion

SKELETON = Skeleton.default()


def written(folder, arrays, name="walk_poses.npz"):
    path = folder / name
    np.savez(path, **arrays)
    return path


@pytest.mark.parametrize("arrays", [smplh_arrays, smplx_arrays])
def test_a_recording_of_either_release_is_the_motion_that_was_recorded(arrays, tmp_path):
    motion = recorded(fps=60.0)
    back = read_recording(written(tmp_path, arrays(motion)), SKELETON)
    assert back.fps == 60.0
    assert_close(back.rotations, motion.rotations, atol=1e-9, rtol=0)
    assert_close(back.joints, motion.joints, atol=1e-6, rtol=0)  # the offsets are float32


def with_pose(frame, value, name="poses"):
    arrays = smplh_arrays(recorded(fps=30.0))
    arrays[name] = arrays[name].copy()
    arrays[name][frame] = value
    return arrays


def changed(without=(), base=smplh_arrays, **changes):
    arrays = base(recorded(fps=30.0)) | changes
    return {name: value for name, value in arrays.items() if name not in without}


WRONG = {
    "SMPL's poses": (changed(poses=np.zeros((96, 72))), "wrong variant: poses has 72 columns, as SMPL's without hands"),
    "our own export": (changed(poses=np.zeros((96, 66))), r"wrong variant: poses has 66 columns.*smplh 156, smplx 165"),
    "another body": (changed(base=smplx_arrays, surface_model_type="smplh"), "mislabelled: surface_model_type 'smplh'"),
    "an unknown body": (changed(surface_model_type=b"mano"), "mislabelled: surface_model_type 'mano'"),
    "a shape": ({"betas": np.zeros(16), "gender": "male"}, "no motion: poses and trans are missing"),
    "a stage": ({"betas": np.zeros(16), "markers_latent": np.zeros(3)}, "no motion: a subject's shape alone"),
    "markers": ({"markers": np.zeros((9, 40, 3)), "marker_labels": np.zeros(40)}, "no motion: markers alone"),
    "something else": ({"joints": np.zeros((9, 22, 3))}, r"poses and trans are missing \(it has joints\)"),
    "no frames": (changed(poses=np.zeros((0, 156)), trans=np.zeros((0, 3))), "empty: zero frames"),
    "NaN poses": (with_pose(17, np.nan), r"not finite: poses from frame 17 on, 1 frames of 96"),
    "an infinite path": (with_pose(slice(90, None), np.inf, "trans"), r"not finite: trans from frame 90 on, 6 frames"),
    "one path too short": (changed(trans=np.zeros((95, 3))), r"wrong shape: poses \(96, 156\).*trans \(95, 3\)"),
    "flat poses": (changed(poses=np.zeros(156)), "wrong shape"),
    "words": (changed(poses=np.full((96, 156), "a")), "wrong shape: .*numbers"),
    "no rate": (changed(without=["mocap_framerate"]), "no frame rate: neither mocap_framerate nor mocap_frame_rate"),
    "rate zero": (changed(mocap_framerate=np.array(0.0)), "absurd frame rate"),
    "rate of stars": (changed(mocap_framerate=np.array(1e9)), "absurd frame rate"),
    "rate NaN": (changed(mocap_framerate=np.array(np.nan)), "absurd frame rate"),
    "rate in words": (changed(mocap_framerate=np.array("120")), "absurd frame rate"),
    "two rates": (changed(mocap_framerate=np.array([60.0, 120.0])), "absurd frame rate"),
    "objects": (changed(poses=np.array([{}], dtype=object)), "damaged: .*pickled Python objects"),
}


@pytest.mark.parametrize(("arrays", "message"), WRONG.values(), ids=WRONG)
def test_what_is_no_recording_is_named_for_what_it_is(arrays, message, tmp_path):
    with pytest.raises(RecordingError, match=message):
        read_recording(written(tmp_path, arrays), SKELETON)


def test_a_shape_file_is_known_by_its_name_too(tmp_path):
    with pytest.raises(RecordingError, match="a subject's shape alone"):
        read_recording(written(tmp_path, {"betas": np.zeros(16), "gender": "male"}, "shape.npz"), SKELETON)


def test_damaged_and_hostile_files_run_nothing_and_leave_nothing(tmp_path):
    whole = written(tmp_path, smplh_arrays(recorded())).read_bytes()
    file = io.BytesIO()
    np.save(file, np.zeros((3, 156)))
    with zipfile.ZipFile(tmp_path / "dots.npz", "w") as archive:
        for name in ("poses.npy", "trans.npy", "../../escaped.npy"):
            archive.writestr(name, file.getvalue())
    files = {
        "cut.npz": whole[: len(whole) // 2],
        "empty.npz": b"",
        "pickle.npz": run_code("os.system", f"touch {tmp_path}/ran", 2),
        "dots.npz": (tmp_path / "dots.npz").read_bytes(),
    }
    for name, content in files.items():
        (tmp_path / name).write_bytes(content)
    before = sorted(tmp_path.parent.rglob("*"))
    for name in files:
        with pytest.raises(RecordingError, match=f"damaged: .*{name}"):
            read_recording(tmp_path / name, SKELETON)
    assert sorted(tmp_path.parent.rglob("*")) == before


@pytest.mark.parametrize(
    ("path", "file"),
    [
        ("KIT/3/kick_high_left02_poses", "KIT/3/kick_high_left02_poses.npz"),
        ("BioMotionLab_NTroje/rub001/0000_treadmill_norm_poses", "BMLrub/rub001/0000_treadmill_norm_poses.npz"),
        ("BMLrub/rub001/0000_treadmill_norm_stageii", "BMLrub/rub001/0000_treadmill_norm_poses.npz"),
        ("CMU/01/01_01_poses", "CMU/01/01_01_stageii.npz"),
        ("ACCAD/Male2Walking_c3d/B1 - stand to walk_poses", "ACCAD/Male2Walking_c3d/B1_-_stand_to_walk_poses.npz"),
    ],
)
@pytest.mark.parametrize("above", ["", "AMASS/SMPL+H_G"])
def test_recordings_are_found_under_old_and_new_names_wherever_they_were_unpacked(path, file, above, tmp_path):
    amass(tmp_path / above)
    assert Recordings(tmp_path).find(path) == tmp_path / above / file
    assert Recordings(tmp_path).find("KIT/4/kick_high_left02_poses") is None


def test_of_both_releases_smpl_h_s_recording_is_taken(tmp_path):
    amass(tmp_path)
    (tmp_path / "KIT/3/kick_high_left02_stageii.npz").write_bytes(b"")
    assert Recordings(tmp_path).find("KIT/3/kick_high_left02_poses").stem.endswith("_poses")


@pytest.mark.parametrize(
    ("files", "message"),
    [
        ([], "holds no .npz file, but nothing at all"),
        (["KIT.tar.bz2"], "archives; unpack them there"),
        (["pose_data/KIT/3/kick.npy"], "HumanML3D's .npy files.*data=humanml3d_processed"),
        (["notes.txt"], r"only notes\.txt"),
    ],
)
def test_a_folder_that_is_not_amass_s_is_named_with_what_it_is(files, message, tmp_path):
    for name in files:
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text("")
    with pytest.raises(LayoutError, match=message):
        Recordings(tmp_path)
    with pytest.raises(LayoutError, match=r"source=.*nowhere is not a directory; it should hold AMASS's data sets"):
        Recordings(tmp_path / "nowhere")


# The published preparation ------------------------------------------------------------------------------------------


def rotations(poses: np.ndarray) -> torch.Tensor:
    values = torch.from_numpy(poses).double()
    return axis_angle_to_matrix(rearrange(values, "frames (joints axes) -> frames joints axes", axes=3))


def angles(a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
    """Radians between rotations."""
    return torch.arccos(((torch.einsum("...ii", a.mT @ b) - 1) / 2).clamp(-1, 1))


def cases(data: dict) -> list[str]:
    return [name.removesuffix("_poses") for name in data if name.startswith("c") and name.endswith("_poses")
            and not name.endswith("out_poses")]  # fmt: skip


def time_grid_translations_and_joints_are_the_published_preparation_s(folder):
    data = golden(folder, "amass_prepare.npz")
    for number, case in enumerate(cases(data)):
        old, frames = float(data["old_fps"][number]), int(data["frames"][number])
        positions = sampling_positions(frames, old, 20.0)
        assert_close(positions, torch.from_numpy(data[f"{case}_index"]).double(), atol=1e-4, rtol=0)
        for name in ("trans", "joints"):
            if f"{case}_{name}" in data:
                values = torch.from_numpy(data[f"{case}_{name}"]).double()
                expected = torch.from_numpy(data[f"{case}_out_{name}"]).double()
                assert_close(resample_positions(values, old, 20.0), expected, atol=1e-5, rtol=1e-5)


def mirroring_is_the_published_preparation_s(folder):
    data = golden(folder, "amass_prepare.npz")
    assert MIRROR[:NUM_ROTATIONS] == tuple(data["mirror_joint_perm"])
    trans = torch.from_numpy(data["mirror_trans"])
    motion = Motion.posed(rotations(data["mirror_poses"]), trans, 20.0, Skeleton(SKELETON.offsets.double()))
    image = motion.mirrored()
    assert_close(image.translation, torch.from_numpy(data["mirror_out_trans"]), atol=1e-12, rtol=0)
    assert_close(image.rotations, rotations(data["mirror_out_poses"]), atol=1e-9, rtol=0)


def neighbours(source: torch.Tensor, old: float) -> tuple[torch.Tensor, torch.Tensor]:
    """What each new frame lies between."""
    positions = sampling_positions(len(source), old, 20.0)
    return source[positions.floor().long()], source[positions.ceil().long()]


def rotations_on_the_sphere_are_near_the_published_ones_where_vectors_do_not_flip(folder):
    """The two interpolations differ by less than a quarter of the angle between the frames that they lie between."""
    data = golden(folder, "amass_prepare.npz")
    for number, case in enumerate(cases(data)):
        old, poses = float(data["old_fps"][number]), data[f"{case}_poses"]
        source, published = rotations(poses), rotations(data[f"{case}_out_poses"])
        vectors = rearrange(torch.from_numpy(poses).double(), "frames (joints axes) -> frames joints axes", axes=3)
        flips = torch.einsum("...a, ...a -> ...", *neighbours(vectors, old)) < 0
        off = angles(resample_rotations(source, old, 20.0), published)
        assert (off <= 0.25 * angles(*neighbours(source, old)) + 1e-6)[~flips].all(), case


def where_an_axis_angle_vector_flips_the_published_pose_leaves_the_way_and_ours_does_not_r10(folder):
    data = golden(folder, "amass_prepare.npz")
    old, source = float(data["old_fps"][0]), rotations(data["c0_poses"])
    before, after = (values[1, 18] for values in neighbours(source, old))
    published = rotations(data["c0_out_poses"])[1, 18]
    ours = resample_rotations(source, old, 20.0)[1, 18]
    way = angles(before, after)
    assert_close(angles(before, ours) + angles(ours, after), way, atol=1e-6, rtol=0)
    assert angles(before, published) + angles(published, after) > way + 0.3


@pytest.mark.golden
@pytest.mark.parametrize("folder", golden_sets("stmc"))
def test_recordings_are_prepared_as_published_but_for_r10(folder, subtests):
    checked(
        subtests,
        [
            time_grid_translations_and_joints_are_the_published_preparation_s,
            mirroring_is_the_published_preparation_s,
            rotations_on_the_sphere_are_near_the_published_ones_where_vectors_do_not_flip,
            where_an_axis_angle_vector_flips_the_published_pose_leaves_the_way_and_ours_does_not_r10,
        ],
        folder,
    )


def test_a_joint_that_turns_past_half_a_turn_goes_on_turning_r10(tmp_path):
    """At pi the axis-angle vector jumps to its opposite; the rotation does not."""
    angle = torch.linspace(3.0, 3.3, 13, dtype=torch.float64)
    vectors = torch.zeros(13, 3, dtype=torch.float64)
    vectors[:, 0] = torch.where(angle > torch.pi, angle - 2 * torch.pi, angle)
    arrays = smplh_arrays(recorded(fps=120.0).trimmed(0, 13))
    arrays["poses"][:, 3:6] = vectors.numpy()
    motion = read_recording(written(tmp_path, arrays), SKELETON).resampled(20)
    expected = torch.stack([angle[2:4].mean(), angle[8:10].mean()])
    straight = axis_angle_to_matrix(torch.stack([expected, 0 * expected, 0 * expected], dim=-1))
    assert_close(motion.rotations[:, 1], straight, atol=1e-9, rtol=0)
