"""Our .glb and .bvh in Blender itself: its own importers put every bone where the motion has the joint."""

import json
import subprocess
from pathlib import Path

import numpy as np
import pytest
from helpers.blender import REASON, command
from helpers.motions import walking

from stmc.formats import write
from stmc.motion.body import JOINTS, NUM_ROTATIONS, PARENTS
from stmc.motion.body_model import Skeleton
from stmc.motion.motion import Motion

COMMAND = command(Path(__file__).parent / "helpers" / "blender_import.py")

pytestmark = [pytest.mark.slow, pytest.mark.skipif(COMMAND is None, reason=REASON)]

DEEPEST = 9
"""Joints from the pelvis to a hand."""
WRITTEN = {".glb": 2.0**-24, ".bvh": 0.5e-6}
"""How far a number near 1 in the file is from the one that was meant: float32, and six decimals."""
HELD = 2.0**-24
"""The same of numbers in Blender: float32."""


@pytest.fixture(scope="module")
def motion() -> Motion:
    return walking(seconds=2.0, fps=30)


@pytest.fixture(scope="module")
def told(motion, tmp_path_factory) -> dict[str, dict]:
    """What Blender makes of each file, by its suffix."""
    folder = tmp_path_factory.mktemp("blender")
    paths = {suffix: str(folder / f"walk{suffix}") for suffix in WRITTEN}
    for path in paths.values():
        write(motion, path)
    result = folder / "told.json"
    done = subprocess.run(
        [*COMMAND, str(result), f"{motion.fps:g}", *paths.values()], capture_output=True, text=True, timeout=600
    )
    assert result.exists(), done.stdout + done.stderr
    content = json.loads(result.read_text())
    return {suffix: content[path] for suffix, path in paths.items()}


def precision(suffix: str) -> float:
    """Metres by which a joint may be off: each joint above it adds an offset and a rotation, of three numbers each, in
    a body within two metres of the origin."""
    return DEEPEST * 2 * 3 * 2 * (WRITTEN[suffix] + HELD)


def placed(where: list[dict], joints: list[str]) -> np.ndarray:
    return np.array([[frame[name] for name in joints] for frame in where])


@pytest.mark.parametrize("suffix", WRITTEN)
def test_blender_has_the_motion_s_bones_frame_rate_and_frames(told, motion, suffix):
    count = len(JOINTS) if suffix == ".glb" else NUM_ROTATIONS
    parents = [None if parent < 0 else JOINTS[parent] for parent in PARENTS]
    assert told[suffix]["bones"] == dict(zip(JOINTS[:count], parents[:count], strict=True))
    rounded = {".glb": 0.0, ".bvh": 0.5e-8 * motion.fps}  # a .bvh has the seconds of a frame, in eight decimals
    assert told[suffix]["fps"] == pytest.approx(motion.fps, rel=rounded[suffix] + HELD)
    assert round(told[suffix]["frames"]) == motion.frames


@pytest.mark.parametrize("suffix", WRITTEN)
def test_blender_puts_each_bone_where_the_motion_has_the_joint_in_every_frame(told, motion, suffix):
    bones = list(told[suffix]["bones"])
    expected = motion.joints[:, [JOINTS.index(name) for name in bones]].numpy()
    assert np.abs(placed(told[suffix]["heads"], bones) - expected).max() < precision(suffix)


def test_the_wrists_of_a_bvh_end_in_the_hands(told, motion):
    hands = motion.joints[:, [JOINTS.index("left_hand"), JOINTS.index("right_hand")]].numpy()
    ends = placed(told[".bvh"]["tails"], ["left_wrist", "right_wrist"])
    assert np.abs(ends - hands).max() < precision(".bvh")


def test_a_glb_rests_in_the_skeleton_s_t_pose_and_brings_the_figure_with_its_materials(told):
    rest = Skeleton.default().rest.double().numpy() @ np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])  # y up to z up
    bones = list(told[".glb"]["bones"])
    expected = rest[[JOINTS.index(name) for name in bones]]
    assert np.abs(placed([told[".glb"]["rest"]], bones)[0] - expected).max() < precision(".glb")
    assert told[".glb"]["meshes"]["figure"] == 5
