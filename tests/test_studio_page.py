"""The studio's page in a real browser, before a server with a tiny model: what hands and keys do, and what is kept."""

import base64
import dataclasses
import json
import os
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from threading import Thread

import numpy as np
import pytest
import uvicorn
from helpers import browser
from helpers.scripts import loaded
from helpers.tiny_model import Hashes, tiny

import stmc
from stmc.run import bundled
from stmc.run.directories import VOCABULARY
from stmc.studio import application
from stmc.vocabulary import read_vocabulary

pytestmark = [
    pytest.mark.browser,
    pytest.mark.slow,
    pytest.mark.skipif(browser.PATH is None, reason="no chromium on the PATH (Debian: apt-get install chromium)"),
]

TOKEN = "a secret"
PICTURES = os.environ.get("STMC_PICTURES")
"""A folder for pictures of each step, to be looked at."""
CONTROL, SHIFT = 2, 8
BARS = "[...document.querySelectorAll('.bar')].map(bar => bar.getAttribute('aria-label').split('. ').slice(0, 2))"


@contextmanager
def serving(folder: Path, port: int = 0) -> Iterator[int]:
    """The studio over a folder, at a port, until the end."""
    model = dataclasses.replace(tiny(), vocabulary=read_vocabulary(bundled() / VOCABULARY), text_encoder=Hashes())
    with loaded("studio").listen(port) as listening:
        port = listening.getsockname()[1]
        app = application(model, folder, TOKEN, port, steps=12)
        server = uvicorn.Server(uvicorn.Config(app, log_level="error", timeout_graceful_shutdown=1))
        thread = Thread(target=server.run, kwargs={"sockets": [listening]})
        thread.start()
        try:
            yield port
        finally:
            server.should_exit = True
            thread.join(timeout=browser.PATIENCE)


@pytest.fixture(scope="module")
def server(tmp_path_factory) -> Iterator[int]:
    with serving(tmp_path_factory.mktemp("studio")) as port:
        yield port


@contextmanager
def opened(port: int, folder: Path, width: int = 1280, height: int = 800) -> Iterator[browser.Tab]:
    """A tab with a new, empty timeline."""
    with browser.tab(folder / "profile", max(width, 500), height) as tab:
        tab.call("Emulation.setDeviceMetricsOverride", width=width, height=height, deviceScaleFactor=1, mobile=False)
        tab.open(f"http://127.0.0.1:{port}/?token={TOKEN}")
        ready(tab)
        yield tab
        assert [params for method, params in tab.events if method == "Runtime.exceptionThrown"] == []


@pytest.fixture
def tab(server, tmp_path) -> Iterator[browser.Tab]:
    with opened(server, tmp_path) as tab:
        yield tab


def ready(tab: browser.Tab) -> None:
    tab.wait("document.body !== null && document.body.dataset.ready === 'true'")


def picture(tab: browser.Tab, name: str) -> None:
    if PICTURES:
        Path(PICTURES, f"{name}.png").write_bytes(base64.b64decode(tab.call("Page.captureScreenshot")["data"]))


def press(tab: browser.Tab, key: str, modifiers: int = 0) -> None:
    code = {"Enter": 13, "Escape": 27, "Delete": 46, "ArrowLeft": 37, "ArrowUp": 38, "ArrowRight": 39, "ArrowDown": 40}
    text = {"text": {"Enter": "\r"}.get(key, key)} if key == "Enter" or (len(key) == 1 and not modifiers) else {}
    known = {"windowsVirtualKeyCode": code[key]} if key in code else {}
    for kind in ("keyDown", "keyUp"):
        tab.call("Input.dispatchKeyEvent", type=kind, key=key, modifiers=modifiers, **known, **text)


def box(tab: browser.Tab, selector: str) -> dict:
    return tab.ask(f"document.querySelector({json.dumps(selector)}).getBoundingClientRect().toJSON()")


def click(tab: browser.Tab, selector: str) -> None:
    tab.wait(f"document.querySelector({json.dumps(selector)}) !== null")
    place = box(tab, selector)
    tab.click(place["left"] + place["width"] / 2, place["top"] + place["height"] / 2)


def drag(tab: browser.Tab, start: tuple[float, float], end: tuple[float, float]) -> None:
    def mouse(kind: str, share: float, buttons: int) -> None:
        x, y = (one + share * (other - one) for one, other in zip(start, end, strict=True))
        tab.call("Input.dispatchMouseEvent", type=kind, x=x, y=y, button="left", buttons=buttons, clickCount=1)

    mouse("mousePressed", 0, 1)
    for share in (0.3, 0.7, 1):
        mouse("mouseMoved", share, 1)
    mouse("mouseReleased", 1, 0)


def write(tab: browser.Tab, text: str) -> None:
    """A prompt at the cursor, with keys."""
    count = tab.ask("document.querySelectorAll('.bar').length")
    press(tab, "n")
    tab.wait("document.activeElement.matches('.bar input')")
    tab.call("Input.insertText", text=text)
    press(tab, "Enter")
    tab.wait(f"document.querySelectorAll('.bar:not([data-key=draft])').length === {count + 1}")


def shown(tab: browser.Tab, other_than: str = "") -> str:
    """The names of the motions on the stage, once nothing is made any more."""
    tab.wait(f"(document.body.dataset.shown || '') !== {json.dumps(other_than)}")
    tab.wait("document.getElementById('progress').hidden && document.getElementById('stage').ariaBusy === 'false'")
    return tab.ask("document.body.dataset.shown")


def automatic(tab: browser.Tab, on: bool) -> None:
    click(tab, "#tab-samples")
    click(tab, "[data-key=auto]")
    tab.wait(f"document.querySelector('[data-key=auto]').checked === {json.dumps(on)}")


# ---- the document alone ---------------------------------------------------------------------------------------------


def test_ten_thousand_random_edits_end_in_the_timeline_made_at_once_and_can_all_be_undone_and_redone(tab):
    edits = (Path(__file__).parent / "helpers" / "random_edits.js").read_text("utf-8")
    tab.ask("import('/assets/state.js').then((state) => { window.state = state; })")
    tab.wait("window.state !== undefined")
    result = tab.ask(f"({edits})(window.state, 1, 10000)")
    assert result["problems"] == []
    assert result["untried"] == []
    assert result["steps"] > 4000


# ---- hands and keys -------------------------------------------------------------------------------------------------


def test_a_timeline_is_written_moved_stretched_split_and_deleted_with_keys_alone_and_all_of_it_undone(tab):
    automatic(tab, False)
    write(tab, "walk forwards")
    press(tab, "ArrowRight", CONTROL)  # by 1 s
    press(tab, "ArrowRight", SHIFT)  # its end
    tab.wait(f"{BARS}[0][1].startsWith('1 s to 4.1 s')")
    press(tab, "5")
    tab.wait("document.querySelector('[data-key=\"part-spine\"]').getAttribute('aria-pressed') === 'true'")
    write(tab, "wave with the left hand")
    assert tab.ask(f"{BARS}.map(([text, where]) => [text, where.split(', ')[1]])") == [
        ["walk forwards", "track 1"],
        ["wave with the left hand", "track 2"],
    ]
    press(tab, "d")
    tab.wait("document.querySelectorAll('.bar').length === 3")
    press(tab, "Delete")
    tab.wait("document.querySelectorAll('.bar').length === 2")
    for _ in range(20):
        press(tab, "z", CONTROL)
    tab.wait("document.querySelectorAll('.bar').length === 0")
    assert tab.ask("document.getElementById('undo').disabled")
    for _ in range(20):
        press(tab, "z", CONTROL | SHIFT)
    tab.wait("document.querySelectorAll('.bar').length === 2")
    assert tab.ask("document.getElementById('redo').disabled")


def test_a_dragged_end_snaps_to_the_edge_of_another_prompt(tab):
    automatic(tab, False)
    write(tab, "walk")
    write(tab, "wave")
    press(tab, "ArrowRight", SHIFT)  # ends at 3.1 s
    tab.wait(f"{BARS}[1][1].startsWith('0 s to 3.1 s')")
    bar = box(tab, ".bar")
    second = bar["width"] / 3
    drag(
        tab,
        (bar["right"] - 3, bar["top"] + 15),
        (bar["right"] - 3 + 0.1 * second - 4, bar["top"] + 15),
    )
    tab.wait(f"{BARS}[0][1].startsWith('0 s to 3.1 s')")


def test_the_page_asks_nobody_but_its_server(tab):
    urls = [params["request"]["url"] for method, params in tab.events if method == "Network.requestWillBeSent"]
    assert {url.split("/")[2] for url in urls if url.startswith("http")} == {urls[0].split("/")[2]}
    assert {url.split(":")[0] for url in urls} <= {"http", "data", "blob"}


# ---- motions --------------------------------------------------------------------------------------------------------


def test_a_motion_is_made_kept_made_anew_constrained_taken_away_and_restored(tab, tmp_path):
    write(tab, "walk")
    first = shown(tab)
    picture(tab, "1_generated")
    press(tab, "ArrowLeft", SHIFT)
    second = shown(tab, first)
    press(tab, "z", CONTROL)
    assert shown(tab, second) == first  # the past brings its motion along

    click(tab, "#part-rows .row:nth-child(1) .label")  # the left arm is kept
    click(tab, "#generate")
    third = shown(tab, first)
    assert np.allclose(*(rotations(tab, motion)["left_elbow"] for motion in (first, third)), atol=1e-6)

    click(tab, "#tab-constraints")
    click(tab, "[data-key=add-hold]")
    fourth = shown(tab, third)
    tab.wait("document.querySelector('.constraints .error') !== null")
    assert float(tab.ask("document.querySelector('.constraints .error').textContent").split()[0]) < 2
    picture(tab, "2_constrained")

    tab.call("Browser.setDownloadBehavior", behavior="allow", downloadPath=str(tmp_path))
    click(tab, "#export")
    click(tab, "#export-motion")
    tab.wait("document.getElementById('export-told').textContent === 'Saved.'")
    picture(tab, "3_export")
    while not list(tmp_path.glob("*.glb")):
        time.sleep(0.1)

    tab.wait("document.getElementById('saved').textContent === 'Saved'")
    tab.ask("location.reload()")
    time.sleep(0.5)
    ready(tab)
    tab.wait(f"document.body.dataset.shown === {json.dumps(fourth)}")
    assert tab.ask("document.querySelectorAll('.bar').length") == 1
    picture(tab, "4_restored")


def rotations(tab: browser.Tab, motion: str) -> dict[str, np.ndarray]:
    """Of each joint of a motion of the server: [frames, 3, 3]."""
    data = tab.call(
        "Runtime.evaluate",
        expression=f"fetch('/api/motions/{motion}.npz').then((answer) => answer.arrayBuffer())"
        ".then((bytes) => btoa(Array.from(new Uint8Array(bytes), (byte) => String.fromCharCode(byte)).join('')))",
        awaitPromise=True,
        returnByValue=True,
    )["result"]["value"]
    path = Path(os.environ.get("TMPDIR", "/tmp")) / f"{motion}.npz"
    path.write_bytes(base64.b64decode(data))
    read = stmc.read(path)
    path.unlink()
    return dict(zip(stmc.body.JOINTS, read.rotations.transpose(0, 1).numpy(), strict=False))


def test_samples_stand_side_by_side_and_a_pinned_one_stays_when_others_are_made(tab):
    write(tab, "walk")
    shown(tab)
    click(tab, "#tab-samples")
    click(tab, "[data-key=count-2]")
    tab.wait("document.body.dataset.shown.split(' ').length === 3")
    several = shown(tab)
    assert tab.ask("document.querySelectorAll('.view').length") == 3
    picture(tab, "5_samples")
    click(tab, "[data-key^=pin-]")
    tab.wait("document.querySelectorAll('.favourites li').length === 1")
    click(tab, "[data-key=dice]")
    others = shown(tab, several)
    assert not set(others.split()) & set(several.split())
    click(tab, "[data-key^=use-]")
    tab.wait(f"document.body.dataset.shown === {json.dumps(several.split()[0])}")
    picture(tab, "6_favourite")


# ---- what is kept ---------------------------------------------------------------------------------------------------


def test_of_two_tabs_that_change_one_document_the_second_is_asked(tab):
    automatic(tab, False)
    write(tab, "walk")
    tab.wait("document.getElementById('saved').textContent === 'Saved'")
    time.sleep(1)
    theirs = """(async () => {
      const place = "/api/documents/" + location.hash.slice(1);
      const { version, content } = await (await fetch(place)).json();
      const changed = { ...content, writer: "another", document: { ...content.document, name: "Theirs" } };
      const body = JSON.stringify({ base: version, content: changed });
      await fetch(place, { method: "PUT", headers: { "X-Stmc": "1" }, body });
    })()"""
    tab.call("Runtime.evaluate", expression=theirs, awaitPromise=True)
    tab.ask("document.querySelector('.bar').focus()")
    press(tab, "ArrowRight", SHIFT)
    tab.wait("document.getElementById('conflict-dialog').open")
    picture(tab, "7_conflict")
    click(tab, "#conflict-theirs")
    tab.wait("document.getElementById('name').value === 'Theirs'")
    assert tab.ask(f"{BARS}[0][1]").startswith("0 s to 3 s")


def test_what_is_written_while_the_server_is_away_is_there_once_it_is_back(tmp_path):
    with ExitStack() as stack:
        with serving(tmp_path / "studio") as port:
            tab = stack.enter_context(opened(port, tmp_path))
            automatic(tab, False)
            write(tab, "walk")
            time.sleep(1)
            tab.wait("document.getElementById('saved').textContent === 'Saved'")
        press(tab, "ArrowRight", SHIFT)
        tab.wait("document.getElementById('saved').dataset.state === 'away'")
        picture(tab, "8_away")
        with serving(tmp_path / "studio", port):
            tab.wait("document.getElementById('saved').textContent === 'Saved'")
            tab.ask("localStorage.clear(); delete document.body.dataset.ready; location.reload()")
            ready(tab)
            tab.wait(f"{BARS}[0] && {BARS}[0][1].startsWith('0 s to 3.1 s')")


# ---- a phone --------------------------------------------------------------------------------------------------------


def test_a_phone_s_width_is_enough(server, tmp_path):
    with opened(server, tmp_path, 390, 844) as tab:
        assert tab.ask("document.documentElement.scrollWidth") <= 390
        click(tab, "#add")
        tab.wait("document.activeElement.matches('.bar input')")
        tab.call("Input.insertText", text="walk")
        press(tab, "Enter")
        shown(tab)
        picture(tab, "9_phone")
        assert tab.ask("document.documentElement.scrollWidth") <= 390
        order = (
            "['stage', 'player', 'tracks', 'side'].map((id) => document.getElementById(id).getBoundingClientRect().top)"
        )
        tops = tab.ask(order)
        assert tops == sorted(tops)
