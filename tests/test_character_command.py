"""`stmc sample … character=hero.glb`: the files show the character, and what cannot be is refused before the model."""

import json

import pytest
from helpers import characters as made
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


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        (["formats=npz", "character={hero}"], "none of these formats shows it; add one of glb, vrma, bvh"),
        (["formats=glb,vrm", "character={hero}"], "has no humanoid map of VRM; choose from glb, vrma, bvh"),
        (["formats=vrma"], "need a character: character=hero.vrm"),
        (["joint_map=map.yaml"], "need a character: character=hero.vrm"),
        (["character={hero}.zip"], "no characters of '.zip' files are read"),
    ],
)
def test_a_character_that_cannot_be_shown_is_refused_in_a_sentence(settings, message, hero, run, tmp_path, capsys):
    folder = tmp_path / "out"
    arguments = ["nod # 0 # 1", str(folder), f"model={run}", *(each.format(hero=hero) for each in settings)]
    assert loaded("sample").main(arguments) == 2
    assert message in capsys.readouterr().err
    assert not list(folder.glob("*"))
