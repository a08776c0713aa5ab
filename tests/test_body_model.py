"""The bundled skeleton, and SMPL files: synthetic ones in the true format, since nobody may ship the real ones."""

import numpy as np
import pytest
import smplx
import torch
from helpers.motions import walk
from helpers.smpl_pickles import python_2_pickle, run_code
from scipy import sparse
from smplx.utils import Struct
from torch.testing import assert_close

from stmc.motion.body import JOINTS, PARENTS
from stmc.motion.body_model import Skeleton, load_body
from stmc.motion.geometry import forward_kinematics, matrix_to_axis_angle

BONES = {"smpl": 24, "smplh": 52, "smplx": 55}
HANDS = {"smpl": (22, 23), "smplh": (22, 37), "smplx": (25, 40)}
FINGERS = [-1, 0, 1, -1, 3, 4, -1, 6, 7, -1, 9, 10, -1, 12, 13]  # five fingers of three bones, -1 for the wrist


def tree(kind):
    parents = list(PARENTS[:22])
    if kind == "smpl":
        return [*parents, 20, 21]
    parents += [15, 15, 15] if kind == "smplx" else []
    for wrist in (20, 21):
        first = len(parents)
        parents += [wrist if finger < 0 else first + finger for finger in FINGERS]
    return parents


def body_arrays(kind, seed=0, vertices=80):
    rng, bones = np.random.default_rng(seed), BONES[kind]
    regressor = rng.random((bones, vertices))
    weights = rng.random((vertices, bones)) ** 8
    parents = np.array(tree(kind))
    parents[0] = 2**32 - 1  # as SMPL's files write the root's parent
    arrays = {
        "v_template": rng.standard_normal((vertices, 3)),
        "shapedirs": rng.standard_normal((vertices, 3, 20)),
        "posedirs": 0.01 * rng.standard_normal((vertices, 3, 9 * (bones - 1))),
        "J_regressor": regressor / regressor.sum(axis=1, keepdims=True),
        "weights": weights / weights.sum(axis=1, keepdims=True),
        "kintree_table": np.stack([parents, np.arange(bones)]).astype(np.uint32),
        "f": rng.integers(0, vertices, (50, 3)).astype(np.uint32),
    }
    if kind != "smpl":
        arrays |= {"hands_meanl": 0.2 * rng.standard_normal(45), "hands_meanr": 0.2 * rng.standard_normal(45)}
        arrays |= {"hands_componentsl": np.eye(45), "hands_componentsr": np.eye(45)}
        arrays |= {"lmk_faces_idx": np.zeros(51, dtype=np.int64), "lmk_bary_coords": np.full((51, 3), 1 / 3)}
    return arrays


def write_body(folder, kind, **changes):
    path = folder / f"{kind.upper()}_NEUTRAL.npz"
    np.savez(path, **(body_arrays(kind) | changes))
    return path


def test_the_bundled_skeleton_is_an_adult_with_two_equal_sides():
    rest = Skeleton.default().rest
    place = {name: rest[index] for index, name in enumerate(JOINTS)}
    height = float(rest[:, 1].max() - rest[:, 1].min())
    assert 1.3 < height < 1.8
    assert place["left_hand"][0] > place["left_shoulder"][0] > 0 > place["right_hand"][0]
    assert place["head"][1] > place["pelvis"][1] > place["left_knee"][1] > place["left_foot"][1]
    assert place["left_foot"][2] > place["left_ankle"][2]
    for side in ("hip", "knee", "elbow", "wrist"):
        left, right = (Skeleton.default().offsets[JOINTS.index(f"{name}_{side}")] for name in ("left", "right"))
        assert_close(left.norm(), right.norm(), atol=0.02, rtol=0)


def test_a_skeleton_in_its_rest_pose_stands_as_its_offsets_add_up():
    skeleton = Skeleton.default()
    for joint, parent in enumerate(PARENTS):
        above = skeleton.rest[parent] if parent >= 0 else 0
        assert_close(skeleton.rest[joint], above + skeleton.offsets[joint])


def test_posing_puts_the_pelvis_at_the_translation_and_keeps_bones():
    skeleton, motion = Skeleton.default(), walk()
    joints = skeleton.pose(motion.rotations, motion.translation)
    assert joints.dtype == torch.float64
    assert_close(joints[:, 0], motion.translation)
    bones = (joints[:, 1:] - joints[:, list(PARENTS[1:])]).norm(dim=-1)
    assert_close(bones, skeleton.offsets[1:].double().norm(dim=-1).expand_as(bones))


def test_a_skeleton_can_be_measured_from_a_motion_it_moved():
    skeleton, motion = Skeleton.default(), walk()
    measured = Skeleton.measured(motion.rotations, motion.joints, pelvis=skeleton.offsets[0])
    assert_close(measured.offsets, skeleton.offsets.double(), atol=1e-9, rtol=0)


def test_smpl_adds_the_rest_pelvis_so_its_translation_lacks_it_r9():
    skeleton, motion = Skeleton.default(), walk()
    trans = skeleton.smpl_translation(motion.translation)
    smpl_joints = trans[:, None] + skeleton.rest[0] + forward_kinematics(
        motion.rotations, skeleton.offsets.double(), PARENTS
    )  # fmt: skip
    assert_close(smpl_joints, motion.joints)


def rigid(kind):
    """A body of which each of the 24 joints is a vertex that its own bone carries."""
    arrays, ours = body_arrays(kind), [*range(22), *HANDS[kind]]
    regressor, weights = np.zeros((BONES[kind], 80)), np.zeros((80, BONES[kind]))
    regressor[ours, range(24)] = 1
    regressor[:, 24] += 1 - regressor.sum(axis=1)
    weights[range(80), [*ours, *[0] * 56]] = 1
    return arrays | {"J_regressor": regressor, "weights": weights, "posedirs": 0 * arrays["posedirs"]}


def smplx_vertices(path, kind, motion, trans, betas):
    """The same mesh through smplx's own classes, from axis-angle poses and SMPL's translation."""
    frames = motion.frames
    options = {"batch_size": frames, "num_betas": 10}
    if kind == "smpl":  # smplx reads SMPL from pickles only, unless it is given the arrays
        model = smplx.SMPL(str(path), data_struct=Struct(**np.load(path)), **options)
    else:
        model = smplx.create(str(path), kind, ext="npz", use_pca=False, **options)
    model.vertex_joint_selector.extra_joints_idxs.zero_()  # landmarks are vertices that a real mesh has
    poses = matrix_to_axis_angle(motion.rotations)
    if kind == "smpl":
        poses = torch.cat([poses, poses.new_zeros(frames, 2, 3)], dim=1)
    with torch.no_grad():
        return model(
            global_orient=poses[:, 0], body_pose=poses[:, 1:].flatten(1), transl=trans, betas=betas.expand(frames, -1)
        ).vertices


@pytest.mark.parametrize("kind", BONES)
def test_joints_and_mesh_of_a_body_agree_r9(kind, tmp_path):
    write_body(tmp_path, kind, **rigid(kind))
    body, motion = load_body(tmp_path, kind), walk(70, dtype=torch.float32)
    vertices = body.vertices(motion.rotations, motion.translation)
    assert (vertices.shape, body.faces.shape) == ((70, 80, 3), (50, 3))
    assert_close(vertices[:, :24], body.skeleton.pose(motion.rotations, motion.translation), atol=1e-5, rtol=0)


@pytest.mark.parametrize("kind", BONES)
def test_the_mesh_is_that_of_smplx_with_the_same_shape_and_hands(kind, tmp_path):
    path, motion = write_body(tmp_path, kind), walk(5, dtype=torch.float32)
    betas = torch.linspace(-1, 1, 10)
    body = load_body(tmp_path, kind, betas=betas.tolist())
    trans = body.skeleton.smpl_translation(motion.translation)
    expected = smplx_vertices(path, kind, motion, trans, betas)
    assert_close(body.vertices(motion.rotations, motion.translation), expected, atol=1e-4, rtol=0)


def test_betas_change_the_skeleton_with_the_mesh(tmp_path):
    write_body(tmp_path, "smpl")
    plain, shaped = load_body(tmp_path), load_body(tmp_path, betas=[2.0])
    arrays = body_arrays("smpl")
    expected = arrays["J_regressor"] @ (arrays["v_template"] + 2 * arrays["shapedirs"][..., 0])
    assert_close(shaped.skeleton.rest, torch.from_numpy(expected).float(), atol=1e-5, rtol=0)
    assert not torch.equal(plain.skeleton.rest, shaped.skeleton.rest)


@pytest.mark.parametrize(
    ("kind", "place"),
    [
        ("smplh", "SMPLH_NEUTRAL.npz"),
        ("smplh", "smplh/SMPLH_NEUTRAL.npz"),
        ("smplh", "neutral/model.npz"),
        ("smplh", "smplh/neutral/model.npz"),
        ("smplh", "SMPLH_neutral.pkl"),
        ("smplx", "smplx/SMPLX_NEUTRAL.npz"),
        ("smpl", "SMPL_NEUTRAL.pkl"),
        ("smpl", "smpl/basicmodel_neutral_lbs_10_207_0_v1.1.0.pkl"),
        ("smpl", "basicModel_neutral_lbs_10_207_0_v1.0.0.pkl"),
    ],
)
def test_bodies_are_found_where_downloads_and_smplx_put_them(kind, place, tmp_path):
    write = write_pickle if place.endswith("pkl") else write_body
    (tmp_path / place).parent.mkdir(parents=True, exist_ok=True)
    write(tmp_path, kind).rename(tmp_path / place)
    assert load_body(tmp_path, kind).v_template.shape == (80, 3)
    assert load_body(tmp_path / place, kind).v_template.shape == (80, 3)


def write_pickle(folder, kind, gender="NEUTRAL", **changes):
    """As SMPL's own files are: by Python 2, some arrays as chumpy's, the regressor sparse, and much else beside."""
    arrays = body_arrays(kind) | changes
    arrays["J_regressor"] = sparse.csc_matrix(arrays["J_regressor"])
    for name in ("v_template", "weights", "posedirs"):
        arrays[name] = ("Ch", arrays[name])
    directions = arrays["shapedirs"]
    arrays["shapedirs"] = ("Select", directions, np.arange(directions.size), directions.shape)
    arrays |= {"bs_style": "lbs", "bs_type": "lrotmin", "J_regressor_prior": sparse.csc_matrix(np.eye(3))}
    path = folder / f"{kind.upper()}_{gender}.pkl"
    path.write_bytes(python_2_pickle(arrays, 2))
    return path


@pytest.mark.parametrize("kind", BONES)
def test_a_pickled_body_is_the_body_of_the_same_arrays(kind, tmp_path):
    pickled, plain = load_body(write_pickle(tmp_path, kind), kind), load_body(write_body(tmp_path, kind), kind)
    assert_close(pickled.skeleton.offsets, plain.skeleton.offsets)
    motion = walk(3, dtype=torch.float32)
    vertices = [body.vertices(motion.rotations, motion.translation) for body in (pickled, plain)]
    assert_close(*vertices)
    [*_, mesh] = pickled.meshes(motion.rotations, motion.translation)
    assert_close(torch.from_numpy(mesh.vertices), vertices[0][-1].double())
    assert mesh.faces.tolist() == pickled.faces.tolist()


def test_a_female_body_is_not_taken_for_a_neutral_one(tmp_path):
    write_pickle(tmp_path, "smpl").rename(tmp_path / "basicModel_f_lbs_10_207_0_v1.0.0.pkl")
    assert load_body(tmp_path, gender="female").v_template.shape == (80, 3)
    with pytest.raises(FileNotFoundError):
        load_body(tmp_path)


def test_what_cannot_be_loaded_is_named_with_the_choices(tmp_path):
    with pytest.raises(ValueError, match="unknown kind of body 'star'; choose from smpl, smplh, smplx"):
        load_body(tmp_path, "star")
    with pytest.raises(ValueError, match="unknown gender 'any'; choose from neutral, female, male"):
        load_body(tmp_path, gender="any")
    with pytest.raises(FileNotFoundError, match=r"looked for .*smpl_female\.npz.*basicmodel_f_.*\.pkl"):
        load_body(tmp_path, gender="female")
    with pytest.raises(ValueError, match=r"23 betas, but .* has 20"):
        load_body(write_body(tmp_path, "smpl"), betas=[0.0] * 23)


def test_what_moves_the_face_of_smplx_is_not_taken_for_shape(tmp_path):
    with pytest.raises(ValueError, match=r"11 betas, but .* has 10"):
        load_body(write_body(tmp_path, "smplx"), "smplx", betas=[0.0] * 11)
    many = np.random.default_rng(0).standard_normal((80, 3, 400))
    path = write_body(tmp_path, "smplx", shapedirs=many)
    body = load_body(path, "smplx", betas=[0.0] * 299 + [1.0])
    expected = body_arrays("smplx")["v_template"] + many[..., 299]
    assert_close(body.v_template, torch.from_numpy(expected).float())
    with pytest.raises(ValueError, match=r"301 betas, but .* has 300"):
        load_body(path, "smplx", betas=[0.0] * 301)


def test_files_of_another_kind_are_refused(tmp_path):
    with pytest.raises(ValueError, match="has 52 joints; a smpl body has 24"):
        load_body(write_body(tmp_path, "smplh"), "smpl")
    (tmp_path / "text.npz").write_text("not a zip archive")
    with pytest.raises(ValueError, match=r"text\.npz is not a smpl body"):
        load_body(tmp_path / "text.npz")
    np.savez(tmp_path / "half.npz", v_template=np.zeros((3, 3)))
    with pytest.raises(ValueError, match=r"half\.npz is not a smpl body: .*no array shapedirs"):
        load_body(tmp_path / "half.npz")


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"weights": np.zeros((80, 23))}, r"weights has shape \(80, 23\); a smpl body's is \(80, 24\)"),
        ({"posedirs": np.zeros((80, 3, 69))}, r"posedirs has shape .* \(80, 3, 207\)"),
        ({"v_template": np.full((80, 3), np.nan)}, "v_template has values that are not finite"),
        ({"v_template": np.full((80, 3), 1e300)}, "v_template has values that are not finite, or not in float32"),
        ({"weights": np.full((80, 24), "1")}, "weights has dtype <U1; it must be numeric"),
        ({"kintree_table": np.stack([[-1, *PARENTS[1:22], -5, 21], np.arange(24)])}, "a joint before its parent"),
        ({"f": np.array([[0, 1, 80]])}, "f names vertices that do not exist; there are 80"),
        ({"kintree_table": np.stack([[-1, *PARENTS[1:22], 23, 23], np.arange(24)])}, "a joint before its parent"),
    ],
)
def test_arrays_that_do_not_fit_one_another_are_named(changes, message, tmp_path):
    with pytest.raises(ValueError, match=message):
        load_body(write_body(tmp_path, "smpl", **changes))


def test_a_pickle_inside_a_file_is_not_run(tmp_path):
    path = write_body(tmp_path, "smpl", J_regressor=np.array([Alarm()], dtype=object))
    with pytest.raises(ValueError, match=r"is not a smpl body: .*pickled Python objects"):
        load_body(path)
    (tmp_path / "SMPL_NEUTRAL.pkl").write_bytes(run_code("os.system", f"touch {tmp_path}/ran", 2))
    with pytest.raises(ValueError, match=r"is not a smpl body: .*refused to run posix\.system"):
        load_body(tmp_path / "SMPL_NEUTRAL.pkl")
    assert not (tmp_path / "ran").exists()


class Alarm:
    def __reduce__(self):
        return pytest.fail, ("a pickle was run",)
