"""Characters of strangers, made by code, and our motions on them: what is found, what is kept, what comes out."""

import json
import re
import runpy
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import torch
from conftest import data_file
from helpers import characters as made
from helpers.motions import walking
from torch.nn.functional import normalize

import stmc
from stmc.formats.characters import CharacterError
from stmc.formats.characters.joint_names import taken_apart
from stmc.motion.body import JOINTS
from stmc.motion.body_model import Skeleton
from stmc.motion.geometry import axis_angle_to_matrix

DOCS = Path(__file__).parents[1] / "docs"
UP = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
"""From glTF's world, y up, to ours."""
LIMBS = [
    pair
    for side in ("left", "right")
    for limb in (("hip", "knee", "ankle"), ("shoulder", "elbow", "wrist"))
    for pair in pairwise(f"{side}_{joint}" for joint in limb)
]
STRANGERS = ("male", "female", "zombie", "CesiumMan")


@pytest.fixture(scope="module")
def motion() -> stmc.Motion:
    return stmc.clean_feet(walking(seconds=2.0, fps=20))


@pytest.fixture(scope="module")
def touching() -> stmc.Motion:
    """Standing, the left hand at the head: elbow bent, upper arm raised."""
    rotations = torch.eye(3, dtype=torch.float64).repeat(20, 22, 1, 1)
    rotations[:, 0] = torch.from_numpy(UP)
    share = torch.linspace(0, 1, 20, dtype=torch.float64)[:, None]
    for joint, turn in (("left_shoulder", [0.0, -0.4, 0.7]), ("left_elbow", [0.0, -2.2, 0.6])):
        rotations[:, JOINTS.index(joint)] = axis_angle_to_matrix(share * torch.tensor(turn, dtype=torch.float64))
    body = Skeleton(Skeleton.default().offsets.double())
    standing = torch.tensor([0.0, 0.0, float(body.rest[0, 1] - body.rest[:, 1].min())], dtype=torch.float64)
    return stmc.Motion.posed(rotations, standing.repeat(20, 1), 20, body)


def write(folder: Path, name: str, content: bytes | str) -> Path:
    path = folder / name
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return path


RIGS = {
    "lanky.glb": lambda: made.glb(made.lanky(), seed=3),
    "stocky.glb": lambda: made.glb(made.stocky(), seed=5, scale=0.01),
    "turned.glb": lambda: made.glb(made.lanky(spines=2, droop=5), seed=None, yaw=np.pi),
    "lanky.bvh": lambda: made.bvh(made.lanky()),
}


@pytest.fixture(params=RIGS)
def character(request, tmp_path) -> stmc.Character:
    return stmc.read_character(write(tmp_path, request.param, RIGS[request.param]()))


@pytest.fixture(params=STRANGERS)
def stranger(request) -> Path:
    return data_file(f"characters/{request.param}.glb")


def angles(source: stmc.Motion, moved: stmc.CharacterMotion) -> torch.Tensor:
    """Degrees [limbs, frames] between our limbs and the character's."""
    found = []
    for above, below in LIMBS:
        ours = normalize(source.joints[:, JOINTS.index(below)] - source.joints[:, JOINTS.index(above)], dim=-1).double()
        own = places(moved, below) - places(moved, above)
        own = normalize(own, dim=-1)
        found.append(torch.rad2deg(torch.atan2(torch.linalg.cross(ours, own).norm(dim=-1), (ours * own).sum(dim=-1))))
    return torch.stack(found)


def places(moved: stmc.CharacterMotion, joint: str) -> torch.Tensor:
    rig = moved.motion.rig
    return moved.motion.places[:, rig.place(joint)]


def arm(rig) -> float:
    return rig.length(("shoulder", "elbow", "wrist"))


def test_limbs_point_where_ours_do_but_for_what_keeps_the_feet(character, motion):
    degrees = angles(motion, stmc.retarget(motion, character))
    arms = [number for number, (_, below) in enumerate(LIMBS) if below.endswith(("elbow", "wrist"))]
    assert degrees[arms].max() < 0.1
    assert degrees.median() < 2 and degrees.mean() < 4


def test_the_head_is_touched_where_ours_is_in_lengths_of_the_arm(character, touching):
    moved = stmc.retarget(touching, character)
    ours = (touching.joints[:, JOINTS.index("left_wrist")] - touching.joints[:, JOINTS.index("head")]).norm(dim=-1)
    unit = sum(float(Skeleton.default().offsets[JOINTS.index(f"left_{each}")].norm()) for each in ("elbow", "wrist"))
    own = (places(moved, "left_wrist") - places(moved, "head")).norm(dim=-1) / arm(character.rig)
    assert float(ours[-1]) / unit < 0.45, "the hand is at the head"
    assert float(own[-1]) == pytest.approx(float(ours[-1]) / unit, abs=0.01)


def test_feet_neither_slide_nor_sink_more_than_ours(character, motion):
    check_feet(motion, stmc.retarget(motion, character).motion)


def check_feet(motion: stmc.Motion, moved) -> None:
    """No sole is lower than ours, and toes that stand stay where they are."""
    rig, stood = moved.rig, 0
    for side in ("left", "right"):
        turn, ankle = moved.turns[:, rig.place(f"{side}_ankle")], moved.places[:, rig.place(f"{side}_ankle")]
        end = f"{side}_foot" if f"{side}_foot" in rig.joints else f"{side}_ankle"
        toes = rig.at(end) * torch.tensor([1.0, 1.0, 0.0])
        own = ankle + turn @ (toes - rig.at(f"{side}_ankle"))
        ours = motion.joints[:, JOINTS.index(f"{side}_foot")].double()
        scale = rig.length(("hip", "knee", "ankle")) / 0.8007
        assert own[:, 2].min() > -1e-3 * scale + min(0.0, float(ours[:, 2].min())) * scale
        if f"{side}_foot" in rig.joints:
            stands = (ours.diff(dim=0).norm(dim=-1) < 1e-4) & (ours[1:, 2] < 0.03)
            stood += int(stands.sum())
            assert (own.diff(dim=0).norm(dim=-1)[stands] < 2e-3 * scale).all()
    assert stood or "left_foot" not in rig.joints


def bent(**turns: list[float]) -> stmc.Motion:
    """Ours from a T-pose to these turns of joints within a second, the left foot in its place on the floor."""
    rotations = torch.eye(3, dtype=torch.float64).repeat(20, 22, 1, 1)
    rotations[:, 0] = torch.from_numpy(UP)
    share = torch.linspace(0, 1, 20, dtype=torch.float64)[:, None]
    for joint, turn in turns.items():
        rotations[:, JOINTS.index(joint)] = axis_angle_to_matrix(share * torch.tensor(turn, dtype=torch.float64))
    body = Skeleton(Skeleton.default().offsets.double())
    hanging = stmc.Motion.posed(rotations, torch.zeros(20, 3, dtype=torch.float64), 20, body)
    return stmc.Motion.posed(rotations, -hanging.joints[:, JOINTS.index("left_foot")], 20, body)


def test_a_foot_that_turns_on_its_toes_leaves_them_where_they_are(character):
    if "left_foot" not in character.rig.joints:
        pytest.skip("it has no toes")
    source = bent()
    toes = source.joints[0, JOINTS.index("left_foot")]
    turns = axis_angle_to_matrix(torch.linspace(0, 0.4, 20, dtype=torch.float64)[:, None] * torch.eye(3)[2])
    rotations = source.rotations.clone()
    rotations[:, 0] = turns @ rotations[:, 0]
    body = Skeleton(Skeleton.default().offsets.double())
    source = stmc.Motion.posed(rotations, toes + (turns @ (source.translation - toes)[..., None])[..., 0], 20, body)
    assert source.joints[:, JOINTS.index("left_ankle")].diff(dim=0).norm(dim=-1).min() > 1e-3, "the heel moves"
    own = places(stmc.retarget(source, character), "left_foot")[:, :2]
    assert (own - own[0]).norm(dim=-1).max() < 1e-4 * character.rig.length(("hip", "knee", "ankle"))


SITTING = {
    f"{side}_{joint}": [turn, 0.0, 0.0] for side in ("left", "right") for joint, turn in (("hip", -1.5), ("knee", 1.5))
}
KICKING = {"right_hip": [-1.8, 0.0, 0.0], "right_knee": [0.4, 0.0, 0.0]}


@pytest.mark.parametrize("turns", [SITTING, KICKING], ids=["sitting", "kicking"])
def test_legs_that_sit_and_kick_point_where_ours_do_above_the_same_floor(character, turns):
    source = bent(**turns)
    moved = stmc.retarget(source, character)
    assert angles(source, moved).mean() < 3
    check_feet(source, moved.motion)


def test_a_motion_of_one_frame_moves_too(character, motion):
    moved = stmc.retarget(motion.trimmed(0, 1), character)
    assert all(moved.content(suffix) for suffix in character.formats)


def test_a_figure_of_our_own_is_the_identity(motion, tmp_path):
    for name in ("ours.glb", "ours.bvh"):
        stmc.write(motion, tmp_path / name)
        moved = stmc.retarget(motion, tmp_path / name)
        for joint in JOINTS[:22]:
            index = moved.character.rig.names.index(joint)
            own = moved.motion.places[:, moved.motion.rig.driven.index(index)]
            assert (own - motion.joints[:, JOINTS.index(joint)]).abs().max() < 1e-4, (name, joint)


def test_the_animation_puts_the_nodes_where_the_rig_is(tmp_path, motion):
    for name in ("lanky.glb", "stocky.glb", "turned.glb"):
        character = stmc.read_character(write(tmp_path, name, RIGS[name]()))
        moved = stmc.retarget(motion, character)
        content = moved.content(".glb")
        for frame in (0, 17, 39):
            world = made.moved(content, frame)
            for place, node in enumerate(character.rig.driven):
                expected = character.standing.turn.T @ moved.motion.places[frame, place].numpy()
                assert np.abs(world[character.rig.names[node]][:3, 3] - expected).max() < 1e-4, (name, frame)


def test_what_is_not_driven_keeps_its_rest_pose_and_the_bvh_says_the_same_as_the_glb(tmp_path, motion):
    character = stmc.read_character(write(tmp_path, "lanky.glb", RIGS["lanky.glb"]()))
    moved = stmc.retarget(motion, character)
    targets = {each["target"]["node"] for each in made.unpacked(moved.content(".glb"))[0]["animations"][0]["channels"]}
    assert targets == {character.body.nodes[node] for node in character.rig.driven}
    moved.write(tmp_path / "out.bvh")
    from stmc.formats.bvh_parser import parse_bvh

    bvh = parse_bvh((tmp_path / "out.bvh").read_text())
    _, positions = bvh.world()
    for frame in (0, 21):
        world = made.moved(moved.content(".glb"), frame)
        for number, name in enumerate(bvh.names):
            node = next(each for each in world if re.sub(r"\s", "_", each) == name)
            assert np.abs(positions[frame, number].numpy() - world[node][:3, 3]).max() < 1e-3, name


def without_animation(content: bytes, given: bytes) -> tuple[dict, bytes, dict, bytes]:
    """The document and the binary of a written file less its first animation, and those of the file it was made of."""
    document, binary = made.unpacked(content)
    first, known = made.unpacked(given)
    document["animations"] = document["animations"][1:]
    if "animations" not in first:
        del document["animations"]
    for name in ("accessors", "bufferViews"):
        document[name] = document[name][: len(first[name])]
    size = document["buffers"][0]["byteLength"] = first["buffers"][0]["byteLength"]
    return document, binary[:size], first, known[:size]


def test_a_file_without_its_animation_is_the_file_it_was_made_of(tmp_path, motion):
    for name in ("lanky.glb", "stocky.glb"):
        path = write(tmp_path, name, RIGS[name]())
        document, binary, first, known = without_animation(
            stmc.retarget(motion, path).content(".glb"), path.read_bytes()
        )
        assert document == first and binary == known


def test_a_file_whose_data_is_in_its_json_is_written_with_it_in_the_binary_chunk(tmp_path, motion):
    import base64

    document, binary = made.document(made.stocky())
    glb = write(tmp_path, "hero.glb", made.packed(document, binary))
    document["buffers"][0]["uri"] = "data:application/octet-stream;base64," + base64.b64encode(binary).decode()
    path = write(tmp_path, "hero.gltf", json.dumps(document))
    assert stmc.retarget(motion, path).content(".glb") == stmc.retarget(motion, glb).content(".glb")


def test_a_driven_matrix_becomes_translation_rotation_and_scale(tmp_path, motion):
    document, binary = made.document(made.stocky(), seed=5)
    content = made.packed(document, binary)
    from scipy.spatial.transform import Rotation

    for node in document["nodes"][:-2]:
        matrix = np.eye(4)
        matrix[:3, :3] = Rotation.from_quat(node.pop("rotation")).as_matrix()
        matrix[:3, 3] = node.pop("translation")
        node["matrix"] = matrix.T.ravel().tolist()
    first = stmc.retarget(motion, write(tmp_path, "trs.glb", content)).content(".glb")
    second = stmc.retarget(motion, write(tmp_path, "matrix.glb", made.packed(document, binary))).content(".glb")
    for name, matrix in made.moved(first, 11).items():
        assert np.abs(matrix - made.moved(second, 11)[name]).max() < 1e-5, name


def humanoid(document: dict, names: dict[str, str], version: int) -> dict:
    """The document with VRM's humanoid map, of bones to nodes' names."""
    nodes = {node.get("name"): number for number, node in enumerate(document["nodes"])}
    if version == 1:
        bones = {bone: {"node": nodes[name]} for bone, name in names.items()}
        extension = {"VRMC_vrm": {"specVersion": "1.0", "humanoid": {"humanBones": bones}}}
    else:
        bones = [{"bone": bone, "node": nodes[name]} for bone, name in names.items()]
        extension = {"VRM": {"humanoid": {"humanBones": bones}}}
    return document | {"extensions": extension, "extensionsUsed": list(extension)}


@pytest.mark.parametrize("version", [0, 1])
def test_a_vrm_is_read_by_its_humanoid_map_whatever_its_joints_are_called(version, tmp_path, motion):
    bones = made.stocky()
    bones.names = [f"j{number}" for number in range(len(bones.names))]
    document, binary = made.document(bones)
    joints = ["hips", "spine", "head"]
    for side in ("left", "right"):
        joints += [f"{side}{bone}" for bone in ("UpperArm", "LowerArm", "Hand", "UpperLeg", "LowerLeg", "Foot")]
    document = humanoid(document, {bone: f"j{number}" for number, bone in enumerate(joints)}, version)
    character = stmc.read_character(write(tmp_path, "hero.vrm", made.packed(document, binary)))
    assert character.found_by == "VRM's humanoid map" and character.joint_map["left_knee"] == "j7"
    stmc.retarget(motion, character).write(tmp_path / "out.vrm")
    assert made.unpacked((tmp_path / "out.vrm").read_bytes())[0]["extensions"] == document["extensions"]


def test_a_vrm_animation_has_a_t_pose_and_its_turns_give_the_directions_of_ours(tmp_path, motion):
    character = stmc.read_character(write(tmp_path, "lanky.glb", RIGS["lanky.glb"]()))
    content = stmc.retarget(motion, character).content(".vrma")
    document = made.unpacked(content)[0]
    bones = document["extensions"]["VRMC_vrm_animation"]["humanoid"]["humanBones"]
    assert {"hips", "spine", "chest", "upperChest", "neck", "head", "leftToes", "rightHand"} <= set(bones)
    arms = [document["nodes"][bones[name]["node"]]["translation"] for name in ("leftLowerArm", "rightHand")]
    assert np.abs(normalized(np.array(arms)) - [[1, 0, 0], [-1, 0, 0]]).max() < 1e-3
    world = made.moved(content, 13)
    joints = motion.joints[13].numpy()
    for above, below, *names in (
        ("leftUpperArm", "leftLowerArm", "left_shoulder", "left_elbow"),
        ("rightLowerArm", "rightHand", "right_elbow", "right_wrist"),
    ):
        own = normalized(UP @ (world[below] - world[above])[:3, 3])
        ours = normalized(joints[JOINTS.index(names[1])] - joints[JOINTS.index(names[0])])
        assert own @ ours > np.cos(np.radians(0.5))


def normalized(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


@pytest.mark.parametrize(
    "name, expected",
    [
        ("mixamorig:LeftUpLeg", ("left", "upleg")),
        ("mixamorigRightForeArm", ("right", "forearm")),
        ("DEF-upper_arm.L", ("left", "upperarm")),
        ("DEF-upper_arm.L.001", ("left", "upperarm001")),
        ("upperarm_l", ("left", "upperarm")),
        ("Bip01 R Toe0", ("right", "toe0")),
        ("CC_Base_L_Thigh", ("left", "thigh")),
        ("J_Bip_L_UpperLeg", ("left", "upperleg")),
        ("ValveBiped.Bip01_R_Calf", ("right", "calf")),
        ("lShldrBend", ("left", "shldrbend")),
        ("rThighTwist", ("right", "thightwist")),
        ("lhumerus", ("left", "humerus")),
        ("upperleg01.R", ("right", "upperleg01")),
        ("LeftHand", ("left", "hand")),
        ("left_hip", ("left", "hip")),
        ("Head", (None, "head")),
        ("pelvis", (None, "pelvis")),
        ("UpperArm_L", ("left", "upperarm")),
    ],
)
def test_names_are_taken_apart(name, expected):
    assert taken_apart(name) == expected


def renamed(bones: made.Bones) -> made.Bones:
    bones.names = [f"b{number}" for number in range(len(bones.names))]
    return bones


@pytest.mark.parametrize("build", [made.lanky, made.stocky])
def test_a_rig_without_names_is_told_by_its_shape(build, tmp_path):
    named = stmc.read_character(write(tmp_path, "named.glb", made.glb(build())))
    unnamed = stmc.read_character(write(tmp_path, "unnamed.glb", made.glb(renamed(build()))))
    assert unnamed.found_by == "the rig's shape"
    assert {joint: int(name[1:]) for joint, name in unnamed.joint_map.items()} == {
        joint: build().names.index(name) for joint, name in named.joint_map.items()
    }


def test_a_joint_map_corrects_and_its_mistakes_are_named(tmp_path):
    path = write(tmp_path, "lanky.glb", RIGS["lanky.glb"]())
    map_path = write(tmp_path, "map.yaml", "left_elbow: DEF-upper_arm.L.001\nleft_foot: null\n")
    corrected = stmc.read_character(path, map_path)
    assert corrected.joint_map["left_elbow"] == "DEF-upper_arm.L.001" and "left_foot" not in corrected.joint_map
    for corrections, said in (
        (
            {"left_elbow": "elbow"},
            "joint map: left_elbow is 'elbow', but the file's joints are Armature, root",
        ),
        ({"left_ellbow": "elbow"}, "joint map: 'left_ellbow' is not a joint of SMPL; choose from pelvis, head"),
        ({"left_elbow": "DEF-shin.L"}, "'DEF-shin.L' cannot be both left_elbow and left_knee"),
        ({"left_knee": None}, "no joint was found for left_knee"),
    ):
        with pytest.raises(CharacterError, match=re.escape(said)):
            stmc.read_character(path, corrections)


def test_a_character_of_a_stranger_moves_and_its_file_is_kept(stranger, motion, touching):
    character = stmc.read_character(stranger)
    moved = stmc.retarget(motion, character)
    document, binary, first, known = without_animation(moved.content(".glb"), stranger.read_bytes())
    assert document == first and binary == known
    assert angles(motion, moved).mean() < 5
    check_feet(motion, moved.motion)
    at_head = stmc.retarget(touching, character)
    own = (places(at_head, "left_wrist") - places(at_head, "head")).norm(dim=-1) / arm(character.rig)
    assert float(own[-1]) == pytest.approx(0.377, abs=0.1)


def test_the_pictures_of_the_docs_show_the_nodes_where_the_written_file_has_them(tmp_path, motion):
    matrices = runpy.run_path(str(DOCS / "characters.py"))["node_matrices"]
    moved = stmc.retarget(motion.trimmed(0, 8), write(tmp_path, "a.glb", RIGS["stocky.glb"]()))
    content = moved.content(".glb")
    names = [node["name"] for node in made.unpacked(content)[0]["nodes"]]
    drawn = matrices(moved)[7]
    for name, matrix in made.moved(content, 7).items():
        assert np.abs(drawn[names.index(name)] - matrix).max() < 1e-5, name


def test_other_endings_and_other_files_are_refused(tmp_path, motion):
    path = write(tmp_path, "lanky.glb", RIGS["lanky.glb"]())
    with pytest.raises(CharacterError, match=r"choose from \.glb, \.vrma, \.bvh"):
        stmc.retarget(motion, path).write(tmp_path / "out.fbx")
    with pytest.raises(CharacterError, match=r"cannot read a character from a '\.fbx' file; choose from \.glb, \.gltf"):
        stmc.read_character(tmp_path / "hero.fbx")
