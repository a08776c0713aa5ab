"""A headless Chromium for tests, spoken to in its DevTools protocol: enough to open a page, ask it and picture it."""

import base64
import io
import itertools
import json
import shutil
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from PIL import Image
from websockets.sync.client import ClientConnection, connect

PATH = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome", "chrome"))), None)
FLAGS = (
    "--headless", "--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader",
    "--no-first-run", "--disable-background-networking", "--disable-component-update", "--disable-extensions",
    "--hide-scrollbars", "--remote-debugging-port=0",
)  # fmt: skip
PATIENCE = 180.0
"""Seconds; a page that needs two on an idle machine may need many on a busy one."""


class Tab:
    """One page. `events` holds what the browser told meanwhile, as (method, params)."""

    def __init__(self, socket: ClientConnection) -> None:
        self._socket = socket
        self._numbers = itertools.count(1)
        self.events: list[tuple[str, dict]] = []

    def call(self, method: str, **params) -> dict:
        number = next(self._numbers)
        self._socket.send(json.dumps({"id": number, "method": method, "params": params}))
        while True:
            message = json.loads(self._socket.recv(timeout=PATIENCE))
            if message.get("id") == number:
                assert "error" not in message, message
                return message["result"]
            self.events.append((message.get("method", ""), message.get("params", {})))

    def ask(self, expression: str):
        """The value of a JavaScript expression."""
        return self.call("Runtime.evaluate", expression=expression, returnByValue=True)["result"].get("value")

    def wait(self, expression: str) -> None:
        """Until a JavaScript expression is true."""
        patience = time.monotonic() + PATIENCE
        while not self.ask(expression):
            assert time.monotonic() < patience, f"{expression} did not come true"
            time.sleep(0.1)

    def open(self, address: str) -> None:
        for domain in ("Page", "Runtime", "Network", "Log"):
            self.call(f"{domain}.enable")
        self.call("Page.navigate", url=address)

    def click(self, x: float, y: float) -> None:
        for kind in ("mousePressed", "mouseReleased"):
            self.call("Input.dispatchMouseEvent", type=kind, x=x, y=y, button="left", clickCount=1)

    def picture(self) -> np.ndarray:
        """What is to be seen, [height, width, 3] from 0 to 255."""
        data = base64.b64decode(self.call("Page.captureScreenshot")["data"])
        return np.asarray(Image.open(io.BytesIO(data)).convert("RGB")).astype(int)


@contextmanager
def tab(profile: Path, width: int, height: int) -> Iterator[Tab]:
    """A tab of a fresh browser, whose user profile is made in the folder `profile`."""
    command = [PATH, *FLAGS, f"--user-data-dir={profile}", f"--window-size={width},{height}", "about:blank"]
    browser = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        with connect(f"ws://127.0.0.1:{_port(profile)}/devtools/page/{_target(profile)}", max_size=None) as socket:
            yield Tab(socket)
    finally:
        browser.terminate()
        browser.wait(timeout=PATIENCE)


def _lines(profile: Path) -> list[str]:
    """The port and the address that the browser leaves in its profile once it listens."""
    patience = time.monotonic() + PATIENCE
    while time.monotonic() < patience:
        path = profile / "DevToolsActivePort"
        lines = path.read_text().split() if path.exists() else []
        if len(lines) == 2:
            return lines
        time.sleep(0.1)
    raise TimeoutError(f"Chromium did not start within {PATIENCE:g} s")


def _port(profile: Path) -> int:
    return int(_lines(profile)[0])


def _target(profile: Path) -> str:
    port, path = _lines(profile)
    with connect(f"ws://127.0.0.1:{port}{path}", max_size=None) as socket:
        infos = Tab(socket).call("Target.getTargets")["targetInfos"]
    return next(info["targetId"] for info in infos if info["type"] == "page")
