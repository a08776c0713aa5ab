"""The studio against hostile requests, full disks, slow clients and a second studio on the same folder."""

import asyncio
import errno
import io
import json
import os
import socket
import stat
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from helpers.scripts import loaded, script
from helpers.studio import WALK, knowing, studio
from helpers.tiny_model import tiny
from starlette.testclient import TestClient
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect

import stmc
from stmc.viewing.studio import Documents, Motions, Sessions, application, auth, connections


@pytest.fixture(scope="module")
def model() -> stmc.Model:
    return knowing()


@pytest.fixture(scope="module")
def client(model, tmp_path_factory) -> Iterator[TestClient]:
    with studio(model, tmp_path_factory.mktemp("studio")) as client:
        yield client


@pytest.fixture(scope="module")
def motion() -> stmc.Motion:
    return tiny().generate("walk # 0 # 0.5", steps=1)[0]


def refused(answer, *statuses: int) -> str:
    """The sentence of an answer that refuses."""
    assert answer.status_code in statuses, (answer.status_code, answer.text[:200])
    return answer.json()["error"]


# Two studios on one folder

PUTS = """
import sys, time
from pathlib import Path
from stmc.viewing.studio.request_errors import RequestError
from stmc.viewing.studio.storage import Documents
documents, me, gate = Documents(sys.argv[1]), sys.argv[2], Path(sys.argv[3])
gate.with_name(me).touch()
while not gate.exists():
    time.sleep(0.001)
for base in range(25):
    try:
        print(documents.put("one", base, {"who": me}))
    except RequestError as refused:
        assert refused.status == 409, refused
    while documents.get("one")["version"] <= base:
        time.sleep(0.001)
"""


def test_of_two_processes_that_save_one_version_only_one_is_told_that_it_is_kept(tmp_path):
    gate = tmp_path / "gate"
    command = [sys.executable, "-c", PUTS, str(tmp_path / "documents")]
    both = [
        subprocess.Popen([*command, name, str(gate)], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
        for name in "ab"
    ]
    while not all((tmp_path / name).exists() for name in "ab"):
        assert [each.poll() for each in both] == [None, None], [each.communicate() for each in both]
        time.sleep(0.01)
    gate.touch()
    outputs = [each.communicate(timeout=120) for each in both]
    assert [each.returncode for each in both] == [0, 0], outputs
    kept = sorted(int(version) for output, _ in outputs for version in output.split())
    assert kept == list(range(1, 26))


@pytest.mark.slow
def test_a_second_studio_on_a_folder_ends_with_a_line_that_says_who_has_it(tmp_path):
    with stmc.io.files.lock_folder(tmp_path / "studio"):
        done = script("studio", f"folder={tmp_path / 'studio'}", "port=0", "open=false", folder=tmp_path, check=False)
    assert done.returncode == 2
    [line] = done.stdout.strip().splitlines()
    assert f"is in use by process {os.getpid()}" in line


@pytest.mark.slow
def test_a_studio_in_a_folder_that_takes_no_files_ends_before_it_prints_an_address(tmp_path):
    (tmp_path / "studio").write_text("a file")
    done = script("studio", f"folder={tmp_path / 'studio'}", "port=0", "open=false", folder=tmp_path, check=False)
    assert done.returncode == 2 and "http" not in done.stdout and len(done.stdout.strip().splitlines()) == 1


# What cannot be kept


def failing(error: Exception):
    def fail(*args, **others):
        raise error

    return fail


@pytest.mark.parametrize(
    ("number", "status", "words"),
    [(errno.ENOSPC, 507, "disk is full"), (errno.EROFS, 503, "cannot be used"), (errno.EACCES, 503, "cannot be used")],
)
def test_what_the_disk_does_not_take_is_refused_in_a_sentence_and_is_taken_later(
    client, motion, monkeypatch, number, status, words
):
    body, address = {"base": 0, "content": {"name": "x"}}, f"/api/documents/disk{number}"
    with monkeypatch.context() as patch:
        for name in ("write_text", "write"):
            patch.setattr(f"stmc.viewing.studio.storage.{name}", failing(OSError(number, os.strerror(number))))
        assert words in refused(client.put(address, json=body), status)
        assert words in refused(client.post("/api/motions", content=npz(motion)), status)
        job = client.post("/api/jobs", json={"timeline": WALK}).json()["job"]
        told = client.get(f"/api/jobs/{job}/events").text
        assert "event: failed" in told and words in told
    with monkeypatch.context() as patch:
        patch.setattr(Documents, "_path", failing(OSError(number, os.strerror(number))))
        assert words in refused(client.delete(address), status)
    assert client.put(address, json=body).status_code == 200


def test_too_little_memory_is_a_sentence(client, monkeypatch):
    monkeypatch.setattr("stmc.viewing.studio.server.check_timeline", failing(MemoryError()))
    assert "memory" in refused(client.post("/api/check", json={"timeline": WALK}), 503)


def test_a_defect_of_the_studio_itself_is_told_in_a_sentence_too(client, monkeypatch):
    monkeypatch.setattr("stmc.viewing.studio.server.check_timeline", failing(KeyError("surprise")))
    assert "terminal" in refused(client.post("/api/check", json={"timeline": WALK}), 500)


def test_nobody_else_can_look_into_the_folder(model, tmp_path, motion):
    folder = tmp_path / "own" / "studio"
    with studio(model, folder) as client:
        assert client.put("/api/documents/one", json={"base": 0, "content": {}}).status_code == 200
        assert client.post("/api/motions", content=npz(motion)).status_code == 201
        assert client.post("/api/check", json={"timeline": WALK}).status_code == 200
    found = [folder, *folder.rglob("*")]
    assert len(found) > 5
    for path in found:
        mode = stat.S_IMODE(path.stat().st_mode)
        assert mode == 0o700 if path.is_dir() else mode & ~0o644 == 0, (path, oct(mode))
    kept = [path for path in found if path.suffix in (".json", ".npz")]
    assert len(kept) == 2 and {stat.S_IMODE(path.stat().st_mode) for path in kept} == {0o600}


def test_what_is_no_file_among_documents_and_motions_stops_nothing(model, tmp_path):
    for name in ("documents", "motions"):
        (tmp_path / name).mkdir()
    (tmp_path / "documents" / "folder.json").mkdir()
    (tmp_path / "motions" / "folder.npz").mkdir()
    os.mkfifo(tmp_path / "documents" / "pipe.json")
    (tmp_path / "documents" / "device.json").symlink_to("/dev/zero")
    (tmp_path / "documents" / "text.json").write_bytes(b"\xff")
    with studio(model, tmp_path) as client:
        assert client.get("/api/documents").json() == {"documents": []}
        for name in ("folder", "pipe", "device", "text"):
            assert "damaged" in refused(client.get(f"/api/documents/{name}"), 422)
            assert "damaged" in refused(client.put(f"/api/documents/{name}", json={"base": 0, "content": {}}), 422)
        refused(client.delete("/api/documents/folder"), 503)
        assert "damaged" in refused(client.get("/api/motions/folder.glb"), 422)


def test_old_motions_go_while_the_studio_runs_and_those_of_documents_stay(tmp_path, motion, monkeypatch):
    monkeypatch.setattr("stmc.viewing.studio.storage.MOST_MOTIONS", 3)
    monkeypatch.setattr("stmc.viewing.studio.storage.PRUNE_AFTER", 5)
    named: list[str] = []
    motions = Motions(tmp_path, lambda: " ".join(named))
    named.append(motions.add(motion))
    for _ in range(19):
        last = motions.add(motion)
        time.sleep(0.01)
    left = {path.stem for path in tmp_path.glob("*.npz")}
    assert len(left) <= 3 + 5 and {named[0], last} <= left


def test_motions_are_bounded_in_bytes_too(tmp_path, motion, monkeypatch):
    monkeypatch.setattr("stmc.viewing.studio.storage.MOST_MOTION_BYTES", 1)
    motions = Motions(tmp_path)
    motions.add(motion)
    motions.prune()
    assert not list(tmp_path.glob("*.npz"))


# What a request may say

PROMPT = WALK["prompts"][0]


def strange(text: str) -> list[tuple[str, str, str]]:
    """Requests with a JSON value wherever a value may stand."""
    prompts = [json.dumps({"name": "n", "prompts": [PROMPT | {key: 7}]}).replace("7", text) for key in PROMPT]
    own = json.dumps(WALK)
    document = "/api/documents/strange"
    return [
        ("PUT", document, f'{{"base": {text}, "content": {{}}}}'),
        ("PUT", document, f'{{"base": 0, "content": {{"a": {text}}}}}'),
        *[
            ("POST", path, f'{{"timeline": {prompt}, "format": "json"}}')
            for prompt in prompts
            for path in ("/api/check", "/api/write", "/api/jobs")
        ],
        *[
            ("POST", "/api/jobs", f'{{"timeline": {own}, {asked.replace("7", text)}}}')
            for asked in (
                '"seeds": [7]',
                '"change": [{"start": 7, "end": 1, "parts": ["legs"]}]',
                '"change": [{"start": 0, "end": 1, "parts": [7]}]',
                '"constraints": [{"path": {"points": [[0, 0], [0, 7]]}}]',
                '"constraints": [{"path": {"points": [[0, 0], [0, 1]], "end": 7}}]',
                '"constraints": [{"heading": {"angle": 7}}]',
                '"constraints": [{"target": {"joint": "left_hand", "point": [0, 0, 7]}}]',
                '"constraints": [{"hold": {"joint": 7}}]',
                '"constraints": [{"keyframe": {"motion": 7, "at": 0}}]',
            )
        ],
    ]


STRANGE = {
    "NaN": "NaN", "Infinity": "-Infinity", "1e999": "1e999", "1e308": "1e308", "1e20": "1e20",
    "4300 digits": "9" * 4300, "400 digits": "9" * 400, "half a pair": '"\\ud800"',
    "half a pair as key": '{"\\udfff": 1}', "[[]]": "[[]]", "[{}]": "[{}]", "[null]": "[null]",
    "deep": "[" * 2000 + "]" * 2000,
}  # fmt: skip


@pytest.mark.parametrize("text", STRANGE.values(), ids=STRANGE)
def test_whatever_value_stands_in_a_request_the_answer_is_a_sentence(client, text):
    for method, path, body in strange(text):
        answer = client.request(method, path, content=body)
        assert answer.status_code < 300 or refused(answer, 400, 404, 409, 413, 422), (path, body[:200])


@pytest.mark.parametrize("text", [*list(STRANGE.values())[:4], '"\\ud800"'])
def test_what_cannot_be_written_to_a_file_is_no_document(client, text):
    answer = client.put("/api/documents/never", content=f'{{"base": 0, "content": {{"a": [{text}]}}}}')
    assert answer.status_code in (400, 422) and client.get("/api/documents/never").status_code == 404


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        ({"mocap_framerate": 1e-308}, "fps must be"),
        ({"mocap_framerate": 1e-3}, "fps must be"),
        ({"mocap_framerate": 1e6}, "fps must be"),
        ({"joints": 1e30}, "origin"),
    ],
)
def test_a_motion_beyond_what_the_studio_makes_is_refused(client, motion, changed, words):
    [(name, value)] = changed.items()
    own = np.load(io.BytesIO(npz(motion)))[name]
    answer = client.post("/api/motions", content=npz(motion, **{name: np.full_like(own, value)}))
    assert words in refused(answer, 422)


def npz(motion: stmc.Motion, **changed: np.ndarray) -> bytes:
    """A motion's file, with some of its arrays changed."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "motion.npz"
        stmc.write(motion, path)
        arrays = dict(np.load(path))
    file = io.BytesIO()
    np.savez(file, **(arrays | changed))
    return file.getvalue()


def test_too_many_letters_are_refused_before_any_is_read(client):
    prompts = [{"text": f"{number} " + "x" * 1000, "start": 0, "end": 1, "parts": []} for number in range(200)]
    began = time.monotonic()
    assert "shorten" in refused(client.post("/api/check", json={"timeline": {"prompts": prompts}}), 422)
    lines = "\n\n".join("a # 0 # 1" for _ in range(50_000))
    assert "letters" in refused(client.post("/api/read", json={"name": "a.txt", "text": lines}), 422)
    assert time.monotonic() - began < 1


def test_a_film_is_bounded_and_drawn_alone(client, motion, monkeypatch):
    name = client.post("/api/motions", content=npz(motion)).json()["motion"]["id"]
    drawing, may = threading.Event(), threading.Event()

    def drawn(motion, path, timeline):
        drawing.set()
        assert may.wait(timeout=60)
        path.write_bytes(b"film")

    monkeypatch.setattr("stmc.viewing.film.render_film", drawn)
    answers: list = []
    first = threading.Thread(target=lambda: answers.append(client.get(f"/api/motions/{name}.webp")))
    first.start()
    assert drawing.wait(timeout=60)
    assert "another film" in refused(client.get(f"/api/motions/{name}.webp"), 429)
    assert client.get(f"/api/motions/{name}.glb").status_code == 200
    may.set()
    first.join()
    assert answers[0].content == b"film"
    monkeypatch.setattr("stmc.io.bounds.MOST_PICTURES", 6)
    assert "6 pictures" in refused(client.get(f"/api/motions/{name}.webp"), 422)
    monkeypatch.setattr("stmc.viewing.studio.storage.MOST_FILM_FRAMES", 5)
    assert "frames" in refused(client.get(f"/api/motions/{name}.webp"), 422)


@pytest.mark.parametrize("path", ["/api/documents/", "/api/nothing", "/assets/none.js", "/nothing", "/assets/%00"])
def test_an_address_that_there_is_not_is_a_sentence_and_leads_nowhere(client, path):
    assert refused(client.get(path, follow_redirects=False), 404)


def test_nothing_of_the_interface_stays_in_the_browser_and_pages_are_asked_for_again(client):
    for path in ("/api/documents", "/api/model", "/api/nothing"):
        assert client.get(path).headers["cache-control"] == "no-store"
    for path in ("/", "/assets/main.js"):
        assert client.get(path).headers["cache-control"] == "no-cache"


def test_constraints_that_lead_out_of_all_bounds_name_themselves(client, monkeypatch):
    monkeypatch.setattr(
        client.app.state.jobs, "sample", failing(ValueError("rotations has values that are not finite"))
    )
    asked = {"timeline": WALK, "constraints": [{"path": {"points": [[0, 0], [0, 9000]]}}]}
    job = client.post("/api/jobs", json=asked).json()["job"]
    told = client.get(f"/api/jobs/{job}/events").text
    assert "constraints (path)" in told and "not finite" in told


# Connections


@pytest.fixture
def port(model, tmp_path, monkeypatch) -> Iterator[int]:
    """Of a server that waits for half a second alone."""
    monkeypatch.setattr(connections, "HEAD_SECONDS", 0.5)
    monkeypatch.setattr(auth, "BODY_SECONDS", 0.5)
    with loaded("studio").listen(0) as listening:
        port = listening.getsockname()[1]
        server = connections.server_of(application(model, tmp_path, Sessions(), port))
        thread = threading.Thread(target=server.run, kwargs={"sockets": [listening]})
        thread.start()
        yield port
        server.should_exit = True
        thread.join(timeout=60)


@pytest.mark.parametrize(
    "head", [b"", b"GET / HTTP/1.1\r\nHost: 127", b"GET / HTTP/1.1\r\nHost: 127.0.0.1:PORT\r\n\r\nGET"]
)
def test_a_connection_whose_request_stays_half_said_is_closed(port, head):
    with socket.create_connection(("127.0.0.1", port), timeout=30) as connection:
        connection.sendall(head.replace(b"PORT", str(port).encode()))
        while connection.recv(65536):
            pass


def test_answers_are_sent_at_once_rather_than_gathered():
    """Nagle's algorithm holds the body of an answer back until its head is acknowledged, which takes 40 ms."""

    async def accepted(listening: socket.socket) -> int:
        told = asyncio.get_running_loop().create_future()

        def answer(_, writer) -> None:
            told.set_result(writer.get_extra_info("socket"))

        async with await asyncio.start_server(answer, sock=listening):
            _, writer = await asyncio.open_connection(*listening.getsockname())
            nodelay = (await told).getsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY)
            writer.close()
        return nodelay

    with loaded("studio").listen(0) as listening:
        assert asyncio.run(accepted(listening))


def test_a_request_whose_body_stays_away_is_answered_and_closed(port):
    with socket.create_connection(("127.0.0.1", port), timeout=30) as connection:
        head = f"POST /api/session HTTP/1.1\r\nHost: 127.0.0.1:{port}\r\nContent-Length: 100\r\n\r\n{{"
        connection.sendall(head.encode())
        content = b""
        while part := connection.recv(65536):
            content += part
    assert b" 408 " in content.split(b"\r\n")[0] and b"did not come" in content


def test_a_web_socket_is_refused(port):
    with pytest.raises(InvalidStatus) as caught:
        connect(f"ws://127.0.0.1:{port}/api/jobs", origin=f"http://127.0.0.1:{port}")
    assert caught.value.response.status_code == 403 and b"no WebSockets" in caught.value.response.body


def test_a_browser_is_led_to_the_address_by_a_file_that_nobody_else_can_read(tmp_path):
    with loaded("studio").redirect_file(tmp_path, "http://127.0.0.1:1/#token=secret") as page:
        assert stat.S_IMODE(page.stat().st_mode) == 0o600 and "#token=secret" in page.read_text()
    assert not page.exists()
