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
SIDES, BONES = ("left", "right"), (("hip", "knee"), ("knee", "ankle"), ("shoulder", "elbow"), ("elbow", "wrist"))
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
            "character": str(character), "fps": 24, "seed": 3, "start": 5,
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


Y_UP_TO_Z_UP = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
"""From glTF's world to Blender's."""
CASES = {
    "male": {},
    "zombie": {"modes": {"XYZ": ["upperarm_l", "thigh_r", "pelvis"], "AXIS_ANGLE": ["calf_l"], "ZYX": ["upperarm_r"]}},
    "CesiumMan": {},
}
"""Characters, and the rotation modes of some of their bones."""


@pytest.mark.parametrize("name", CASES)
def test_the_bones_of_a_stranger_s_armature_are_where_retarget_puts_them(studio, blender, name):
    path = data_file(f"characters/{name}.glb")
    studio.remember()
    told = blender(path, importing={"guess_original_bind_pose": False}, **CASES[name])
    assert not told["failed"], told["message"]
    assert (told["action"], told["range"]) == ("stmc: walk forwards", [5, 40])
    moved = stmc.retarget(studio.new_motion().resampled(24), path)
    character, rig = moved.character, moved.motion.rig
    bones = [rig.names[node] for node in rig.driven if rig.names[node] in told["rest"]]
    heads = np.array([[frame[bone] for bone in bones] for frame in told["heads"]])
    places = moved.motion.places[:, [rig.driven.index(rig.names.index(bone)) for bone in bones]].numpy()
    height = float(np.ptp(rig.rest[:, 2].numpy()))
    assert np.abs(heads - places @ character.standing.turn @ Y_UP_TO_Z_UP.T).max() < 1e-4 * height
    assert np.ptp(heads, axis=0).max() > 0.05 * height, "it moves"
    assert directions_differ(told["heads"], moved) < 1.0


def test_an_armature_in_other_axes_and_units_moves_the_same_in_the_world(studio, blender, tmp_path):
    path = tmp_path / "lanky.glb"
    path.write_bytes(made.glb(made.lanky(), seed=3))
    studio.remember()
    attempts = [{"connect": "DEF-hips"}]
    told = blender(
        path, turned=np.pi / 2, scaled=100.0, attempts=attempts, importing={"guess_original_bind_pose": False}
    )
    assert "The bone DEF-hips cannot travel" in told["attempts"][0]["message"]
    assert not told["failed"], told["message"]
    moved = stmc.retarget(studio.new_motion().resampled(24), path)
    assert "DEF-spine.006" in told["heads"][0]
    assert directions_differ(told["heads"], moved) < 0.1


def test_the_panel_says_what_is_wrong_and_what_was_cancelled_leaves_no_trace(studio, blender, tmp_path):
    path, empty = tmp_path / "stocky.glb", tmp_path / "empty"
    path.write_bytes(made.glb(made.stocky(), seed=5))
    attempts = {
        "Cancelled": {"cancel_at": "Finding"},
        "line 1: 'walk # 0' has no end": {"lines": ["walk # 0"]},
        "line 1: unknown body part 'tail'": {"lines": ["walk # 0 # 1 # tail"]},
        "No studio answers at http://127.0.0.1:1": {"address": "http://127.0.0.1:1"},
        "The address must be one of this machine": {"address": "http://studio.example:8686"},
        "There is no token in": {"token_file": str(empty)},
        "cannot be both left_knee and right_knee": {"joints": {"left_knee": "mixamorig:RightLeg"}},
        "Constraints may hold mixamorig:Head: mute them": {"constrain": "mixamorig:Head"},
    }
    told = blender(path, attempts=list(attempts.values()))
    assert not told["failed"], told["message"]
    for words, attempt in zip(attempts, told["attempts"], strict=True):
        assert words.lower() in attempt["message"].lower()
        assert attempt["changed"] == words.startswith("Constraints")
    saved = (tmp_path / "saved.blend").read_bytes()
    assert studio.token_file.read_bytes().strip() not in saved and b"walk forwards" in saved


def directions_differ(heads: list[dict], moved: stmc.CharacterMotion) -> float:
    """Degrees, at most, between bones of Blender's armature and of the `.glb` that the library writes."""
    rig, content, largest = moved.motion.rig, moved.content(".glb"), 0.0
    limbs = [(rig.joints[f"{side}_{above}"], rig.joints[f"{side}_{below}"]) for side in SIDES for above, below in BONES]
    for frame in (0, 11, 35):
        nodes = {name: Y_UP_TO_Z_UP @ matrix[:3, 3] for name, matrix in made.moved(content, frame).items()}
        for above, below in limbs:
            first, second = (
                np.subtract(each[rig.names[below]], each[rig.names[above]]) for each in (heads[frame], nodes)
            )
            cosine = np.dot(first, second) / np.linalg.norm(first) / np.linalg.norm(second)
            largest = max(largest, float(np.degrees(np.arccos(min(1.0, cosine)))))
    return largest
