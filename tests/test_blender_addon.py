"""The add-on in Blender itself: an armature of somebody's character moves as `stmc.retarget` moves the character."""

import json
import os
import subprocess
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from conftest import data_file
from helpers import characters as made
from helpers.blender import REASON, command
from helpers.studio import Served, served

import stmc

HELPERS = Path(__file__).parent / "helpers"
COMMAND = command(HELPERS / "blender_addon_run.py")
ADDON = Path(stmc.__file__).parent / "assets" / "api" / "blender_addon.py"
LINES = ["walk forwards # 0 # 1.5 # legs", "wave with the right hand # 0.5 # 1.5 # right arm"]

pytestmark = [pytest.mark.slow, pytest.mark.skipif(COMMAND is None, reason=REASON)]


@pytest.fixture(scope="module")
def studio(tmp_path_factory) -> Iterator[Served]:
    with served(tmp_path_factory.mktemp("studio")) as studio:
        yield studio


@pytest.fixture
def blender(studio, tmp_path):
    """A function that runs the add-on on a character's file, and returns what has come of it."""

    def run(character: Path, **changed) -> dict:
        request = {
            "addon": str(ADDON), "address": studio.address, "token_file": str(studio.token_file), "lines": LINES,
            "character": str(character), "fps": 24, "seed": 3, "start": 5, "patience": 120,
            "saved": str(tmp_path / "saved.blend"),
        } | changed  # fmt: skip
        (tmp_path / "request.json").write_text(json.dumps(request))
        environment = {name: value for name, value in os.environ.items() if not name.startswith("PYTHON")}
        environment |= {"BLENDER_USER_RESOURCES": str(tmp_path), "BLENDER_USER_SCRIPTS": str(tmp_path / "scripts")}
        files = [str(tmp_path / "request.json"), str(tmp_path / "result.json")]
        done = subprocess.run([*COMMAND, *files], capture_output=True, text=True, timeout=300, env=environment)
        assert (tmp_path / "result.json").exists(), done.stdout + done.stderr
        return json.loads((tmp_path / "result.json").read_text())

    return run


def expected(studio: Served, character: Path, fps: int) -> list[dict[str, np.ndarray]]:
    """Where the nodes of a character's file are in each frame, in Blender's axes, as `stmc.retarget` writes them."""
    [name] = {path.stem for path in studio.motions.glob("*.npz")} - studio.before
    moved = stmc.retarget(stmc.read(studio.motions / f"{name}.npz").resampled(fps), character)
    content = moved.content(".glb")
    return [
        {name: matrix[[0, 2, 1], 3] * [1, -1, 1] for name, matrix in made.moved(content, frame).items()}
        for frame in range(len(moved.motion.places))
    ]


def driven(character: Path) -> set[str]:
    rig = stmc.read_character(character).rig
    return {rig.names[node] for node in rig.driven}


CASES = {
    "male": {},
    "zombie": {"modes": {"XYZ": ["upperarm_l", "thigh_r", "pelvis"], "AXIS_ANGLE": ["calf_l"], "ZYX": ["upperarm_r"]}},
    "CesiumMan": {},
}


@pytest.mark.parametrize("name", CASES)
def test_the_bones_of_a_stranger_s_armature_are_where_retarget_puts_the_nodes(studio, blender, name):
    studio.remember()
    character = data_file(f"characters/{name}.glb")
    told = blender(character, importing={"guess_original_bind_pose": False}, **CASES[name])
    assert not told["failed"], told["message"]
    frames = expected(studio, character, fps=24)
    assert told["range"] == [5, 5 + len(frames) - 1] and len(frames) == 36
    assert told["action"] == "stmc: walk forwards"
    bones = driven(character) & set(told["rest"])
    assert len(bones) > 15
    own = np.array([[frame[bone] for bone in bones] for frame in told["heads"]])
    ours = np.array([[frame[bone] for bone in bones] for frame in frames])
    height = ours[..., 2].max() - ours[..., 2].min()
    assert np.abs(own - ours).max() < 1e-4 * height
    assert np.ptp(own, axis=0).max() > 0.05 * height, "it moves"
    print(f"\n{name}: {np.abs(own - ours).max() / height:.1e} of the height; held up {told['longest']:.3f} s at most")
