"""Where the frames of a stream go: lines of JSON on stdout, or Open Sound Control over UDP."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from ipaddress import ip_address
from typing import Any, Protocol, runtime_checkable
from urllib.parse import urlsplit

from stmc.editing.stream_frames import describe_frame, describe_stream
from stmc.editing.streaming import Frame, MotionStream
from stmc.io.extras import require
from stmc.io.untrusted import quote
from stmc.motion.body import JOINTS
from stmc.settings.records import SettingError


@runtime_checkable
class Output(Protocol):
    """What a stream writes to."""

    def begin(self, stream: MotionStream) -> None:
        """Describe the stream, before its first frame."""

    def write(self, frame: Frame) -> None:
        """Write a frame."""

    def answer(self, answer: dict[str, Any]) -> None:
        """Write the answer to an edit."""


@contextmanager
def open_output(to: str, allow_remote: bool) -> Iterator[Output]:
    """Open the output that `to` names: "json" or osc://HOST:PORT.

    Raises `SettingError` for another name, and for a host that is not this machine unless `allow_remote`.
    """
    if to == "json":
        yield JsonLines()
        return
    host, port = _address(to, allow_remote)
    require("pythonosc")
    from pythonosc.udp_client import UDPClient  # comes with an extra

    with UDPClient(host, port) as client:
        yield Osc(client)


class JsonLines:
    """One JSON object per line: the skeleton first, then frames and answers.

    Positions are in metres, z up; rotations are local quaternions, real part first, in the order of the joints.
    """

    def begin(self, stream: MotionStream) -> None:
        """Write the frame rate and the skeleton."""
        self._line(describe_stream(stream))

    def write(self, frame: Frame) -> None:
        """Write a frame."""
        self._line(describe_frame(frame))

    def answer(self, answer: dict[str, Any]) -> None:
        """Write an answer."""
        self._line(answer)

    def _line(self, data: dict[str, Any]) -> None:
        sys.stdout.write(json.dumps(data) + "\n")
        sys.stdout.flush()


class Osc:
    """A bundle per frame: /stmc/frame (number, seconds), /stmc/root (x, y, z) and /stmc/rotation/JOINT (w, x, y, z).

    /stmc/fps (frames per second) comes first. Answers to edits are lines of JSON on stdout.
    """

    def __init__(self, client: Any) -> None:
        self._client = client

    def begin(self, stream: MotionStream) -> None:
        """Send the frame rate."""
        self._client.send(_message("/stmc/fps", [float(stream.fps)]))

    def write(self, frame: Frame) -> None:
        """Send a frame."""
        from pythonosc.osc_bundle_builder import IMMEDIATELY, OscBundleBuilder

        pose = describe_frame(frame)
        bundle = OscBundleBuilder(IMMEDIATELY)
        bundle.add_content(_message("/stmc/frame", [frame.number, frame.seconds]))
        bundle.add_content(_message("/stmc/root", pose["root"]))
        for joint, rotation in zip(JOINTS, pose["rotations"], strict=False):
            bundle.add_content(_message(f"/stmc/rotation/{joint}", rotation))
        self._client.send(bundle.build())

    def answer(self, answer: dict[str, Any]) -> None:
        """Write an answer to stdout."""
        sys.stdout.write(json.dumps(answer) + "\n")
        sys.stdout.flush()


def _message(address: str, values: list[Any]) -> Any:
    from pythonosc.osc_message_builder import OscMessageBuilder

    builder = OscMessageBuilder(address)
    for value in values:
        builder.add_arg(value)
    return builder.build()


def _address(to: str, allow_remote: bool) -> tuple[str, int]:
    try:
        parts = urlsplit(to)
        host, port = parts.hostname, parts.port
    except ValueError:
        host = port = None
    if host is None or port is None or parts.scheme != "osc" or parts.path not in ("", "/"):
        raise SettingError(f"to={quote(to)}: must be json, or osc://HOST:PORT such as osc://127.0.0.1:9000")
    if not allow_remote and not _is_loopback(host):
        raise SettingError(f"to={quote(to)}: not this machine; allow_remote=true sends the motion there")
    return host, port


def _is_loopback(host: str) -> bool:
    try:
        return ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"
