"""`stmc stream`: lines of JSON, OSC bundles, edits on stdin, and ends that are clean."""

import io
import json
import socket
import threading

import pytest
from helpers.scripts import configured, loaded
from helpers.tiny_model import tiny
from pythonosc.osc_bundle import OscBundle
from pythonosc.osc_message import OscMessage

from stmc.settings.records import SettingError


@pytest.fixture
def run(monkeypatch, capsys):
    """Runs the command with a tiny model and lines on stdin; returns the lines on stdout."""

    def streamed(*settings: str, edits: str = "") -> list[dict]:
        command = loaded("stream")
        monkeypatch.setattr(command.stmc, "load", lambda *_, **__: tiny())
        monkeypatch.setattr("sys.stdin", io.StringIO(edits))
        config = configured("stream", "steps=1", "realtime=false", *settings)
        command.main.function(command.main.check(config))
        return [json.loads(line) for line in capsys.readouterr().out.splitlines()]

    return streamed


def test_frames_and_answers_are_lines_of_json(run):
    edits = '{"add": {"text": "wave", "seconds": 2}}\n\nnonsense\n[1]\n{"remove": 8}\n'
    head, *lines = run("timeline='walk # 0 # 2'", "seconds=3", edits=edits)
    assert head["fps"] == 20 and len(head["joints"]) == len(head["parents"]) == len(head["offsets"]) == 22
    frames = [line for line in lines if "root" in line]
    assert [frame["frame"] for frame in frames] == list(range(60)) and frames[-1]["seconds"] == 2.95
    assert all(len(frame["root"]) == 3 and len(frame["rotations"]) == 22 for frame in frames)
    assert sum(value * value for value in frames[0]["rotations"][5]) == pytest.approx(1, abs=1e-3)
    answers = [line for line in lines if "root" not in line]
    assert answers[0]["added"] == 1
    assert [answer.get("error", "")[:20] for answer in answers[1:]] == [
        "line 1, column 1: no", "edit: must be a JSON", "there is no prompt 8",
    ]  # fmt: skip


def test_the_library_decodes_what_goes_to_the_loopback(run):
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as engine:
        engine.bind(("127.0.0.1", 0))
        engine.settimeout(10)
        assert run(f"to='osc://127.0.0.1:{engine.getsockname()[1]}'", "seconds=0.1") == []
        first, *bundles = (engine.recv(65536) for _ in range(3))
    assert OscMessage(first).address == "/stmc/fps" and OscMessage(first).params == [20.0]
    for number, datagram in enumerate(bundles):
        messages = {message.address: message.params for message in OscBundle(datagram)}
        assert messages["/stmc/frame"] == pytest.approx([number, number / 20])
        assert len(messages["/stmc/root"]) == 3 and len(messages["/stmc/rotation/left_knee"]) == 4
        assert len(messages) == 24


@pytest.mark.parametrize(
    ("to", "words"),
    [
        ("osc://192.0.2.1:9000", "allow_remote=true"),
        ("osc://example.org:9000", "not this machine"),
        ("osc://127.0.0.1", "osc://HOST:PORT"),
        ("osc://127.0.0.1:99999", "osc://HOST:PORT"),
        ("udp://127.0.0.1:9000", "must be json, or osc"),
    ],
)
def test_outputs_that_are_none_or_far_away_are_refused(run, to, words):
    with pytest.raises(SettingError, match=words):
        run(f"to='{to}'")


def test_ctrl_c_ends_the_stream_and_its_thread(run, monkeypatch):
    def interrupt(self, frame):
        raise KeyboardInterrupt

    monkeypatch.setattr("stmc.cli.stream_outputs.JsonLines.write", interrupt)
    run()
    assert "stream" not in {thread.name for thread in threading.enumerate()}


def test_a_stream_plays_one_timeline(run, tmp_path):
    (tmp_path / "two.txt").write_text("walk # 0 # 1\n\nrun # 0 # 1\n")
    with pytest.raises(SettingError, match="2 timelines; a stream plays one"):
        run(f"timeline='{tmp_path / 'two.txt'}'")
