"""Robots as characters: which joint is which, angles within limits, feet on the floor, tables that MuJoCo replays."""

import dataclasses
from importlib.util import find_spec
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers import robots as made
from helpers.motions import walking

import stmc
from stmc.formats.characters import CharacterError
from stmc.formats.characters.joint_names import robot_words
from stmc.motion.body import JOINTS
from stmc.motion.body_model import Skeleton
from stmc.motion.geometry import axis_angle_to_matrix
from stmc.motion.retargeting import hinges

UP = torch.tensor([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]], dtype=torch.float64)
FILES = {"robot.xml": made.mjcf, "robot.urdf": made.urdf}


def posed(seconds: float = 1.0, fps: int = 20, **turns: list[float]) -> stmc.Motion:
    """Standing, while some joints turn by these rotation vectors, evenly over time."""
    frames = round(seconds * fps)
    share = torch.linspace(0, 1, frames, dtype=torch.float64)[:, None]
    rotations = torch.eye(3, dtype=torch.float64).repeat(frames, 22, 1, 1)
    rotations[:, 0] = UP
    for joint, turn in turns.items():
        rotations[:, JOINTS.index(joint)] = axis_angle_to_matrix(share * torch.tensor(turn, dtype=torch.float64))
    body = Skeleton(Skeleton.default().offsets.double())
    standing = torch.tensor([0.0, 0.0, float(body.rest[0, 1] - body.rest[:, 1].min())], dtype=torch.float64)
    return stmc.Motion.posed(rotations, standing.repeat(frames, 1), fps, body)


@pytest.fixture(scope="module")
def motion() -> stmc.Motion:
    return stmc.clean_feet(walking(seconds=1.0, fps=20))


@pytest.fixture(params=FILES)
def robot(request, tmp_path) -> Path:
    path = tmp_path / request.param
    path.write_text(FILES[request.param]())
    return path


def table(moved: stmc.CharacterMotion) -> tuple[list[str], np.ndarray]:
    first, *lines = moved.content(".csv").decode().splitlines()
    return first.split(","), np.array([[float(value) for value in line.split(",")] for line in lines])


def corners(moved: stmc.CharacterMotion) -> np.ndarray:
    """The corners of the soles [frames, corners, 3]."""
    rig = moved.motion.rig
    nodes = [rig.driven.index(node) for node in rig.linkage.sole_nodes]
    turns, places = moved.motion.turns[:, nodes].numpy(), moved.motion.places[:, nodes].numpy()
    ankles = rig.rest[rig.linkage.sole_nodes].numpy()
    return places + np.einsum("fcij,cj->fci", turns, rig.linkage.soles - ankles)


def angle(moved: stmc.CharacterMotion, source: stmc.Motion, above: str, below: str) -> np.ndarray:
    """Degrees between our bone and the robot's, in each frame."""
    ours = source.joints[:, JOINTS.index(below)] - source.joints[:, JOINTS.index(above)]
    ours = torch.nn.functional.normalize(ours.double(), dim=-1)
    cosine = (ours * moved.motion.direction(above, below)).sum(dim=-1).clamp(-1, 1)
    return torch.rad2deg(torch.arccos(cosine)).numpy()


def test_joints_are_found_by_names_and_the_table_names_its_columns(robot, motion):
    character = stmc.read_character(robot)
    assert character.found_by == "the joints' names" and character.formats == (".csv",)
    assert (
        character.joint_map["left_hip"] == "left_hip_yaw" and character.joint_map["right_ankle"] == "right_ankle_roll"
    )
    assert character.joint_map["head"] == "neck" and character.rig.spine
    names, rows = table(stmc.retarget(motion, character))
    base = "root" if robot.suffix == ".xml" else "pelvis"
    assert names[:8] == ["time", *(f"{base}_{axis}" for axis in ("x", "y", "z", "qw", "qx", "qy", "qz"))]
    own = [part.name for part in made.parts()]
    assert sorted(names[8:]) == sorted(own) and (robot.suffix == ".xml" or names[8:] == own)
    assert rows.shape == (50, len(names)), "50 frames per second"
    assert len(table(stmc.retarget(motion, character, fps=30))[1]) == 30


def test_several_hinges_are_one_joint_where_their_axes_meet(robot):
    rig = stmc.read_character(robot).rig
    for joint, place in (
        ("left_hip", (0.09, 0, 0.75)),
        ("left_shoulder", (0.18, 0, 1.23)),
        ("left_wrist", (0.18, 0, 0.74)),
    ):
        away = rig.at(joint) - torch.tensor(place, dtype=torch.float64)
        assert away.abs().max() < 0.02, (joint, rig.at(joint))
    assert rig.linkage.soles[:, 2].min() == 0.0


def test_a_robot_without_names_is_told_by_its_shape_and_a_joint_map_corrects_it(tmp_path):
    path, named = tmp_path / "robot.urdf", made.parts()
    path.write_text(made.urdf(made.renamed(named)))
    character = stmc.read_character(path)
    assert character.found_by == "the robot's shape"
    names = [part.name for part in named]
    found = {joint: names[int(name[1:])] for joint, name in character.joint_map.items() if name != "pelvis"}
    assert found["left_hip"] == "left_hip_yaw" and found["right_knee"] == "right_knee"
    assert found["left_elbow"].startswith("left_elbow") and found["right_ankle"] == "right_ankle_roll"
    corrected = stmc.read_character(path, {"left_wrist": character.joint_map["left_wrist"], "head": None})
    assert corrected.found_by == "the robot's shape, corrected by the joint map"
    again = stmc.read_character(path, character.joint_map)
    assert again.joint_map == character.joint_map and torch.equal(again.rig.rest, character.rig.rest)
    with pytest.raises(CharacterError, match="joint map: left_elbow is 'elbow', but the file's joints are"):
        stmc.read_character(path, {"left_elbow": "elbow"})


def test_limbs_point_where_ours_do_as_far_as_hinges_let_them(robot):
    source = posed(left_shoulder=[0.0, 0.0, -1.2], right_shoulder=[0.0, 0.6, 0.9], right_elbow=[0.0, 1.2, 0.0])
    source = source.resampled(50)
    moved = stmc.retarget(source, robot)
    for side in ("left", "right"):
        for above, below in pairwise(f"{side}_{joint}" for joint in ("shoulder", "elbow", "wrist")):
            assert angle(moved, source, above, below)[-1] < 3, (above, below)


def test_the_head_is_touched_where_ours_is_in_lengths_of_the_arm(robot):
    source = posed(left_shoulder=[0.0, -0.4, 0.7], left_elbow=[0.0, -2.2, 0.6])
    moved = stmc.retarget(source, robot)
    rig = moved.motion.rig
    away = moved.motion.places[-1, rig.place("left_wrist")] - moved.motion.places[-1, rig.place("head")]
    assert float(away.norm()) / rig.length(("shoulder", "elbow", "wrist")) == pytest.approx(0.377, abs=0.05)


@pytest.mark.slow
def test_an_arm_that_would_end_at_its_limits_is_turned_the_other_way(tmp_path):
    """The shoulders of JVRC-1: a straight arm can begin in two ways, of which one does not reach the head."""
    limits = {"shoulder_pitch": (-3.14, 1.05), "shoulder_yaw": (-1.57, 1.57), "elbow": (-2.53, 0.0)}
    limits |= {"left_shoulder_roll": (-0.17, 1.75), "right_shoulder_roll": (-1.75, 0.17)}
    own = []
    for part in made.parts():
        found = [pair for name, pair in limits.items() if part.name.endswith(name)]
        own.append(dataclasses.replace(part, lower=found[0][0], upper=found[0][1]) if found else part)
    path = tmp_path / "robot.urdf"
    path.write_text(made.urdf(own, speed=9.0))
    moved = stmc.retarget(posed(left_shoulder=[0.0, -0.4, 0.7], left_elbow=[0.0, -2.2, 0.6]), path, fps=25)
    rig = moved.motion.rig
    away = moved.motion.places[-1, rig.place("left_wrist")] - moved.motion.places[-1, rig.place("head")]
    assert float(away.norm()) / rig.length(("shoulder", "elbow", "wrist")) == pytest.approx(0.377, abs=0.05)
    names, rows = table(moved)
    for part in own:
        values = rows[:, names.index(part.name)]
        assert part.lower <= values.min() and values.max() <= part.upper, part.name
        assert np.abs(np.diff(values)).max() <= 9.0 / 25, part.name


@pytest.mark.slow
def test_a_first_frame_that_is_folded_wrongly_is_solved_again_from_the_frames_after_it(tmp_path, monkeypatch):
    monkeypatch.setattr(hinges._Problem, "solved", lambda self, frame, angles, base: (self.linkage.upper - 0.01, base))
    path = tmp_path / "robot.urdf"
    path.write_text(made.urdf())
    source = posed(left_shoulder=[0.0, 0.0, -0.6]).resampled(25)
    moved = stmc.retarget(source, path, fps=25)
    for joint in ("shoulder", "elbow"):
        below = {"shoulder": "elbow", "elbow": "wrist"}[joint]
        assert angle(moved, source, f"left_{joint}", f"left_{below}")[0] < 5, joint


def test_feet_keep_their_contacts_and_no_corner_of_a_sole_is_below_the_floor(robot, motion):
    moved = stmc.retarget(motion, robot)
    soles = corners(moved)
    assert soles[..., 2].min() > -1e-9
    standing = stmc.retarget(posed(head=[0.0, 0.5, 0.0]), robot)
    steps = np.abs(np.diff(corners(standing), axis=0))[1:]
    assert steps.max() < 1e-3 and np.abs(corners(standing)[..., 2]).max() < 5e-3


def test_values_stay_within_limits_and_speeds_also_when_rounded(tmp_path, motion):
    path = tmp_path / "robot.urdf"
    path.write_text(made.urdf(speed=1.5))
    kicking = posed(seconds=0.5, left_hip=[-1.9, 0.0, 0.0], right_elbow=[0.0, 2.9, 0.0], left_knee=[2.9, 0, 0])
    for source in (motion, kicking):
        names, rows = table(stmc.retarget(source, path))
        values = {part.name: rows[:, names.index(part.name)] for part in made.parts()}
        for part in made.parts():
            assert values[part.name].min() >= part.lower and values[part.name].max() <= part.upper, part.name
            assert np.abs(np.diff(values[part.name])).max() <= 1.5 / 50, part.name
        fastest = max(np.abs(np.diff(each)).max() for each in values.values())
        assert source is motion or fastest > 0.029, "the limit is reached"


def test_a_robot_that_hangs_from_its_chest_is_the_same_robot(tmp_path, motion):
    """The chest as the root, and legs below the waist, as many a model of MuJoCo has it."""
    chest = made.Part("chest", "pelvis", (0, 0, -0.1), "yaw", -1.0, 1.0)
    moved = []
    for part in made.parts():
        leg = any(word in part.name for word in ("hip", "knee", "ankle"))
        if part.parent == "pelvis" and leg:
            moved.append(made.Part(part.name, "chest", part.place, part.axis, part.lower, part.upper, part.box))
        elif part.name not in ("waist", "chest"):
            moved.append(
                made.Part(part.name, part.parent if leg or part.parent != "chest" else "pelvis", *_rest_of(part))
            )
    path = tmp_path / "robot.urdf"
    path.write_text(made.urdf([chest, *moved]))
    character = stmc.read_character(path)
    assert character.joint_map["pelvis"] == "chest" and character.rig.spine
    walked = stmc.retarget(motion, character)
    assert corners(walked)[..., 2].min() > -1e-9
    assert angle(walked, motion.resampled(50), "left_shoulder", "left_elbow").max() < 3


def _rest_of(part: made.Part) -> tuple:
    return part.place, part.axis, part.lower, part.upper, part.box


def test_a_robot_without_head_and_hands_gets_them_at_the_ends_of_what_it_has(tmp_path, motion):
    kept = [part for part in made.parts() if part.name != "neck" and "wrist" not in part.name]
    path = tmp_path / "robot.xml"
    path.write_text(made.mjcf([_with_box(part) if "elbow" in part.name else part for part in kept]))
    character = stmc.read_character(path)
    assert character.joint_map["head"] == "chest" and character.joint_map["left_wrist"] == "left_elbow"
    assert character.rig.at("head")[2] > character.rig.at("left_shoulder")[2] + 0.05
    lower = character.rig.at("left_wrist") - character.rig.at("left_elbow")
    assert float(lower[2]) == pytest.approx(-0.23, abs=0.02)
    again = stmc.read_character(path, character.joint_map)
    assert torch.allclose(again.rig.rest, character.rig.rest, atol=1e-6)
    assert table(stmc.retarget(motion, character))[1].shape[0] == 50


def _with_box(part: made.Part) -> made.Part:
    return made.Part(
        part.name, part.parent, part.place, part.axis, part.lower, part.upper, (0.02, 0.02, 0.1, 0, 0, -0.1)
    )


def test_mimics_sliders_and_other_bodies_keep_their_columns(tmp_path, motion):
    more = (
        "<link name='finger'/><joint name='gripper' type='prismatic'>"
        "<parent link='left_wrist_link'/><child link='finger'/><limit lower='0.01' upper='0.04'/></joint>"
        "<link name='eye'/><joint name='eye_yaw' type='continuous'>"
        "<parent link='neck_link'/><child link='eye'/><mimic joint='neck' multiplier='-2' offset='0.1'/></joint>"
    )
    path = tmp_path / "robot.urdf"
    path.write_text(made.urdf(more=more))
    names, rows = table(stmc.retarget(motion, path))
    assert rows[:, names.index("gripper")] == pytest.approx(0.01)
    assert rows[:, names.index("eye_yaw")] == pytest.approx(-2 * rows[:, names.index("neck")] + 0.1, abs=1e-5)
    path = tmp_path / "scene.xml"
    path.write_text(made.mjcf(more="<body name='ball' pos='1 2 3'><freejoint/><geom size='0.1'/></body>"))
    names, rows = table(stmc.retarget(motion, path))
    assert names[1:8] == [f"ball_{axis}" for axis in ("x", "y", "z", "qw", "qx", "qy", "qz")]
    assert rows[:, 1:8] == pytest.approx(np.tile([1, 2, 3, 1, 0, 0, 0], (50, 1)))


def test_our_own_skeleton_as_a_model_follows_our_motion(tmp_path, motion):
    stmc.write(motion, tmp_path / "ours.xml")
    moved = stmc.retarget(motion, tmp_path / "ours.xml", fps=20)
    rig = moved.motion.rig
    for joint in ("left_ankle", "right_knee", "left_elbow", "right_wrist"):
        away = moved.motion.places[:, rig.place(joint)] - motion.joints[:, JOINTS.index(joint)]
        assert (away - away.mean(dim=0)).norm(dim=-1).max() < 0.04, joint
        assert away.mean(dim=0).numpy() == pytest.approx([0, 0, 0.035], abs=0.01), "its capsules stand on the floor"


@pytest.mark.parametrize("name", FILES)
def test_mujoco_replays_the_table(name, tmp_path, motion):
    mujoco = pytest.importorskip("mujoco")
    path = tmp_path / name
    path.write_text(FILES[name]())
    spec = mujoco.MjSpec.from_file(str(path)) if name.endswith("xml") else _mujoco_urdf(mujoco, path)
    model = spec.compile()
    data, moved = mujoco.MjData(model), stmc.retarget(motion, path)
    names, rows = table(moved)
    order = [0, 1, 2, 3, 4, 5, 6, *(names[1:].index(model.joint(number).name) for number in range(1, model.njnt))]
    standing = moved.character.standing
    for frame in (0, 20, 49):
        data.qpos[:] = rows[frame, 1:][order]
        mujoco.mj_kinematics(model, data)
        for joint, hinge in (
            ("left_ankle", "left_ankle_roll"),
            ("right_knee", "right_knee"),
            ("left_wrist", "left_wrist"),
        ):
            place = moved.motion.places[frame, moved.motion.rig.place(joint)].numpy()
            turned = np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1]]) @ place  # a robot faces x, our motions -y
            assert np.abs(data.joint(hinge).xanchor - turned).max() < 1e-4, (frame, joint)
    assert standing.turn == pytest.approx(np.array([[0, 1, 0], [-1, 0, 0], [0, 0, 1]]))


def _mujoco_urdf(mujoco, path: Path):
    masses = "<inertial><mass value='1'/><inertia ixx='1' iyy='1' izz='1' ixy='0' ixz='0' iyz='0'/></inertial></link>"
    text = path.read_text().replace("<link name='pelvis'/>", "<link name='pelvis'></link>").replace("</link>", masses)
    spec = mujoco.MjSpec.from_string(text.replace("<robot name='robot'>", f"<robot name='robot'>{_KEPT}"))
    spec.worldbody.first_body().add_freejoint()
    return spec


_KEPT = "<mujoco><compiler fusestatic='false'/></mujoco>"


@pytest.mark.parametrize(
    ("package", "inside", "most"),
    [("dm_control", "suite/humanoid.xml", 8.0), ("gymnasium", "envs/mujoco/assets/humanoid.xml", 12.0)],
)
def test_a_robot_that_a_package_ships_walks(package, inside, most, motion):
    found = find_spec(package)
    if found is None or not found.submodule_search_locations:
        pytest.skip(f"{package} is not installed")
    path = Path(found.submodule_search_locations[0]) / inside
    moved = stmc.retarget(motion, path)
    assert corners(moved)[..., 2].min() > -1e-9
    source = motion.resampled(50)
    degrees = [angle(moved, source, f"{side}_hip", f"{side}_knee").mean() for side in ("left", "right")]
    assert max(degrees) < most


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("left_hip_yaw_joint", ("left", ("hip",))),
        ("RLEG_HIP_R", ("right", ("hip", "leghip"))),
        ("R_ANKLE_P_S", ("right", ("ankle",))),
        ("L_HIP_R", ("left", ("hip",))),
        ("LKneePitch", ("left", ("knee",))),
        ("r_upper_arm", ("right", ("upper", "upperarm"))),
        ("lfemurrx", ("left", ("femur",))),
        ("right_shoulder1", ("right", ("shoulder",))),
        ("neck_yaw", (None, ("neck",))),
    ],
)
def test_names_of_robots_are_taken_apart(name, expected):
    assert robot_words(name) == expected
