"""The studio's API for programs: one table, true documentation, a token, and the two clients that come along."""

import copy
import html
import importlib.util
import json
import os
import re
import stat
import subprocess
import sys
import types
from collections.abc import Iterator
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from helpers import characters as made
from helpers.motions import walking
from helpers.studio import ADDRESS, PORT, Served, bearer, draw_nothing, knowing, served, studio
from jsonschema import Draft202012Validator
from openapi_spec_validator import validate
from starlette.routing import Route
from starlette.testclient import TestClient

import stmc
from stmc.viewing.studio import Sessions, application, program_token
from stmc.viewing.studio.operations import OPERATIONS

ASSETS = Path(stmc.__file__).parent / "assets" / "api"
DOCS = Path(stmc.__file__).parents[1] / "docs"
WALK = "walk # 0 # 2 # legs"


@pytest.fixture(scope="module")
def model() -> stmc.Model:
    return knowing()


@pytest.fixture(scope="module")
def client(model, tmp_path_factory) -> Iterator[TestClient]:
    with studio(model, tmp_path_factory.mktemp("studio")) as client:
        client.app.state.films.render = draw_nothing
        yield client


@pytest.fixture(scope="module")
def program(model, tmp_path_factory) -> Iterator[Served]:
    with served(tmp_path_factory.mktemp("served"), model) as served_studio:
        yield served_studio


@pytest.fixture(scope="module")
def document(client) -> dict[str, Any]:
    return client.get("/api/openapi.json").json()


@pytest.fixture(scope="module")
def names(client) -> dict[str, str]:
    """Names of a motion, a job that has ended, a film, a document, a character, and a stream."""
    job = client.post("/api/jobs", json={"timeline": WALK, "steps": "preview"}).json()["job"]
    told = client.get(f"/api/jobs/{job}/events").text
    client.put("/api/documents/mine", json={"base": 0, "content": {"name": "Mine"}})
    hero = client.post("/api/characters", content=made.glb(made.stocky())).json()["character"]["id"]
    stream = client.post("/api/streams", json={"timeline": WALK}).json()["stream"]
    motion = re.search(r'"id": "([^"]+)"', told)[1]
    film = client.post("/api/films", json={"motion": motion}).json()["job"]
    assert "event: done" in client.get(f"/api/jobs/{film}/events").text
    documents = {"document": "mine", "character": hero}
    return {"motion": motion, "job": job, "film": film, "stream": stream} | documents


# The document is true


def test_the_routes_are_those_of_the_table_and_of_the_document(client, document):
    routes = {
        (route.path, method) for route in client.app.routes if isinstance(route, Route) for method in route.methods
    }
    listed = {(each.path, each.method) for each in OPERATIONS}
    assert {each for each in routes if each[1] != "HEAD"} == listed | {("/", "GET"), ("/api", "GET")}
    assert {(path, method.upper()) for path, methods in document["paths"].items() for method in methods} == listed
    assert len(listed) == len(OPERATIONS) and len({each.handler for each in OPERATIONS}) == len(OPERATIONS)


def test_the_document_is_openapi(document):
    validate(document)


def address(path: str, names: dict[str, str]) -> str:
    name = next((name for kind, name in names.items() if path.startswith(f"/api/{kind}s/")), "")
    return path.replace("{name}", name).replace("{kind}", "bvh").replace("{motion}", names["motion"])


def body_of(operation: dict, names: dict[str, str]) -> dict | None:
    content = operation.get("requestBody", {}).get("content", {}).get("application/json")
    if content is None:
        return None
    body = copy.deepcopy(content["example"])
    if "base" in body:
        body["base"] = 1  # of the document that `names` has written
    return body | ({"motion": names["motion"]} if "motion" in body else {})


def called(client: TestClient, method: str, path: str, operation: dict, names: dict[str, str], body: Any = None):
    """The answer to an operation, called as its example says."""
    sent = {} if body is None else {"json": body}
    if "application/octet-stream" in operation.get("requestBody", {}).get("content", {}):
        hero, motion = made.glb(made.stocky()), client.get(f"/api/motions/{names['motion']}.npz").content
        sent = {"content": hero if path == "/api/characters" else motion}
    return client.request(method, address(path, names), **sent)


def validator(document: dict, schema: dict) -> Draft202012Validator:
    return Draft202012Validator({**schema, "components": document["components"]})


@pytest.mark.parametrize("operation", OPERATIONS, ids=lambda each: each.handler)
def test_an_operation_answers_as_the_document_says(client, document, names, operation):
    described = document["paths"][operation.path][operation.method.lower()]
    body = body_of(described, names)
    if body is not None:
        schema = described["requestBody"]["content"]["application/json"]["schema"]
        validator(document, schema).validate(body)
    answer = called(client, operation.method, operation.path, described, names, body)
    if operation.handler == "enter":  # its example is no token
        assert answer.status_code == 401
        return
    assert str(answer.status_code) in described["responses"] and answer.status_code == operation.status, answer.text
    contents = described["responses"][str(operation.status)]["content"]
    kind = answer.headers["content-type"].split(";")[0]
    assert kind in contents
    if "x-events" in contents[kind]:
        lines = [line.partition(": ")[2] for line in answer.text.splitlines() if line]
        for name, data in zip(lines[::2], lines[1::2], strict=True):
            validator(document, contents[kind]["x-events"][name]).validate(json.loads(data))
    elif "schema" in contents[kind]:
        validator(document, contents[kind]["schema"]).validate(answer.json())


def violations(document: dict, schema: dict, value: Any) -> Iterator[Any]:
    """Values that are just beyond a schema's bounds, made of one within them."""
    if "$ref" in schema:
        schema = document["components"]["schemas"][schema["$ref"].rsplit("/", 1)[-1]]
    for each in schema.get("anyOf", []):
        if validator(document, each).is_valid(value):
            yield from violations(document, each, value)
    if "enum" in schema:
        yield "none of them"
    for bound, beyond in (("minimum", -1), ("exclusiveMinimum", 0), ("maximum", 1), ("exclusiveMaximum", 0)):
        if bound in schema:
            yield schema[bound] + beyond
    if "maxLength" in schema:
        yield "x" * (schema["maxLength"] + 1)
    if "minItems" in schema:
        yield value[: schema["minItems"] - 1] if value else []
    if "maxItems" in schema:
        yield (value or [{}]) * (schema["maxItems"] + 1)
    if schema.get("additionalProperties") is False:
        yield {**value, "surprise": 1}
    for name in schema.get("required", []):
        yield {key: each for key, each in value.items() if key != name}
    for name, inner in schema.get("properties", {}).items():
        yield {**value, name: object}
        for each in (
            violations(document, inner, value.get(name, inner.get("default"))) if isinstance(value, dict) else ()
        ):
            yield {**value, name: each}
    if isinstance(value, list) and value and "items" in schema:
        for each in violations(document, schema["items"], value[0]):
            yield [each, *value[1:]]


EXAMPLES = [each for each in OPERATIONS if hasattr(each.takes, "example") and each.handler != "enter"]


@pytest.mark.parametrize("operation", EXAMPLES, ids=lambda each: each.handler)
def test_what_is_beyond_the_documented_bounds_is_refused(client, document, names, operation):
    """Each bound of the document, one after the other: the server has no other ones, and the document no others."""
    described = document["paths"][operation.path][operation.method.lower()]
    schema, body = described["requestBody"]["content"]["application/json"]["schema"], body_of(described, names)
    if operation.handler == "add_job":
        body |= {"timeline": {"name": "", "prompts": [{"text": "walk", "start": 0, "end": 2, "parts": ["legs"]}]}}
    count = 0
    for bad in violations(document, schema, body):
        text = json.dumps(bad, default=lambda _: [[["neither text, nor number, nor object"]]])
        if validator(document, schema).is_valid(json.loads(text)):
            continue  # what one alternative forbids another may allow
        answer = client.request(operation.method, address(operation.path, names), content=text)
        assert answer.status_code in (400, 413, 422) and answer.json()["error"], text[:300]
        validator(document, {"$ref": "#/components/schemas/Error"}).validate(answer.json())
        count += 1
    assert count >= 3


def test_parameters_of_an_address_are_refused_beyond_their_bounds_too(client, document, names):
    parameters = document["paths"]["/api/motions/{name}.{kind}"]["get"]["parameters"]
    settings = {"fps", "loop", "timeline", "character", "constraints"}
    assert {each["name"] for each in parameters} == {"name", "kind"} | settings
    for query in (
        "fps=0.5",
        "fps=241",
        "loop=2",
        "timeline=7",
        "character=7",
        "timeline=%22%22",
        "constraints=[]",
        "surprise=1",
        "fps=x",
    ):
        answer = client.get(f"/api/motions/{names['motion']}.bvh?{query}")
        assert answer.status_code == 422 and answer.json()["error"], query


@pytest.mark.parametrize("constraint", [
    {"path": {"points": [[0, 0], [0, -1]], "end": 2}}, {"heading": {"angle": 1.5}}, {"hold": {"joint": "left_hand"}},
    {"target": {"joint": "left_hand", "point": [0, 0.4, 1.2]}}, {"keyframe": {"motion": "ID", "at": 1}},
], ids=lambda each: next(iter(each)))  # fmt: skip
def test_a_job_takes_what_the_document_says_of_constraints_and_changes(client, document, names, constraint):
    constraint = json.loads(json.dumps(constraint).replace("ID", names["motion"]))
    body = {"timeline": WALK, "steps": "preview", "keep": names["motion"], "change": ["0.5 # 1.5 # legs"]}
    body |= {"constraints": [constraint], "guidance": 2, "sampler": "ddim", "clean_feet": False}
    validator(document, {"$ref": "#/components/schemas/JobBody"}).validate(body)
    answer = client.post("/api/jobs", json=body)
    assert answer.status_code == 201, answer.text
    assert client.delete(f"/api/jobs/{answer.json()['job']}").status_code == 200


# The page about it


class Page(HTMLParser):
    """The texts, links and elements of a page."""

    def __init__(self, content: str) -> None:
        super().__init__()
        self.links, self.kinds, self.anchors, self.open = [], set(), set(), []
        self.feed(content)

    def handle_starttag(self, tag: str, attributes: list[tuple[str, str | None]]) -> None:
        self.kinds.add(tag)
        self.links += [value for name, value in attributes if name in ("href", "src")]
        self.anchors |= {f"#{value}" for name, value in attributes if name == "id"}


def test_the_page_about_the_api_needs_no_key_loads_nothing_and_has_every_operation(client):
    stranger = TestClient(client.app, base_url=ADDRESS)
    answer = stranger.get("/api")
    assert answer.status_code == 200 and "default-src 'self'" in answer.headers["content-security-policy"]
    page = Page(answer.text)
    assert not page.kinds & {"script", "link", "img", "iframe", "form"}
    for link in page.links:
        assert link in page.anchors or stranger.get(link).status_code == 200, link
    text = html.unescape(answer.text)
    for operation in OPERATIONS:
        assert f"<code>{operation.path}</code>" in text and operation.summary in text
    assert f"curl -X POST {ADDRESS}/api/jobs" in text and "$(cat ~/.stmc/studio/api_token)" in text


def test_the_guide_lists_every_operation_once():
    rows = re.findall(
        r"^\| `(\w+) (/api/\S+)` \| ([^|]+) \|$", (DOCS / "api.md").read_text("utf-8"), flags=re.MULTILINE
    )
    assert [tuple(map(str.strip, row)) for row in rows] == [
        (each.method, each.path, each.summary) for each in OPERATIONS
    ]


# The token


def test_a_program_has_a_token_that_lasts_and_that_nobody_else_can_read(tmp_path):
    token = program_token(tmp_path)
    path = tmp_path / "api_token"
    assert path.read_text() == f"{token}\n" and len(token) == 43 and program_token(tmp_path) == token
    if os.name != "nt":
        assert stat.S_IMODE(path.stat().st_mode) == 0o600
        path.chmod(0o644)
        seen, token = token, program_token(tmp_path)
        assert token != seen and stat.S_IMODE(path.stat().st_mode) == 0o600, (
            "what others could read is a secret no more"
        )
    for content in (b"", b"short\n", b"\xff" * 43, b"x" * 5000):
        path.write_bytes(content)
        assert len(program_token(tmp_path)) == 43
    other = tmp_path / "other"
    other.write_text("y" * 43)
    other.chmod(0o600)
    path.unlink()
    path.symlink_to(other)
    assert program_token(tmp_path) != "y" * 43 and not path.is_symlink() and other.read_text() == "y" * 43


def test_a_token_opens_what_a_page_s_key_opens_and_nothing_else_does(model, tmp_path):
    sessions = Sessions()
    token = program_token(tmp_path)
    sessions.allow(token)
    with TestClient(application(model, tmp_path, sessions, PORT), base_url=ADDRESS) as stranger:
        assert stranger.get("/api/documents", headers=bearer(token)).status_code == 200
        assert stranger.get("/api/documents", headers={"Authorization": f"bearer  {token}"}).status_code == 200
        for header in (f"Basic {token}", token, "Bearer", f"Bearer {token}x", f"Bearer {token[:-1]}", "Bearer é"):
            refused = stranger.get("/api/documents", headers={"Authorization": header.encode("latin-1")})
            assert refused.status_code == 401 and refused.headers["www-authenticate"] == "Bearer"
        assert stranger.get("/api/documents", headers={"Cookie": f"key={token}"}).status_code == 401
        assert stranger.get(f"/api/documents?token={token}").status_code == 401
        for foreign in ({"Origin": "http://evil.example"}, {"Host": "evil.example"}, {"Origin": "null"}):
            assert stranger.get("/api/documents", headers=bearer(token) | foreign).status_code == 403
        assert stranger.post("/api/session", json={"token": token}).status_code == 401, "it is no address of a page"
        open_to_all = {each.path for each in OPERATIONS if each.public}
        for operation in OPERATIONS:
            answer = stranger.request(operation.method, operation.path.replace("{name}", "x").replace("{kind}", "glb"))
            assert (answer.status_code == 401) == (operation.path not in open_to_all), operation.path


# Skeletons


def skeleton_of(bones: made.Bones, up: str = "y") -> dict:
    turn = np.eye(3) if up == "y" else np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
    joints = [
        {"name": name, "parent": None if parent < 0 else bones.names[parent], "place": (turn @ place).tolist()}
        for name, parent, place in zip(bones.names, bones.parents, bones.places, strict=True)
    ]
    return {"up": up, "joints": joints[::-1]}


@pytest.fixture(scope="module")
def walk(client) -> str:
    return client.app.state.jobs.motions.add(walking(seconds=1.0, fps=20))


@pytest.mark.parametrize("bones", [made.lanky(), made.stocky()], ids=["lanky", "stocky"])
def test_a_skeleton_moves_as_the_character_of_a_file_does(client, walk, bones, tmp_path):
    (tmp_path / "hero.glb").write_bytes(made.glb(bones, seed=3))
    moved = stmc.retarget(walking(seconds=1.0, fps=20).resampled(30), tmp_path / "hero.glb")
    told = client.post("/api/retarget", json={"motion": walk, "skeleton": skeleton_of(bones), "fps": 30}).json()
    assert told["joint_map"] == moved.character.joint_map and told["frames"] == len(moved.motion.places) == 30
    posed = made.moved(moved.content(".glb"), 17)
    rest = dict(zip(bones.names, bones.places, strict=True))
    turns, places = {}, {}
    for name, parent in zip(bones.names, bones.parents, strict=True):
        above = bones.names[parent] if parent >= 0 else None
        own = rotation(told["turns"][name][17]) if name in told["turns"] else None
        turns[name] = own if own is not None else turns.get(above, np.eye(3))
        places[name] = rest[name] if above is None else places[above] + turns[above] @ (rest[name] - rest[above])
        if name == told["travelling"]:
            places[name] = np.array(told["places"][17])
        np.testing.assert_allclose(places[name], posed[name][:3, 3], atol=1e-4)


def rotation(quaternion: list[float]) -> np.ndarray:
    from stmc.motion.geometry import quaternion_to_matrix

    return quaternion_to_matrix(torch.tensor(quaternion, dtype=torch.float64)).numpy()


def test_axes_and_units_are_the_skeleton_s_own(client, walk):
    y_up, z_up = skeleton_of(made.lanky()), skeleton_of(made.lanky(), up="z")
    for joint in z_up["joints"]:
        joint["place"] = [100 * value for value in joint["place"]]
    ours, theirs = (
        client.post("/api/retarget", json={"motion": walk, "skeleton": each}).json() for each in (y_up, z_up)
    )
    turned = np.array(ours["places"])[:, [0, 2, 1]] * [100, -100, 100]
    np.testing.assert_allclose(theirs["places"], turned, atol=1e-2)
    for name, turns in ours["turns"].items():
        expected = np.array(turns)[:, [0, 1, 3, 2]] * [1, 1, -1, 1]
        assert np.abs((expected * np.array(theirs["turns"][name])).sum(axis=1)).min() > 1 - 1e-5


def nameless(bones: made.Bones, yaw: float) -> dict:
    """A skeleton whose names say nothing, and that looks elsewhere."""
    skeleton = skeleton_of(bones)
    turn = np.array([[np.cos(yaw), 0, np.sin(yaw)], [0, 1, 0], [-np.sin(yaw), 0, np.cos(yaw)]])
    number = {joint["name"]: f"bone {index}" for index, joint in enumerate(skeleton["joints"])}
    for joint in skeleton["joints"]:
        joint["place"] = (turn @ joint["place"]).tolist()
        joint["name"], joint["parent"] = number[joint["name"]], number.get(joint["parent"])
    return skeleton


@pytest.mark.parametrize("degrees", [0, 30, 90, 180, 270])
def test_a_skeleton_without_names_is_told_by_its_shape_wherever_it_looks(client, degrees):
    skeleton = nameless(made.lanky(), np.radians(degrees))
    told = client.post("/api/map", json={"skeleton": skeleton}).json()
    named = client.post("/api/map", json={"skeleton": skeleton_of(made.lanky())}).json()["joint_map"]
    numbers = {joint["name"]: f"bone {index}" for index, joint in enumerate(skeleton_of(made.lanky())["joints"])}
    assert told["found_by"] == "the rig's shape"
    for joint in ("left_knee", "right_knee", "left_wrist", "right_wrist", "left_ankle", "right_ankle"):
        assert told["joint_map"][joint] == numbers[named[joint]]


JOINT = {"name": "a", "parent": None, "place": [0, 0, 0]}


@pytest.mark.parametrize(
    ("skeleton", "joint_map", "words"),
    [
        ({"joints": []}, {}, "1 to 1,000"),
        ({"joints": [JOINT, JOINT]}, {}, "two joints are called 'a'"),
        ({"joints": [JOINT | {"parent": "b"}]}, {}, "which is no joint"),
        ({"joints": [JOINT | {"parent": "b"}, JOINT | {"name": "b", "parent": "a"}]}, {}, "cycle"),
        ({"joints": [JOINT | {"place": [0, 0]}]}, {}, "three numbers"),
        ({"joints": [JOINT | {"place": [0, 0, 1e7]}]}, {}, "three numbers"),
        ({"joints": [JOINT | {"place": [0, 0, True]}]}, {}, "joint 1"),
        ({"joints": [JOINT | {"place": [[], 0, 0]}]}, {}, "joint 1"),
        ({"joints": ["a"]}, {}, "joint 1: a joint should be an object"),
        ({"joints": [JOINT], "up": "x"}, {}, "choose from y, z"),
        ({"joints": [JOINT]}, {}, "name them in a joint map"),
        (skeleton_of(made.lanky()), {"left_knee": 7}, "joint_map: left_knee=7"),
        (skeleton_of(made.lanky()), {"tail": "root"}, "'tail' is not a joint of SMPL"),
        (skeleton_of(made.lanky()), {"left_knee": "nose"}, "left_knee is 'nose'"),
    ],
)
def test_what_is_no_person_s_skeleton_is_refused_in_a_sentence(client, skeleton, joint_map, words):
    answer = client.post("/api/map", json={"skeleton": skeleton, "joint_map": joint_map})
    assert answer.status_code == 422 and words in answer.json()["error"], answer.text


def test_a_joint_map_corrects_and_too_many_frames_are_refused(client, walk, monkeypatch):
    skeleton = skeleton_of(made.lanky())
    told = client.post("/api/map", json={"skeleton": skeleton, "joint_map": {"left_foot": None}}).json()
    assert "left_foot" not in told["joint_map"] and told["found_by"].endswith("corrected by the joint map")
    monkeypatch.setattr("stmc.viewing.studio.server.MOST_KEY_FRAMES", 100)
    answer = client.post("/api/retarget", json={"motion": walk, "skeleton": skeleton, "fps": 240})
    assert answer.status_code == 422 and "lower the frame rate" in answer.json()["error"]


# The clients


def run_client(program: Served, *arguments: str) -> subprocess.CompletedProcess:
    """The example client as a user runs it, without any package."""
    settings = ["--address", program.address, "--token-file", str(program.token_file)]
    command = [sys.executable, "-S", "-I", str(ASSETS / "client.py"), *arguments, *settings]
    return subprocess.run(command, capture_output=True, text=True, timeout=120)


def test_the_example_client_checks_samples_waits_and_saves(program, tmp_path):
    timeline = tmp_path / "wave.txt"
    timeline.write_text(f"{WALK}\nwave with the right hand # 0.5 # 1.5\n")
    for name in ("wave.npz", "wave.glb"):
        done = run_client(program, str(timeline), str(tmp_path / name), "--preview", "--seed", "4")
        assert done.returncode == 0, done.stderr
        assert "prompt 2: right arm (suggested)" in done.stdout and "preview: step 10 of 10" in done.stdout
    assert stmc.read(tmp_path / "wave.npz").frames == 40
    assert (tmp_path / "wave.glb").read_bytes().startswith(b"glTF")


def test_the_example_client_says_what_is_wrong(program, tmp_path):
    file = str(tmp_path / "walk.glb")
    assert "line 1: 'walk # 0' has no end" in run_client(program, "walk # 0", file).stderr
    wrong = Served("http://127.0.0.1:1", program.folder)
    done = run_client(wrong, WALK, file)
    assert done.returncode == 1 and "no studio answers" in done.stderr
    done = run_client(Served(program.address, tmp_path), WALK, file)
    assert done.returncode == 1 and "prints where its token is" in done.stderr
    done = run_client(Served("http://studio.example:80", program.folder), WALK, file)
    assert done.returncode == 1 and "not an address of this machine" in done.stderr
    (tmp_path / "api_token").write_text("x" * 43)
    assert "programs send its token" in run_client(Served(program.address, tmp_path), WALK, file).stderr


def module_of(path: Path) -> types.ModuleType:
    spec = importlib.util.spec_from_file_location(path.stem, path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_a_client_that_stops_listening_cancels_its_job(program):
    studio = module_of(ASSETS / "client.py").Studio(program.address, program.token_file.read_text().strip())
    requests, send = [], studio._open
    studio._open = lambda method, path, *body: requests.append((method, path)) or send(method, path, *body)
    events = studio.sample("walk # 0 # 60")
    assert next(events)[0] == "progress"
    events.close()
    method, path = requests[-1]
    assert method == "DELETE"
    with studio._open("GET", f"{path}/events") as stream:
        assert stream.read().decode().strip().endswith("event: cancelled\ndata: {}")
    assert list(studio.sample(WALK, preview=True))[-1][0] == "done"


class Stub:
    """A stand-in for the classes of Blender that the add-on inherits from: it does nothing."""


@pytest.fixture
def addon(monkeypatch) -> types.ModuleType:
    """The add-on without Blender: only what touches nothing of it can be tried so; the rest is tried in Blender itself
    by test_blender_addon.py. What stands in for Blender are empty classes, and properties that are nothing."""
    bpy, props, mathutils = (types.ModuleType(name) for name in ("bpy", "bpy.props", "mathutils"))
    bpy.types = types.SimpleNamespace(**dict.fromkeys(("AddonPreferences", "PropertyGroup", "Operator", "Panel"), Stub))
    for name in ("Bool", "Collection", "Int", "Pointer", "String"):
        setattr(props, f"{name}Property", lambda **settings: None)
    for name in ("Matrix", "Quaternion", "Vector"):
        setattr(mathutils, name, Stub)
    for module in (bpy, props, mathutils):
        monkeypatch.setitem(sys.modules, module.__name__, module)
    return module_of(ASSETS / "blender_addon.py")


def task(addon: types.ModuleType, program: Served, skeleton: dict, connected: set[str] = frozenset()):
    """A task of the add-on that has ended."""
    studio = addon.Studio(program.address, str(program.token_file))
    job = {"timeline": WALK, "seeds": [0], "steps": "preview"}
    running = addon.Task(studio, job, skeleton, {}, 24.0, connected)
    running.thread.join(timeout=60)
    return running


def test_the_add_on_s_thread_brings_keys_or_a_sentence(addon, program):
    done = task(addon, program, skeleton_of(made.lanky(), up="z"))
    assert done.error == "" and done.keys["frames"] == 48 and done.keys["travelling"] == "DEF-hips"
    assert set(addon.JOINTS) >= set(done.keys["joint_map"])
    failed = task(addon, program, {"joints": [JOINT]})
    assert failed.keys is None and failed.error.startswith("Skeleton: no joint was found for head")
    held = task(addon, program, skeleton_of(made.lanky()), {"DEF-hips"})
    assert "The bone DEF-hips cannot travel" in held.error
    with pytest.raises(addon.StudioError, match="this machine"):
        addon.Studio("http://127.0.0.1.evil.example:8686", str(program.token_file))


def test_the_files_that_are_served_are_those_that_are_shipped(client):
    for name in ("client.py", "blender_addon.py"):
        answer = client.get(f"/api/{name}")
        assert answer.content == (ASSETS / name).read_bytes() and "attachment" in answer.headers["content-disposition"]
