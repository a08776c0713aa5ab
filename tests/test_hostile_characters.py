"""Character files that are damaged or hostile: refused in one sentence that says what is missing, soon and small."""

import json
import random
import struct
import time
import tracemalloc
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from fuzz import mutated
from helpers import characters as made

import stmc
from stmc.formats.characters import CharacterError

LONGEST = 300


def refused(path: Path, content: bytes | str, joint_map=None) -> str:
    """The sentence with which a file is refused, without its name."""
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    with pytest.raises(CharacterError) as caught:
        stmc.read_character(path, joint_map)
    message = str(caught.value)
    assert message.startswith(f"{path}: ") and "\n" not in message and len(message) < LONGEST + len(str(path))
    return message.removeprefix(f"{path}: ")


def _without_skin(document: dict) -> None:
    del document["skins"]
    for node in document["nodes"]:
        node.pop("skin", None)


def _second_skeleton(document: dict) -> None:
    count = len(document["nodes"])
    document["nodes"] += [{"name": "other armature", "children": [count + 1]}, {"name": "other hips"}]
    document["scenes"][0]["nodes"].append(count)
    document["skins"].append({"name": "other", "joints": [count + 1]})


def _cycle(document: dict) -> None:
    document["nodes"][-2]["children"] = []
    document["nodes"][3].setdefault("children", []).append(0)


def _many_vertices(document: dict) -> None:
    document["accessors"][0]["count"] = 10_000_000


def _external(document: dict) -> None:
    document["buffers"][0]["uri"] = "hero.bin"


def _cut_base64(document: dict) -> None:
    document["buffers"][0]["uri"] = "data:application/octet-stream;base64,AAAA"


def _no_base64(document: dict) -> None:
    document["buffers"][0]["uri"] = "data:application/octet-stream;base64,\u00e4"


def _external_image(document: dict) -> None:
    document["images"] = [{"uri": "skin.png"}]


def _draco(document: dict) -> None:
    document["extensionsUsed"] = document["extensionsRequired"] = ["KHR_draco_mesh_compression"]


def _meshopt(document: dict) -> None:
    document["extensionsUsed"] = ["EXT_meshopt_compression"]


def _no_bones(document: dict) -> None:
    document["skins"][0]["joints"] = []


def _two_parents(document: dict) -> None:
    document["nodes"][0]["children"].append(6)


def _zero_bone(document: dict) -> None:
    next(node for node in document["nodes"] if node["name"] == "mixamorig:LeftForeArm")["translation"] = [0, 0, 0]


def _uneven(document: dict) -> None:
    document["nodes"][1]["scale"] = [1, 2, 1]


def _mirrored(document: dict) -> None:
    document["nodes"][1]["scale"] = [-1, 1, 1]


def _no_rotation(document: dict) -> None:
    document["nodes"][1]["rotation"] = [0, 0, 0, 0]


def _lying(document: dict) -> None:
    document["nodes"][-2]["rotation"] = [0.7071068, 0, 0, 0.7071068]


def _nameless(document: dict) -> None:
    for node in document["nodes"]:
        node.pop("name", None)
    document["nodes"][0]["children"] = document["nodes"][0]["children"][:2]


def _huge(document: dict) -> None:
    document["nodes"][1]["translation"] = [1e30, 0, 0]


def _deep(document: dict) -> None:
    count = len(document["nodes"])
    document["nodes"] += [{"children": [count + number + 1]} for number in range(600)]
    document["nodes"][-1]["children"] = [0]
    document["nodes"][count - 2]["children"] = [count]


BAD: dict[Callable[[dict], None], str] = {
    _without_skin: "it has no skin: a mesh without bones cannot be animated; rig it first",
    _second_skeleton: "it has two skeletons, 'skin 0' and 'other': keep one character",
    _cycle: "its nodes form a cycle",
    _many_vertices: "it has 10000000 vertices, more than 2,000,000, the limit",
    _external: "buffers[0] is in another file, 'hero.bin': export the character as one file, glTF Binary (.glb)",
    _cut_base64: "buffers[0] should be ",
    _no_base64: "buffers[0] should be ",
    _external_image: "images[0] is in another file, 'skin.png': export the character as one file, glTF Binary (.glb)",
    _draco: "its meshes are compressed (KHR_draco_mesh_compression): export it without compression",
    _meshopt: "its meshes are compressed (EXT_meshopt_compression): export it without compression",
    _no_bones: "skins[0] has no joints, so that it has no bones",
    _two_parents: "nodes[6] has two parents or is its own: nodes must be trees",
    _zero_bone: "left_elbow is where left_shoulder is: the bone between them has no length",
    _uneven: "nodes[1] is scaled unevenly, by [1.0, 2.0, 1.0]: apply its scale first",
    _mirrored: "the scale of nodes[1] is [-1.0, 1.0, 1.0]: it must be positive",
    _no_rotation: "the rotation of nodes[1] is [0.0, 0.0, 0.0, 0.0], which is not a rotation",
    _lying: "it does not stand along the y axis, which is up in glTF: turn it and apply the rotation",
    _nameless: "no joint was found for head, left_hip",
    _huge: "the translation of nodes[1] has 1e+30, which is not a number up to 1e+06",
    _deep: "its joints hang more than 500 nodes deep",
}


@pytest.mark.parametrize("spoil", BAD, ids=lambda spoil: spoil.__name__)
def test_a_bad_file_is_refused_in_a_sentence_that_says_why(spoil, tmp_path):
    document, binary = made.document(made.stocky())
    spoil(document)
    assert refused(tmp_path / "hero.glb", made.packed(document, binary)).startswith(BAD[spoil])


def test_files_that_are_no_gltf_are_refused(tmp_path):
    path, good = tmp_path / "hero.glb", made.glb(made.stocky())
    for content, said in (
        (b"", "line 1, column 1: not JSON"),
        (b"\xff\xfe\x00", "neither a glTF file nor JSON"),
        (good[:16], "the file ends within its header"),
        (good[:-7], f"the file has {len(good) - 7} bytes, but its header says {len(good)}: it is cut or damaged"),
        (good[:4] + struct.pack("<I", 1) + good[8:], "a glTF of version 1; only version 2 is read"),
        (made.packed("[]"), "its JSON is not an object"),
        (made.packed('{"asset": {"version": "2.0"}, "a": 1, "a": 2}'), "the key 'a' is duplicated"),
        (made.packed('{"asset": {"version": "2.0"}, "nodes": [{"weights": [NaN]}]}'), "its JSON has a number"),
        (made.packed('{"asset": {"version": "2.0"}, "nodes": [{"weights": [1e999]}]}'), "its JSON has a number"),
        (made.packed("[" * 100_000), "not JSON that can be read"),
        (made.packed('{"asset": {"version": "2.0"}}'), "it has no skin"),
    ):
        assert refused(path, content).startswith(said)
    with pytest.raises(CharacterError, match="a directory, not a file"):
        path.unlink()
        path.mkdir()
        stmc.read_character(path)


def test_a_bvh_that_is_none_and_a_joint_map_that_is_none_are_refused(tmp_path):
    good = made.bvh(made.stocky())
    assert refused(tmp_path / "a.bvh", good.replace("MOTION", "")).startswith("no MOTION section")
    stick = made.Bones(["hip", "knee"], [-1, 0], [np.zeros(3), np.array([0.0, -1.0, 0.0])])
    assert refused(tmp_path / "b.bvh", made.bvh(stick)).startswith("no joint was found for head, left_hip")
    lying = good.replace("OFFSET 0.000000 15.000000 0.000000", "OFFSET 0.000000 0.000000 -150.000000")
    assert refused(tmp_path / "c.bvh", lying).startswith("its rest pose does not stand upright")
    hero = tmp_path / "hero.glb"
    hero.write_bytes(made.glb(made.stocky()))
    for text in ("- a\n- b\n", "{", "a: &a [*a]", "x" * 100_000, "left_knee: [1]"):
        path = tmp_path / "map.yaml"
        path.write_text(text)
        with pytest.raises(CharacterError):
            stmc.read_character(hero, path)


def try_mutated(folder: Path, count: int, seed: int) -> None:
    """Damaged characters are moved, or refused by name, each within two seconds and 64 MiB."""
    rng = random.Random(seed)
    rotations = torch.eye(3).repeat(2, 22, 1, 1)
    motion = stmc.Motion.posed(rotations, torch.tensor([[0.0, 0.0, 0.9]]).repeat(2, 1), 20, stmc.Skeleton.default())
    good = {
        "lanky.glb": made.glb(made.lanky(), seed=3),
        "stocky.glb": made.glb(made.stocky(), scale=0.01),
        "stocky.gltf": json.dumps(_whole(made.stocky())).encode(),
        "lanky.bvh": made.bvh(made.lanky()).encode(),
    }
    read = 0
    tracemalloc.start()
    for number in range(count):
        name = list(good)[number % len(good)]
        path, content = folder / name, _damaged(name, good[name], rng)
        path.write_bytes(content)
        tracemalloc.reset_peak()
        began = time.process_time()
        try:
            moved = stmc.retarget(motion, path)
            for suffix in moved.character.formats:
                moved.content(suffix)
            read += 1
        except CharacterError as error:
            assert str(error).startswith(f"{path}: ") or "frames" in str(error) or "spine" in str(error), error
            assert len(str(error)) < LONGEST + len(str(path)), error
        assert time.process_time() - began < 2, number
        assert tracemalloc.get_traced_memory()[1] < 2**26, number
    tracemalloc.stop()
    assert 0 < read < count


def _damaged(name: str, content: bytes, rng: random.Random) -> bytes:
    """Damaged bytes; of a `.glb` half of the time the JSON alone, in a container that is whole."""
    if name.endswith(".glb") and rng.random() < 0.5:
        size = struct.unpack_from("<I", content, 12)[0]
        text = mutated(content[20 : 20 + size], rng)
        return made.packed(text.decode("latin1"), content[28 + size :])
    return mutated(content, rng)


def _whole(bones: made.Bones) -> dict:
    import base64

    document, binary = made.document(bones)
    document["buffers"][0]["uri"] = "data:application/octet-stream;base64," + base64.b64encode(binary).decode()
    return document


def test_damaged_characters_are_moved_or_refused_by_name(tmp_path):
    try_mutated(tmp_path, count=80, seed=0)


@pytest.mark.slow
def test_five_hundred_damaged_characters_are_moved_or_refused_by_name(tmp_path):
    try_mutated(tmp_path, count=500, seed=1)
