"""Characters of users in the studio: what its server takes and refuses, how they move, and that they are kept."""

import json
import os
import random
from collections.abc import Iterator

import numpy as np
import pytest
from conftest import data_file
from fuzz import mutated
from helpers import characters as figures
from helpers.motions import walking
from helpers.studio import knowing, studio
from starlette.testclient import TestClient
from test_characters import humanoid

import stmc
from stmc.motion.body import JOINTS, BodyPart
from stmc.viewing.studio import Characters, character_storage, storage
from stmc.viewing.studio.inputs_outputs import MOST_UPLOAD
from stmc.viewing.studio.request_errors import RequestError

HERO = figures.glb(figures.stocky())


@pytest.fixture(scope="module")
def model() -> stmc.Model:
    return knowing()


@pytest.fixture(scope="module")
def client(model, tmp_path_factory) -> Iterator[TestClient]:
    with studio(model, tmp_path_factory.mktemp("studio")) as client:
        yield client


@pytest.fixture(scope="module")
def walk(client, tmp_path_factory) -> str:
    """The name of a stored motion."""
    path = tmp_path_factory.mktemp("motion") / "walk.npz"
    stmc.write(walking(seconds=1.0), path)
    return client.post("/api/motions", content=path.read_bytes()).json()["motion"]["id"]


def added(client: TestClient, content: bytes, name: str = "hero.glb"):
    return client.post("/api/characters", content=content, headers={"X-Filename": name})


def told(answer) -> dict:
    assert answer.status_code == 201, answer.text
    return answer.json()["character"]


AVATAR = ["hips", "spine", "head"]
for _side in ("left", "right"):
    AVATAR += [f"{_side}{bone}" for bone in ("UpperArm", "LowerArm", "Hand", "UpperLeg", "LowerLeg", "Foot")]


def formats(character: dict) -> list[str]:
    return [each["name"] for each in character["formats"]]


# Storage


def test_a_character_is_stored_once_listed_sent_as_it_came_and_deleted(client):
    hero = told(added(client, HERO, "My%20hero.glb"))
    assert hero["name"] == "My hero" and formats(hero)[:3] == ["glb", "vrma", "bvh"]
    assert {"npz", "html"} < set(formats(hero)) and len(set(formats(hero))) == len(formats(hero))
    assert told(added(client, HERO, "hero.glb"))["id"] == hero["id"], "the same bytes are the same character"
    listed = client.get("/api/characters").json()["characters"]
    assert [each["id"] for each in listed].count(hero["id"]) == 1
    assert client.get(f"/api/characters/{hero['id']}").content == HERO
    assert client.delete(f"/api/characters/{hero['id']}").status_code == 200
    answer = client.get(f"/api/characters/{hero['id']}")
    assert answer.status_code == 404 and "add its file again" in answer.json()["error"]


def test_characters_outlive_the_server_in_files_that_nobody_else_can_read(tmp_path):
    name = Characters(tmp_path / "characters").receive(HERO, "hero.glb")
    (tmp_path / "characters" / f"{'0' * 32}.glb").write_bytes(HERO)  # of a process that was killed
    (tmp_path / "characters" / "damaged.json").write_text("[]")
    again = Characters(tmp_path / "characters")
    assert [each["id"] for each in again.all()] == [name]
    assert again.get(name).joint_map["left_knee"] == "mixamorig:LeftLeg"
    modes = {path.name: path.stat().st_mode & 0o077 for path in (tmp_path / "characters").glob(f"{name}*")}
    assert modes == {f"{name}.glb": 0, f"{name}.json": 0}
    assert not list((tmp_path / "characters").glob("0*"))


def test_characters_are_bounded_in_number_and_bytes(tmp_path, monkeypatch):
    characters = Characters(tmp_path)
    monkeypatch.setattr(character_storage, "MOST_CHARACTERS", 2)
    names = [characters.receive(figures.glb(figures.stocky(), seed=seed), "a.glb") for seed in (1, 2)]
    with pytest.raises(RequestError, match="there are 2 characters; delete some") as caught:
        characters.receive(HERO, "b.glb")
    assert caught.value.status == 507
    characters.receive(figures.glb(figures.stocky(), seed=1), "again.glb")  # one that is there needs no room
    characters.delete(names[0])
    monkeypatch.setattr(character_storage, "MOST_CHARACTER_BYTES", len(HERO))
    with pytest.raises(RequestError, match="larger than"):
        characters.receive(HERO, "b.glb")


# Hostile files


def _changed(change) -> bytes:
    document, binary = figures.document(figures.stocky())
    change(document)
    return figures.packed(document, binary)


@pytest.mark.parametrize(
    ("content", "name", "message"),
    [
        (HERO[:-100], "hero.glb", "cut or damaged"),
        (b"", "hero.glb", "not JSON"),
        (_changed(lambda document: document.pop("skins")), "hero.glb", "it has no skin"),
        (_changed(lambda document: document["accessors"][0].update(count=10**9)), "hero.glb", "vertices, more than"),
        (_changed(lambda document: document["buffers"][0].update(uri="http://a/b")), "a.glb", "in another file"),
        (
            _changed(lambda document: document.update(extensionsUsed=["KHR_draco_mesh_compression"])),
            "a.glb",
            "compressed",
        ),
        (_changed(lambda document: document["nodes"].__setitem__(0, {})), "a.glb", "does not stand upright"),
        (HERO, "hero.exe", "must be a .glb, a .gltf or a .vrm file"),
        (HERO, "", "must be a .glb"),
        (HERO, "..%2F..%2Fetc%00.bvh", "the studio shows no skeletons"),
        (b"HIERARCHY", "hero.bvh", "`stmc sample timeline.json outputs/ character=hero.bvh`"),
        (b"<robot/>", "G1%20%60rm%60.URDF", "outputs/ character='G1 `rm`.URDF'`"),
        (b"<mujoco/>", "robot.xml", "`stmc sample timeline.json outputs/ character=robot.xml`"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_a_file_that_is_no_character_is_refused_in_a_sentence(client, content, name, message):
    answer = added(client, content, name)
    assert answer.status_code == 422
    error = answer.json()["error"]
    assert message in error and "/tmp" not in error and "\n" not in error and len(error) < 400


def test_an_upload_is_bounded_and_needs_the_key(client):
    assert added(client, b"glTF" + bytes(MOST_UPLOAD)).status_code == 413
    for headers, status in (({"Authorization": ""}, 401), ({"Origin": "http://evil.example"}, 403)):
        paths = [("POST", ""), ("GET", ""), ("GET", "/a"), ("DELETE", "/a"), ("GET", "/a/poses/b")]
        for method, path in (*paths, ("GET", "/a/joint_map"), ("PUT", "/a/joint_map")):
            assert client.request(method, f"/api/characters{path}", headers=headers).status_code == status


@pytest.mark.parametrize(
    "path",
    ["a", "..%2Fdocuments%2Fa", "%00", "x" * 60, "a/poses/b", f"{'0' * 32}/poses/b", f"{'0' * 32}/joint_map"],
)
def test_what_is_no_character_is_not_found(client, path):
    assert client.get(f"/api/characters/{path}").status_code == 404


def test_mutated_files_are_taken_or_refused_and_what_is_taken_can_be_exported(client, walk):
    chance, taken = random.Random(1), 0
    for _ in range(60):
        answer = added(client, mutated(HERO, chance))
        assert answer.status_code in (201, 422), answer.text
        if answer.status_code == 201:
            taken += 1
            name = told(answer)["id"]
            settings = {"character": json.dumps(name)}
            assert client.get(f"/api/motions/{walk}.glb", params=settings).status_code in (200, 422)
            assert client.get(f"/api/characters/{name}/poses/{walk}").status_code in (200, 422)
            client.delete(f"/api/characters/{name}")
    assert 0 < taken < 60


def test_no_title_is_longer_than_its_bound_or_holds_what_cannot_be_printed(client):
    assert told(added(client, HERO, f"{'a' * 3000}%00%1b%0a.glb"))["name"] == "a" * 60
    assert told(added(client, HERO, "%E2%80%AE.glb"))["name"] == "character"


# Motions on characters


def test_poses_move_the_nodes_of_the_file_as_the_export_does_and_have_our_joints(client, walk):
    hero = told(added(client, figures.glb(figures.lanky(), seed=3, scale=0.01, yaw=np.pi)))["id"]
    answer = client.get(f"/api/characters/{hero}/poses/{walk}")
    assert answer.status_code == 200 and len(answer.content) < 60_000
    document, _ = figures.unpacked(answer.content)
    file = figures.unpacked(client.get(f"/api/characters/{hero}").content)[0]
    exported = client.get(f"/api/motions/{walk}.glb", params={"character": json.dumps(hero)}).content
    poses, whole = figures.moved(answer.content, 7), figures.moved(exported, 7)
    parts = {
        file["nodes"][int(each["name"][1:])]["name"]: each["extras"]["part"]
        for each in document["nodes"]
        if "extras" in each
    }
    assert parts["DEF-hand.L"] == BodyPart.LEFT_ARM and parts["DEF-spine.003"] == BodyPart.SPINE
    assert parts["DEF-neck"] == BodyPart.HEAD and parts["DEF-hips"] == BodyPart.LEGS
    stage, ours = poses["stage"], walking(seconds=1.0).joints[7].numpy()
    for joint in ("left_wrist", "right_foot", "pelvis"):
        x, y, z = poses[joint][:3, 3]
        np.testing.assert_allclose((x, -z, y), ours[JOINTS.index(joint)], atol=1e-5)
    feet = [(stage @ whole[f"DEF-foot.{side}"])[:3, 3] for side in "LR"]
    for place, joint in zip(feet, ("left_ankle", "right_ankle"), strict=True):
        x, y, z = place
        assert np.linalg.norm(np.array([x, -z, y]) - ours[JOINTS.index(joint)]) < 0.15, (
            "on the stage it is as large as we are"
        )


def test_exports_are_of_the_character_where_it_is_shown_and_of_our_body_elsewhere(client, walk):
    hero = told(added(client, HERO))["id"]

    def exported(kind: str, **settings) -> bytes:
        answer = client.get(f"/api/motions/{walk}.{kind}", params={"character": json.dumps(hero)} | settings)
        assert answer.status_code == 200 and f"motion.{kind}" in answer.headers["content-disposition"], answer.text
        return answer.content

    document = figures.unpacked(exported("glb"))[0]
    assert document["asset"]["generator"] == "a stranger" and document["animations"][0]["name"] == "motion"
    times = document["accessors"][document["animations"][0]["samplers"][0]["input"]]
    assert times["count"] == 20
    times = figures.unpacked(exported("glb", fps="50"))[0]
    assert times["accessors"][times["animations"][0]["samplers"][0]["input"]]["count"] == 50
    assert b"mixamorig:LeftLeg" in exported("bvh") and b"VRMC_vrm_animation" in exported("vrma")
    assert exported("npz").startswith(b"PK")
    assert client.get(f"/api/motions/{walk}.vrm", params={"character": json.dumps(hero)}).status_code == 404
    assert client.get(f"/api/motions/{walk}.vrma").status_code == 404, "our body has no avatar's format"
    assert client.get(f"/api/motions/{walk}.glb", params={"character": '"gone"'}).status_code == 404


def test_an_avatar_is_exported_as_one_with_what_its_file_says_of_it(client, walk):
    document, binary = figures.document(figures.stocky())
    nodes = dict(zip(AVATAR, (node["name"] for node in document["nodes"]), strict=False))
    document = humanoid(document, nodes, version=0)
    hero = told(added(client, figures.packed(document, binary), "hero.vrm"))
    assert formats(hero)[:4] == ["glb", "vrm", "vrma", "bvh"]
    assert [each["name"] for each in hero["formats"] if each["character"]] == ["glb", "vrm", "vrma", "bvh"]
    content = client.get(f"/api/motions/{walk}.vrm", params={"character": json.dumps(hero["id"])}).content
    assert figures.unpacked(content)[0]["extensions"] == document["extensions"]


def test_a_motion_that_is_too_long_for_a_character_is_refused(client, walk, monkeypatch):
    hero = told(added(client, HERO))["id"]
    monkeypatch.setattr(storage, "MOST_POSES", 100)
    answer = client.get(f"/api/motions/{walk}.glb", params={"character": json.dumps(hero)})
    assert answer.status_code == 422 and "lower the frame rate" in answer.json()["error"]


def test_poses_are_computed_once_for_each_motion(tmp_path, monkeypatch):
    characters, motion = Characters(tmp_path), walking(seconds=0.5)
    name = characters.receive(HERO, "hero.glb")
    first = characters.poses(name, "walk", motion)
    monkeypatch.setattr(character_storage, "retarget", None)
    assert characters.poses(name, "walk", motion) is first
    characters.delete(name)
    with pytest.raises(RequestError, match="no longer stored"):
        characters.poses(name, "walk", motion)


def test_a_fast_recording_is_shown_at_the_rate_of_a_screen(tmp_path):
    characters = Characters(tmp_path)
    name = characters.receive(HERO, "hero.glb")
    fast = walking(seconds=1.0, fps=240)
    document, _ = figures.unpacked(characters.poses(name, "fast", fast))
    assert document["accessors"][0]["count"] == 60


def test_the_page_is_told_which_files_are_characters_and_a_document_may_name_one(client):
    described = client.get("/api/model").json()["characters"]
    assert described == {"receives": [".glb", ".gltf", ".vrm"], "most": MOST_UPLOAD}
    content = {"document": {"figure": {"character": {"id": "a", "name": "A"}, "materials": "own"}}}
    assert client.put("/api/documents/worn", json={"base": 0, "content": content}).status_code == 200
    assert client.get("/api/documents/worn").json()["content"] == content


# Joint maps


LANKY = figures.glb(figures.lanky(), seed=3)
ELBOW = {"left_elbow": "DEF-upper_arm.L.001", "left_foot": None}


def put(client: TestClient, name: str, joint_map):
    return client.put(f"/api/characters/{name}/joint_map", json={"joint_map": joint_map})


def test_a_joint_map_is_stored_with_the_character_and_poses_and_exports_follow_it(client, walk):
    name = told(added(client, LANKY, "lanky.glb"))["id"]
    path, settings = f"/api/characters/{name}", {"character": json.dumps(name)}
    found = client.get(f"{path}/joint_map").json()
    assert found["joint_map"]["left_elbow"] == "DEF-forearm.L" and found["corrections"] == {}
    assert set(found["joint_map"]) <= set(found["joints"]) and set(figures.lanky().names) <= set(found["names"])
    before = [client.get(address, params=settings).content for address in (
        f"{path}/poses/{walk}", f"/api/motions/{walk}.glb")]  # fmt: skip
    answer = put(client, name, ELBOW)
    assert answer.status_code == 200 and answer.json()["joint_map"]["left_elbow"] == "DEF-upper_arm.L.001"
    assert "left_foot" not in answer.json()["joint_map"] and answer.json()["found_by"].endswith("joint map")
    assert client.get(f"{path}/joint_map").json() == answer.json()
    assert (
        next(each for each in client.get("/api/characters").json()["characters"] if each["id"] == name)["corrections"]
        == ELBOW
    )
    after = [client.get(address, params=settings).content for address in (
        f"{path}/poses/{walk}", f"/api/motions/{walk}.glb")]  # fmt: skip
    assert all(one != other for one, other in zip(before, after, strict=True))
    assert told(added(client, LANKY, "again.glb"))["corrections"] == ELBOW, "adding the file again keeps its map"
    assert put(client, name, {}).json() == found
    assert client.get(f"{path}/poses/{walk}").content == before[0]


def test_a_joint_map_outlives_the_server_goes_with_its_character_and_leaves_the_list_in_order(tmp_path):
    characters = Characters(tmp_path)
    name, other = characters.receive(LANKY, "lanky.glb"), characters.receive(HERO, "hero.glb")
    os.utime(tmp_path / f"{name}.glb", (1, 1))
    characters.correct(name, ELBOW)
    again = Characters(tmp_path)
    assert again.get(name).joint_map["left_elbow"] == ELBOW["left_elbow"]
    assert [each["id"] for each in again.all()] == [other, name], "a correction adds no character"
    assert (tmp_path / f"{name}.json").stat().st_mode & 0o077 == 0
    again.delete(name)
    assert again.describe(again.receive(LANKY, "lanky.glb"))["corrections"] == {}


def test_a_record_of_before_has_no_joint_map_and_a_damaged_map_is_no_record(tmp_path):
    characters = Characters(tmp_path)
    name = characters.receive(HERO, "hero.glb")
    record = json.loads((tmp_path / f"{name}.json").read_text())
    for joint_map, stored in ((None, True), ([], False), ({"head": 7}, False)):
        damaged = {key: each for key, each in record.items() if key != "joint_map"}
        damaged |= {} if joint_map is None else {"joint_map": joint_map}
        (tmp_path / f"{name}.json").write_text(json.dumps(damaged))
        assert [each["corrections"] for each in characters.all()] == ([{}] if stored else [])


@pytest.mark.parametrize(
    ("joint_map", "message"),
    [
        ({"left_knee": "nobody"}, "the file: joint map: left_knee is 'nobody', but the file's joints are "),
        ({"tail\n": "DEF-hips"}, "joint map: 'tail\\n' is not a joint of SMPL; choose from pelvis"),
        ({"x" * 9000: None}, "is not a joint of SMPL"),
        ({"x\n" * 9000: 7}, "a joint, or null, needed"),
        ({"left_knee": 7}, "joint_map: left_knee=7: the name of a joint, or null, needed"),
        ({"left_knee": None}, "no joint was found for left_knee; name them in a joint map"),
        ({"left_knee": "DEF-shin.R"}, "'DEF-shin.R' cannot be both"),
        ({"left_knee": "DEF-f_index.L"}, "does not hang from 'DEF-thigh.L' (left_hip)"),
        ({"head": "DEF-toe.L"}, "the file: "),
        ([], "joint_map"),
        ("left_knee: DEF-shin.L", "joint_map"),
    ],
    ids=lambda value: str(value)[:20],
)
def test_a_joint_map_that_does_not_fit_is_refused_as_read_character_does_and_not_stored(
    client, tmp_path, joint_map, message
):
    name = told(added(client, LANKY, "lanky.glb"))["id"]
    answer = put(client, name, joint_map)
    assert answer.status_code == 422
    error = answer.json()["error"]
    assert message in error and "/tmp" not in error and "\n" not in error and len(error) < 500
    assert client.get(f"/api/characters/{name}/joint_map").json()["corrections"] == {}
    if error.startswith("the file: "):
        path = tmp_path / "lanky.glb"
        path.write_bytes(LANKY)
        with pytest.raises(stmc.formats.characters.CharacterError) as caught:
            stmc.read_character(path, joint_map)
        assert str(caught.value) == error.replace("the file", str(path), 1)


def test_names_that_are_too_long_to_be_stored_are_refused(client):
    document, binary = figures.document(figures.stocky())
    document["nodes"][2]["name"] = "é" * 9000
    name = told(added(client, figures.packed(document, binary)))["id"]
    answer = put(client, name, {"head": "é" * 9000})
    assert answer.status_code == 422 and "too long to be stored" in answer.json()["error"]
    assert client.get(f"/api/characters/{name}").status_code == 200


def test_random_joint_maps_are_stored_and_move_or_are_refused_in_a_sentence(client, walk):
    name, chance = told(added(client, LANKY, "lanky.glb"))["id"], random.Random(2)
    found, statuses = client.get(f"/api/characters/{name}/joint_map").json(), set()
    for number in range(20):
        joints = chance.sample(found["joints"], 1 + number % 3)
        answer = put(client, name, {joint: chance.choice([None, *found["names"]]) for joint in joints})
        assert answer.status_code in (200, 422) and ("error" in answer.json()) == (answer.status_code == 422)
        statuses.add(answer.status_code)
        assert client.get(f"/api/characters/{name}/poses/{walk}").status_code == 200, "what is stored can be moved"
    assert statuses == {200, 422}


@pytest.mark.parametrize("name", ["male", "female", "zombie", "CesiumMan"])
def test_characters_of_strangers_are_taken_and_move(client, walk, name):
    content = data_file(f"characters/{name}.glb").read_bytes()
    hero = told(added(client, content, f"{name}.glb"))
    assert hero["name"] == name
    document, _ = figures.unpacked(client.get(f"/api/characters/{hero['id']}/poses/{walk}").content)
    assert {each["extras"]["part"] for each in document["nodes"] if each.get("extras")} == set(map(str, BodyPart))
