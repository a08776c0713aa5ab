"""A .glb is read by an oracle written from glTF's specification, and by trimesh."""

import json
import math
import struct

import numpy as np
import pytest
import trimesh
from helpers.motions import walking
from scipy.spatial.transform import Rotation

from stmc.formats import write
from stmc.motion.body import JOINTS, BodyPart
from stmc.motion.body_model import Skeleton
from stmc.motion.motion import Motion
from stmc.motion.skins import build_mannequin
from stmc.timeline import Timeline

Z_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
TIMELINE = Timeline.parse("walk # 0 # 2 # legs\nwave “hello” # 0.5 # 1.5 # right arm")


class Glb:
    """Nodes, skin and animation, as the specification has them: slow, one vertex and one key at a time."""

    def __init__(self, content: bytes) -> None:
        magic, version, length = struct.unpack("<4sII", content[:12])
        assert (magic, version, length) == (b"glTF", 2, len(content))
        chunks, place = {}, 12
        while place < length:
            size, kind = struct.unpack("<I4s", content[place : place + 8])
            assert size % 4 == 0
            chunks[kind] = content[place + 8 : place + 8 + size]
            place += 8 + size
        self.json, self.binary = json.loads(chunks[b"JSON"]), chunks[b"BIN\0"]

    def array(self, index: int) -> np.ndarray:
        accessor = self.json["accessors"][index]
        view = self.json["bufferViews"][accessor["bufferView"]]
        kind = {5126: "<f4", 5123: "<u2", 5121: "u1"}[accessor["componentType"]]
        width = {"SCALAR": 1, "VEC3": 3, "VEC4": 4, "MAT4": 16}[accessor["type"]]
        assert view["byteLength"] == accessor["count"] * width * np.dtype(kind).itemsize
        values = np.frombuffer(self.binary, kind, accessor["count"] * width, view["byteOffset"])
        return values.reshape(accessor["count"], width)

    def globals(self, frame: int | None) -> list[np.ndarray]:
        """Every node's matrix to the world; without a frame, at rest."""
        local = []
        for node in self.json["nodes"]:
            local.append({"translation": node.get("translation", [0, 0, 0]), "rotation": [0, 0, 0, 1]})
        [animation] = self.json["animations"]
        for channel in animation["channels"] if frame is not None else []:
            sampler = animation["samplers"][channel["sampler"]]
            local[channel["target"]["node"]][channel["target"]["path"]] = self.array(sampler["output"])[frame]
        matrices = [np.eye(4) for _ in local]
        for matrix, parts in zip(matrices, local, strict=True):
            matrix[:3, :3] = Rotation.from_quat(parts["rotation"]).as_matrix()
            matrix[:3, 3] = parts["translation"]
        result: list[np.ndarray | None] = [None] * len(local)

        def place(node: int, above: np.ndarray) -> None:
            result[node] = above @ matrices[node]
            for child in self.json["nodes"][node].get("children", []):
                place(child, result[node])

        for root in self.json["scenes"][self.json["scene"]]["nodes"]:
            place(root, np.eye(4))
        return result

    def skinned(self, frame: int, every: int = 97) -> np.ndarray:
        [skin] = self.json["skins"]
        inverse = self.array(skin["inverseBindMatrices"]).reshape(-1, 4, 4).swapaxes(1, 2)
        world = self.globals(frame)
        joints = [world[node] @ bind for node, bind in zip(skin["joints"], inverse, strict=True)]
        names = self.json["meshes"][0]["primitives"][0]["attributes"]
        columns = [self.array(names[name])[::every] for name in ("POSITION", "JOINTS_0", "WEIGHTS_0")]
        return np.array(
            [
                sum(weight * (joints[joint] @ [*point, 1.0]) for joint, weight in zip(carried, weights, strict=True))[
                    :3
                ]
                for point, carried, weights in zip(*columns, strict=True)
            ]
        )


@pytest.fixture(scope="module")
def motion() -> Motion:
    return walking(seconds=2.0)


@pytest.fixture(scope="module")
def path(motion, tmp_path_factory):
    path = tmp_path_factory.mktemp("glb") / "walk.glb"
    write(motion, path, timeline=TIMELINE)
    return path


@pytest.fixture(scope="module")
def glb(path) -> Glb:
    return Glb(path.read_bytes())


def test_the_nodes_of_a_glb_are_where_the_joints_are(glb, motion):
    names = [glb.json["nodes"][node]["name"] for node in glb.json["skins"][0]["joints"]]
    assert names == list(JOINTS)
    for frame in (0, 13, motion.frames - 1):
        placed = glb.globals(frame)
        joints = np.array([Z_UP @ placed[node][:3, 3] for node in glb.json["skins"][0]["joints"]])
        assert np.abs(joints - motion.joints[frame].numpy()).max() < 1e-5


def test_the_skin_of_a_glb_is_the_mannequin_s(glb, motion):
    frames = [0, 21]
    skin = build_mannequin(Skeleton.default())
    shown = Motion(motion.rotations[frames], motion.translation[frames], motion.joints[frames], motion.fps)
    for frame, expected in zip(frames, skin.posed(shown), strict=True):
        assert np.abs(glb.skinned(frame) @ Z_UP.T - expected[::97]).max() < 1e-4


def test_a_glb_rests_in_a_t_pose_and_its_bind_matrices_undo_it(glb):
    rest = Skeleton.default().rest.numpy()
    for joint, place in enumerate(glb.globals(None)[: len(JOINTS)]):
        assert np.abs(place[:3, 3] - rest[joint]).max() < 1e-5
    inverse = glb.array(glb.json["skins"][0]["inverseBindMatrices"]).reshape(-1, 4, 4)
    assert np.abs(inverse[:, 3, :3] + rest).max() < 1e-6


def test_the_quaternions_of_a_glb_take_the_short_way_and_its_times_are_the_frames(glb, motion):
    [animation] = glb.json["animations"]
    for channel in animation["channels"]:
        values = glb.array(animation["samplers"][channel["sampler"]]["output"])
        assert len(values) == motion.frames
        if channel["target"]["path"] == "rotation":
            assert (values[1:] * values[:-1]).sum(axis=1).min() > 0
    times = glb.array(animation["samplers"][0]["input"])[:, 0]
    assert times == pytest.approx(np.arange(motion.frames) / motion.fps)


def test_weights_sum_to_one_and_every_body_part_has_its_material(glb):
    primitives = glb.json["meshes"][0]["primitives"]
    assert np.abs(glb.array(primitives[0]["attributes"]["WEIGHTS_0"]).sum(axis=1) - 1).max() < 1e-6
    names = [glb.json["materials"][piece["material"]]["name"] for piece in primitives]
    assert names == [str(part) for part in BodyPart]
    count = sum(len(glb.array(piece["indices"])) for piece in primitives)
    assert count == build_mannequin(Skeleton.default()).faces.size


def test_the_timeline_goes_along_and_another_frame_rate_too(glb, motion, tmp_path):
    assert glb.json["scenes"][0]["extras"] == {"fps": 20.0, "timeline": json.loads(TIMELINE.to_json())}
    write(motion, tmp_path / "walk.glb", fps=50)
    other = Glb((tmp_path / "walk.glb").read_bytes())
    assert other.json["scenes"][0]["extras"] == {"fps": 50}
    assert other.json["accessors"][other.json["animations"][0]["samplers"][0]["input"]]["count"] == motion.frames * 2.5


def test_trimesh_opens_a_glb_and_finds_a_person(path):
    scene = trimesh.load(path)
    assert len(scene.geometry) == len(BodyPart)
    low, high = scene.bounds
    assert 1.4 < high[1] - low[1] < 2.0


def test_pygltflib_opens_a_glb(path):
    pygltflib = pytest.importorskip("pygltflib")
    document = pygltflib.GLTF2().load(str(path))
    assert len(document.skins[0].joints) == len(JOINTS)
    assert len(document.binary_blob()) == document.buffers[0].byteLength


def test_a_body_of_other_proportions_is_written_with_its_own_bones(motion, tmp_path):
    tall = Skeleton(Skeleton.default().offsets.double() * 1.25)
    write(Motion.posed(motion.rotations, motion.translation, motion.fps, tall), tmp_path / "tall.glb")
    nodes = Glb((tmp_path / "tall.glb").read_bytes()).json["nodes"]
    assert math.dist(nodes[JOINTS.index("left_knee")]["translation"], (0, 0, 0)) == pytest.approx(
        0.3908 * 1.25, abs=1e-4
    )
