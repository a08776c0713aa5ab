"""`stmc sample … character=hero.glb`: the files show the character, and what cannot be is refused before the model."""

import json

import pytest
from helpers import characters as made
from helpers import robots
from helpers.scripts import loaded
from helpers.tiny_model import tiny

import stmc


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    return stmc.save(tiny(), tmp_path_factory.mktemp("run") / "run", "")


@pytest.fixture
def hero(tmp_path):
    path = tmp_path / "hero.glb"
    path.write_bytes(made.glb(made.stocky()))
    return path


@pytest.fixture
def robot(tmp_path):
    path = tmp_path / "robot.urdf"
    path.write_text(robots.urdf())
    return path


def test_files_show_the_character_and_a_change_of_its_file_makes_them_again(run, hero, tmp_path, capsys):
    sample, folder = loaded("sample"), tmp_path / "out"
    arguments = ["nod # 0 # 1", str(folder), f"model={run}", "steps=2", "formats=glb,bvh,npz", f"character={hero}"]
    assert sample.main(arguments) == 0
    assert "left_knee: mixamorig:LeftLeg" in "".join(capsys.readouterr())
    [path] = folder.glob("*.glb")
    assert made.unpacked(path.read_bytes())[0]["asset"]["generator"] == "a stranger"
    assert "JOINT mixamorig:LeftLeg" in path.with_suffix(".bvh").read_text()
    assert stmc.read(path.with_suffix(".npz")).frames == 20
    assert set(json.loads(path.with_suffix(".json").read_text())) >= {"character"}
    before = path.read_bytes()
    assert sample.main(arguments) == 0 and "already" in "".join(capsys.readouterr())
    hero.write_bytes(made.glb(made.lanky()))
    assert sample.main(arguments) == 0 and path.read_bytes() != before


def test_files_without_formats_are_the_characters_own_and_a_page(run, hero, robot, tmp_path):
    for character, suffix in ((hero, ".glb"), (robot, ".csv")):
        folder = tmp_path / suffix
        arguments = ["nod # 0 # 0.4", str(folder), f"model={run}", "steps=1", f"character={character}"]
        assert loaded("sample").main(arguments) == 0
        assert {path.suffix for path in folder.iterdir()} == {".npz", suffix, ".html", ".json"}


@pytest.mark.parametrize(
    ("name", "content", "columns"),
    [
        ("robot.xml", robots.mjcf(), ["root_x", "left_knee"]),
        ("robot.urdf", robots.urdf(), ["pelvis_x", "left_knee"]),
    ],
)
def test_the_table_of_a_robot_has_its_joints_at_its_rate(name, content, columns, run, tmp_path, capsys):
    robot, folder = tmp_path / name, tmp_path / "out"
    robot.write_text(content)
    arguments = ["nod # 0 # 0.4", str(folder), f"model={run}", "steps=1", "formats=csv,bvh", f"character={robot}"]
    assert loaded("sample").main(arguments) == 0
    assert "left_knee: left_knee" in "".join(capsys.readouterr())
    [path] = folder.glob("*.csv")
    first, *rows = path.read_text().splitlines()
    assert first.startswith("time,") and set(columns) <= set(first.split(","))
    assert len(rows) == 20 and {len(row.split(",")) for row in rows} == {first.count(",") + 1}
    assert "JOINT left_knee" in path.with_suffix(".bvh").read_text(), "the other formats have our body"
    assert loaded("sample").main(arguments) == 0 and "already" in "".join(capsys.readouterr())


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        (["formats=npz", "character={hero}"], "none of these formats shows it; add one of glb, vrma, bvh"),
        (["formats=glb,vrm", "character={hero}"], "has no humanoid map of VRM; choose from glb, vrma, bvh"),
        (["formats=vrma"], "need a character: character=hero.vrm"),
        (["joint_map=map.yaml"], "need a character: character=hero.vrm"),
        (["formats=npz,glb", "character={robot}"], "robot.urdf: none of these formats shows it; add one of csv"),
        (["formats=csv,vrma", "character={robot}"], "robot.urdf is a robot, whose motions are tables; choose from csv"),
        (["formats=csv,vrm", "character={robot}"], "robot.urdf has no humanoid map of VRM; choose from csv"),
        (["character={hero}.zip"], "cannot read a character from a '.zip' file"),
    ],
)
def test_a_character_that_cannot_be_shown_is_refused_in_a_sentence(
    settings, message, hero, robot, run, tmp_path, capsys
):
    folder = tmp_path / "out"
    settings = [each.format(hero=hero, robot=robot) for each in settings]
    arguments = ["nod # 0 # 1", str(folder), f"model={run}", *settings]
    assert loaded("sample").main(arguments) == 2
    assert message in capsys.readouterr().err
    assert not list(folder.glob("*"))
