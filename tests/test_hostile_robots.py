"""Robots' files that are damaged or hostile: refused in one sentence that says what is missing, soon and small."""

import math
import random
import re
import time
from pathlib import Path

import pytest
from fuzz import mutated
from helpers import robots as made
from helpers.motions import walking

import stmc
from stmc.formats.characters import CharacterError

LONGEST = 300


def refused(path: Path, content: bytes | str) -> str:
    """The sentence with which a file is refused, without its name."""
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    with pytest.raises(CharacterError) as caught:
        stmc.read_character(path)
    message = str(caught.value)
    assert message.startswith(f"{path}: ") and "\n" not in message and len(message) < LONGEST + len(str(path))
    return message.removeprefix(f"{path}: ")


BOMB = "<!DOCTYPE r [<!ENTITY a 'aaaaaaaaaa'><!ENTITY b '&a;&a;&a;&a;&a;&a;'>]><robot name='&b;'/>"
SECRET = "<!DOCTYPE r [<!ENTITY x SYSTEM 'file:///etc/passwd'>]><robot name='&x;'/>"
URDF = made.urdf()
BAD_URDF = {
    "": "line 1, column 1: not XML (no element found)",
    "<robot": "line 1, column 1: not XML (unclosed token)",
    BOMB: "it has a document type (<!DOCTYPE>)",
    SECRET: "it has a document type (<!DOCTYPE>)",
    "<a>" * 300: "more than 50,000 elements, or more than 200 deep",
    "<robot>" + "<link/>" * 60_000 + "</robot>": "more than 50,000 elements",
    "<mujoco/>": "its outermost element is <mujoco>; a URDF begins with <robot>",
    "<robot/>": "it has 0 links",
    "<robot xmlns:xacro='x'><xacro:macro/></robot>": "it is a template of xacro",
    "<robot><link name='a'/><link name='b'/></robot>": "it has 2 links without a parent, such as 'b': keep one robot",
    "<robot><link name='a'/><link name='a'/></robot>": "a <link> has the name of another, 'a'",
    "<robot><link name='a'/></robot>": "no joint was found for left_hip",
    URDF.replace("<axis xyz='0 1 0'/>", "<axis xyz='0 0 0'/>"): "the axis of joint 'left_hip_pitch' is [0.0, 0.0, 0.0]",
    URDF.replace("upper='2.5'", "upper='nan'"): "upper of the limit of joint 'left_knee' is 'nan'",
    URDF.replace("lower='0.0' upper='2.5'", "lower='3' upper='2.5'"): "the limits of joint 'left_knee' are 3 and 2.5",
    URDF.replace("xyz='0 0 -0.25'", "xyz='0 0 -1e9'"): "xyz of the origin of joint 'left_knee' is '0 0 -1e9'",
    URDF.replace("xyz='0 0 -0.25'", "xyz='0 0'"): "xyz of the origin of joint 'left_knee' is '0 0': it must have 3",
    URDF.replace("xyz='0 0 -0.25'", "xyz='0 0 up'"): "xyz of the origin of joint 'left_knee' is '0 0 up', which is not",
    URDF.replace("name='left_knee' type='revolute'", "name='left_knee' type='planar'"): "joint 'left_knee' is 'planar'",
    URDF.replace("<child link='left_knee_link'/>", "<child link='knee'/>"): "the child of joint 'left_knee' is 'knee'",
    URDF.replace("<child link='left_knee_link'/>", "<child link='right_knee_link'/>"): "link 'right_knee_link' has two",
    URDF.replace("<parent link='left_hip_yaw_link'/>", "<parent link='left_knee_link'/>"): "its links form a cycle",
    URDF.replace("0 0 -0.25", "0 0 0").replace(
        "0 0 -0.1'", "0 0 0'"
    ): "left_knee is where left_hip is: the bone between them has no length",
    URDF.replace("<child link='left_knee_link'/>", "<child link='left_knee_link'/><mimic joint='right_knee'/>"): (
        "joint 'left_knee' mimics another, which is not read within limbs and trunk"
    ),
}


@pytest.mark.parametrize("content", BAD_URDF, ids=lambda text: re.sub(r"\W+", "_", BAD_URDF[text])[:40])
def test_a_bad_urdf_is_refused_in_a_sentence_that_says_why(content, tmp_path):
    assert refused(tmp_path / "robot.urdf", content).startswith(BAD_URDF[content])


MJCF = made.mjcf()
KNEE = re.search(r"<joint name='left_knee'[^>]*/>", MJCF)[0]
BAD_MJCF = {
    "<robot/>": "its outermost element is <robot>; an MJCF model begins with <mujoco>",
    "<mujoco/>": "its world has no bodies",
    "<mujoco><worldbody><body/></worldbody></mujoco>": "no joint was found for left_hip",
    MJCF.replace(
        "<mujoco model='robot'>", "<mujoco><include file='/etc/passwd'/>"
    ): "it includes '/etc/passwd', which is",
    MJCF.replace(
        "<mujoco model='robot'>", "<mujoco><include file='../a.xml'/>"
    ): "it includes '../a.xml', which is not in",
    MJCF.replace(
        "<mujoco model='robot'>", "<mujoco><include file='b.xml'/>"
    ): "it includes 'b.xml', which is not there",
    MJCF.replace(
        "<mujoco model='robot'>", "<mujoco><include file='robot.xml'/>"
    ): "it includes 'robot.xml' more than once",
    MJCF.replace("<mujoco model='robot'>", "<mujoco><compiler eulerseq='abc'/>"): "eulerseq of its compiler is 'abc'",
    MJCF.replace("<mujoco model='robot'>", "<mujoco><compiler coordinate='global'/>"): "its coordinates are global",
    MJCF.replace("class='limited' axis", "class='other' axis"): "the class 'other' of a joint has no defaults",
    MJCF.replace("<worldbody>", "<worldbody><replicate count='9'/>"): "its bodies are made by <replicate>",
    MJCF.replace(KNEE, "<freejoint/>" + KNEE): "body 'left_knee_body' moves freely, but hangs from another",
    MJCF.replace(KNEE, KNEE.replace("range=", "type='ball' range=")): "joint 'left_knee' is a ball with limits",
    MJCF.replace(KNEE, KNEE.replace("range=", "type='screw' range=")): "joint 'left_knee' is 'screw'; joints are free",
    MJCF.replace("pos='0 0 0.75'", "pos='0 0 0.75' quat='0 0 0 0'"): "quat of body 'pelvis' is [0.0, 0.0, 0.0, 0.0]",
    MJCF.replace("pos='0 0 0.75'", "pos='0 0 0.75' euler='0 45 0'"): "its rest pose does not stand upright",
}


@pytest.mark.parametrize("content", BAD_MJCF, ids=lambda text: re.sub(r"\W+", "_", BAD_MJCF[text])[:40])
def test_a_bad_model_is_refused_in_a_sentence_that_says_why(content, tmp_path):
    assert refused(tmp_path / "robot.xml", content).startswith(BAD_MJCF[content])


def test_a_model_includes_files_of_its_own_folder(tmp_path):
    (tmp_path / "parts").mkdir()
    (tmp_path / "parts" / "world.xml").write_text(MJCF)
    (tmp_path / "scene.xml").write_text("<mujoco><include file='parts/world.xml'/></mujoco>")
    (tmp_path / "robot.xml").write_text(MJCF)
    whole, scene = (stmc.read_character(tmp_path / name) for name in ("robot.xml", "scene.xml"))
    assert whole.joint_map == scene.joint_map and whole.body.hinges[3].upper == scene.body.hinges[3].upper
    (tmp_path / "away.xml").symlink_to("/etc/hostname")
    text = "<mujoco><include file='away.xml'/></mujoco>"
    assert refused(tmp_path / "link.xml", text).startswith("it includes 'away.xml', which is not in the model's folder")


def try_mutated(folder: Path, count: int, seed: int, motion: stmc.Motion | None = None) -> None:
    """Damaged robots are read, or refused by name, each within two seconds; those that are read do the motion."""
    rng, read = random.Random(seed), 0
    good = {"robot.xml": MJCF.encode(), "robot.urdf": URDF.encode()}
    for number in range(count):
        name = list(good)[number % len(good)]
        path = folder / name
        path.write_bytes(mutated(good[name], rng))
        began = time.process_time()
        try:
            robot = stmc.read_character(path)
            read += 1
            if motion is not None:
                check_table(stmc.retarget(motion, robot, fps=20).content(".csv").decode(), motion.frames)
        except CharacterError as error:
            assert str(error).startswith(f"{path}: ") and len(str(error)) < LONGEST + len(str(path)), error
        assert time.process_time() - began < 2, number
    assert 0 < read < count


def check_table(text: str, frames: int) -> None:
    """A table has a row of finite numbers for each frame, one below each name."""
    first, *rows = text.splitlines()
    values = [[float(value) for value in row.split(",")] for row in rows]
    assert len(rows) == frames and {len(row) for row in values} == {first.count(",") + 1}
    assert all(math.isfinite(value) for row in values for value in row)


def test_damaged_robots_are_read_or_refused_by_name(tmp_path):
    try_mutated(tmp_path, count=60, seed=0)


@pytest.mark.slow
def test_five_hundred_damaged_robots_do_a_motion_or_are_refused_by_name(tmp_path):
    try_mutated(tmp_path, count=500, seed=1, motion=walking(seconds=0.2, fps=20))
