"""Tables for robotics: read by numpy, pandas and MuJoCo, which has the joints where the motion has them."""

import json
from xml.etree import ElementTree

import numpy as np
import pytest
from helpers.motions import walking
from scipy.spatial.transform import Rotation

from stmc.formats import write
from stmc.formats.mujoco import depth_first
from stmc.motion.body import JOINTS, NUM_ROTATIONS, PARENTS
from stmc.timeline import Timeline

WALK = walking(seconds=2.0)


def table(path) -> tuple[list[str], np.ndarray]:
    names = path.read_text("ascii").splitlines()[0].split(",")
    return names, np.loadtxt(path, delimiter=",", skiprows=1)


def test_a_table_has_a_column_for_every_name_and_a_row_for_every_frame(tmp_path):
    write(WALK, tmp_path / "walk.csv")
    names, rows = table(tmp_path / "walk.csv")
    assert rows.shape == (WALK.frames, len(names)) == (40, 1 + 3 + 4 * NUM_ROTATIONS)
    assert rows[:, 0] == pytest.approx(np.arange(40) / 20)
    assert np.abs(rows[:, 1:4] - WALK.translation.numpy()).max() < 1e-5
    named = np.genfromtxt(tmp_path / "walk.csv", delimiter=",", names=True)
    assert list(named.dtype.names) == names


def test_the_quaternions_are_w_x_y_z_relative_to_the_parent_and_do_not_flip(tmp_path):
    write(WALK, tmp_path / "walk.csv")
    names, rows = table(tmp_path / "walk.csv")
    for joint, name in enumerate(JOINTS[:NUM_ROTATIONS]):
        values = rows[:, [names.index(f"{name}_q{axis}") for axis in "wxyz"]]
        turned = Rotation.from_quat(values[:, [1, 2, 3, 0]]).as_matrix()
        assert np.abs(turned - WALK.rotations[:, joint].numpy()).max() < 1e-5
        assert (values[1:] * values[:-1]).sum(axis=1).min() > 0


def test_the_columns_follow_the_model_s_bodies_depth_first(tmp_path):
    write(WALK, tmp_path / "walk.xml")
    bodies = [body.get("name") for body in ElementTree.parse(tmp_path / "walk.xml").getroot().iter("body")]
    assert bodies == [JOINTS[joint] for joint in depth_first()]
    assert sorted(depth_first()) == list(range(NUM_ROTATIONS))
    for place, joint in enumerate(depth_first()):
        assert PARENTS[joint] in (-1, *depth_first()[:place])


def test_the_model_s_keyframes_are_the_table_s_rows_and_the_timeline_goes_along(tmp_path):
    timeline = Timeline.parse('say "<hello>" & wave # 0 # 2')
    for kind in ("csv", "xml"):
        write(WALK, tmp_path / f"walk.{kind}", fps=10, timeline=timeline)
    root = ElementTree.parse(tmp_path / "walk.xml").getroot()
    keys = [[float(key.get("time")), *map(float, key.get("qpos").split())] for key in root.iter("key")]
    assert np.array(keys) == pytest.approx(table(tmp_path / "walk.csv")[1])
    assert json.loads(root.find("custom/text").get("data")) == json.loads(timeline.to_json())


def test_pandas_reads_the_table(tmp_path):
    pandas = pytest.importorskip("pandas")
    write(WALK, tmp_path / "walk.csv")
    assert pandas.read_csv(tmp_path / "walk.csv")["pelvis_z"].to_numpy() == pytest.approx(
        WALK.translation[:, 2].numpy(), abs=1e-5
    )


def test_mujoco_has_the_joints_where_the_motion_has_them(tmp_path):
    mujoco = pytest.importorskip("mujoco")
    for kind in ("csv", "xml"):
        write(WALK, tmp_path / f"walk.{kind}")
    model = mujoco.MjModel.from_xml_path(str(tmp_path / "walk.xml"))
    data = mujoco.MjData(model)
    _, rows = table(tmp_path / "walk.csv")
    assert (model.nkey, model.nq) == (WALK.frames, rows.shape[1] - 1)
    for frame in (0, 17, 39):
        data.qpos[:] = rows[frame, 1:]
        mujoco.mj_kinematics(model, data)
        placed = np.array([data.body(name).xpos for name in JOINTS[:NUM_ROTATIONS]])
        assert np.abs(placed - WALK.joints[frame, :NUM_ROTATIONS].numpy()).max() < 1e-4
