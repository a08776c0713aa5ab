"""The glTF files that we write: by glTF's rules, by the validator of glTF's authors, and in three.js in a browser."""

import base64
import functools
import json
import shutil
import subprocess
import threading
from collections import Counter
from collections.abc import Iterator
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import numpy as np
import pytest
from conftest import DATA
from helpers import browser
from helpers import characters as made
from helpers.motions import walking
from test_characters import STRANGERS, UP, humanoid

import stmc
from stmc.formats.characters import stage_poses
from stmc.motion.body import JOINTS

FRAME = 17
WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}
BYTES = {5120: 1, 5121: 1, 5122: 2, 5123: 2, 5125: 4, 5126: 4}
OF_VRM = {"UNSUPPORTED_EXTENSION", "NODE_EMPTY"}
"""What the validator always says of a .vrma: it does not know VRM, and hands carry nothing."""


def vrm(version: int) -> bytes:
    document, binary = made.document(made.stocky())
    bones = ["hips", "spine", "head"]
    for side in ("left", "right"):
        bones += [f"{side}{bone}" for bone in ("UpperArm", "LowerArm", "Hand", "UpperLeg", "LowerLeg", "Foot")]
    names = (node["name"] for node in document["nodes"])
    return made.packed(humanoid(document, dict(zip(bones, names, strict=False)), version), binary)


def gltf() -> bytes:
    document, binary = made.document(made.stocky())
    data = base64.b64encode(binary).decode()
    document["buffers"][0]["uri"] = f"data:application/octet-stream;base64,{data}"
    return json.dumps(document).encode()


MADE = {
    "lanky.glb": lambda: made.glb(made.lanky(), seed=3),
    "stocky.glb": lambda: made.glb(made.stocky(), seed=5, scale=0.01),
    "stocky.gltf": gltf,
    "old.vrm": lambda: vrm(0),
    "new.vrm": lambda: vrm(1),
}
OWN = ("mannequin", *MADE)


@pytest.fixture(scope="module")
def motion() -> stmc.Motion:
    return stmc.clean_feet(walking(seconds=2.0, fps=20))


def given(name: str, motion: stmc.Motion, folder: Path) -> Path:
    """The file of a character: our mannequin, one made by code, or a stranger's."""
    if name in STRANGERS:
        path = DATA / f"characters/{name}.glb"
        if not path.exists():
            pytest.skip(f"no characters/{name}.glb at {DATA} (set STMC_DATA)")
        return path
    path = folder / (name if name in MADE else "mannequin.glb")
    if name in MADE:
        path.write_bytes(MADE[name]())
    else:
        stmc.write(motion, path)
    return path


def written(path: Path, motion: stmc.Motion) -> tuple[stmc.CharacterMotion, dict[str, bytes]]:
    """A character's motion, and the glTF files of it by their endings."""
    moved = stmc.retarget(motion, path)
    return moved, {suffix: moved.content(suffix) for suffix in moved.character.formats if suffix != ".bvh"}


@pytest.mark.parametrize("name", OWN)
def test_files_keep_the_rules_of_gltf(name, motion, tmp_path):
    path = given(name, motion, tmp_path)
    moved, files = written(path, motion)
    if path.suffix == ".glb":
        files["the file given"] = path.read_bytes()
    files["poses"] = stage_poses(moved, motion)
    for said, content in files.items():
        try:
            check_rules(*made.unpacked(content))
        except AssertionError as error:
            raise AssertionError(f"{name} as {said}") from error


def check_rules(document: dict, binary: bytes) -> None:
    """Buffers are in the binary chunk, whole; views and accessors lie aligned within them, and nothing is unused."""
    [buffer] = document["buffers"]
    assert "uri" not in buffer and 0 <= len(binary) - buffer["byteLength"] <= 3
    for view in document["bufferViews"]:
        assert view.get("byteOffset", 0) + view["byteLength"] <= buffer["byteLength"]
    for accessor in document["accessors"]:
        view, size = document["bufferViews"][accessor["bufferView"]], BYTES[accessor["componentType"]]
        start = accessor.get("byteOffset", 0)
        assert (view.get("byteOffset", 0) + start) % size == 0
        assert start + accessor["count"] * WIDTHS[accessor["type"]] * size <= view["byteLength"]
    assert {accessor["bufferView"] for accessor in document["accessors"]} == set(range(len(document["bufferViews"])))
    used = {skin["inverseBindMatrices"] for skin in document.get("skins", [])}
    for mesh in document.get("meshes", []):
        for piece in mesh["primitives"]:
            used |= {*piece["attributes"].values(), *([piece["indices"]] if "indices" in piece else [])}
    for animation in document.get("animations", []):
        used |= {each[end] for each in animation["samplers"] for end in ("input", "output")}
        check_animation(document, binary, animation)
    assert used == set(range(len(document["accessors"])))


def check_animation(document: dict, binary: bytes, animation: dict) -> None:
    """Times rise, and their accessor has their bounds; rotations are unit quaternions; no channel is there twice."""
    for sampler in animation["samplers"]:
        times, values = (_array(document, binary, sampler[end]) for end in ("input", "output"))
        bounds = document["accessors"][sampler["input"]]
        assert (np.diff(times[:, 0]) > 0).all() and times[0, 0] >= 0 and len(values) == len(times)
        assert np.float32([bounds["min"], bounds["max"]]).tolist() == times[[0, -1]].tolist()
    targets = [(each["target"]["node"], each["target"]["path"]) for each in animation["channels"]]
    assert len(set(targets)) == len(targets) == len(animation["samplers"])
    for channel in animation["channels"]:
        if channel["target"]["path"] == "rotation":
            values = _array(document, binary, animation["samplers"][channel["sampler"]]["output"])
            assert np.abs(np.linalg.norm(values, axis=1) - 1).max() < 1e-5
        assert "matrix" not in document["nodes"][channel["target"]["node"]]


def _array(document: dict, binary: bytes, number: int) -> np.ndarray:
    accessor = document["accessors"][number]
    width, start = WIDTHS[accessor["type"]], document["bufferViews"][accessor["bufferView"]]["byteOffset"]
    assert accessor["componentType"] == 5126
    return np.frombuffer(binary, "<f4", accessor["count"] * width, start).reshape(-1, width)


@pytest.mark.slow
@pytest.mark.parametrize("name", (*OWN, *STRANGERS))
def test_the_validator_of_gltf_s_authors_says_no_more_than_of_the_file_given(name, motion, tmp_path):
    path = given(name, motion, tmp_path)
    _, files = written(path, motion)
    before = issues(path)
    if name == "mannequin":
        assert before == Counter()
    for suffix, content in files.items():
        out = tmp_path / f"out{suffix}"
        out.write_bytes(content)
        more = issues(out) - (Counter() if suffix == ".vrma" else before)
        assert not [each for each in more if suffix != ".vrma" or each[1] not in OF_VRM], suffix


def issues(path: Path) -> Counter[tuple[int, str, str]]:
    """The severity, code and place of all that the validator says of a file; a skip where there is no validator."""
    if shutil.which("node") is None:
        pytest.skip("node is not installed")
    code = (
        "const fs = require('fs'), validator = require('gltf-validator');"
        "validator.validateBytes(new Uint8Array(fs.readFileSync(process.argv[1])), { maxIssues: 0 })"
        ".then(report => console.log(JSON.stringify(report.issues)))"
    )
    done = subprocess.run(["node", "-e", code, str(path)], capture_output=True, text=True)
    if "Cannot find module" in done.stderr:
        pytest.skip("gltf-validator is not where node looks: npm install gltf-validator, and NODE_PATH")
    found = json.loads(done.stdout)
    assert not found["truncated"]
    return Counter((each["severity"], each["code"], each["pointer"]) for each in found["messages"])


PAGE = """<!doctype html><script type="module">
import { AnimationMixer, Vector3 } from "./vendor/three.module.min.js";
import { GLTFLoader } from "./vendor/GLTFLoader.js";

// Where each node is at a time of the first animation, by its index in the file.
window.show = async (base64, time) => {
  const bytes = Uint8Array.from(atob(base64), (letter) => letter.charCodeAt(0)).buffer;
  const { scene, animations, parser } = await new GLTFLoader().parseAsync(bytes, "");
  const mixer = new AnimationMixer(scene);
  mixer.clipAction(animations[0]).play();
  mixer.setTime(time);
  scene.updateMatrixWorld(true);
  const places = {};
  scene.traverse((node) => {
    const number = parser.associations.get(node)?.nodes;
    if (number !== undefined) places[number] = node.getWorldPosition(new Vector3()).toArray();
  });
  return places;
};
window.complaints = [];
console.warn = console.error = (...words) => window.complaints.push(words.join(" "));
document.body.dataset.ready = "yes";
</script>"""


class Handler(SimpleHTTPRequestHandler):
    """The studio's files, and a page that shows none of them."""

    def do_GET(self) -> None:
        if self.path != "/page":
            return super().do_GET()
        self.send_response(200)
        self.send_header("Content-Type", "text/html")
        self.end_headers()
        self.wfile.write(PAGE.encode())

    def log_message(self, *args) -> None:
        pass


@pytest.fixture(scope="module")
def three(tmp_path_factory) -> Iterator[browser.Tab]:
    """A page of a browser in which three.js, as the studio has it, reads files."""
    if browser.PATH is None:
        pytest.skip("no chromium on the PATH (Debian: apt-get install chromium)")
    studio = Path(stmc.__file__).parent / "assets/studio"
    server = ThreadingHTTPServer(("127.0.0.1", 0), functools.partial(Handler, directory=str(studio)))
    threading.Thread(target=server.serve_forever, daemon=True).start()
    try:
        with browser.tab(tmp_path_factory.mktemp("three"), 300, 300) as tab:
            tab.open(f"http://127.0.0.1:{server.server_port}/page")
            tab.wait("document.body?.dataset.ready === 'yes'")
            yield tab
    finally:
        server.shutdown()


def shown(tab: browser.Tab, content: bytes, time: float) -> dict[int, np.ndarray]:
    """Where three.js puts the nodes of a file at a time."""
    data = base64.b64encode(content).decode()
    tab.ask(f"window.places = null, show('{data}', {time}).then((p) => places = p, (e) => places = `${{e}}`), 0")
    tab.wait("places !== null")
    found = tab.ask("places")
    assert isinstance(found, dict), found
    assert tab.ask("complaints.splice(0)") == []
    return {int(number): np.array(place) for number, place in found.items()}


@pytest.mark.slow
@pytest.mark.browser
@pytest.mark.parametrize("name", (*OWN, *STRANGERS))
def test_three_js_puts_the_joints_where_the_motion_has_them(name, motion, three, tmp_path):
    path = given(name, motion, tmp_path)
    moved, files = written(path, motion)
    rig, body = moved.motion.rig, moved.character.body
    expected = moved.motion.places[FRAME].numpy() @ moved.character.standing.turn
    for suffix, content in files.items():
        places = shown(three, content, FRAME / motion.fps)
        if suffix == ".vrma":  # which has fewer bones, so that its own numbers count
            nodes, own = made.unpacked(content)[0]["nodes"], made.moved(content, FRAME)
            away = [places[number] - own[node["name"]][:3, 3] for number, node in enumerate(nodes)]
        else:
            away = np.array([places[body.nodes[node]] for node in rig.driven]) - expected
        assert np.abs(away).max() < 1e-4 * moved.motion.scale, suffix
    if name == "mannequin":
        places = shown(three, path.read_bytes(), FRAME / motion.fps)
        ours = motion.joints[FRAME].numpy()
        assert np.abs(np.array([UP @ places[joint] for joint in range(len(JOINTS))]) - ours).max() < 1e-4
