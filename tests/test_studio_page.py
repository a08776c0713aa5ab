"""The studio's page in a real browser, before a server with a tiny model: what hands and keys do, and what is kept."""

import base64
import itertools
import json
import os
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from threading import Event, Thread

import numpy as np
import pytest
from helpers import browser
from helpers.scripts import ROOT, loaded
from helpers.studio import knowing
from PIL import Image

import stmc
from stmc.editing.constraints import KINDS
from stmc.evaluation.verification import Missed
from stmc.viewing.studio import Documents, Sessions, application
from stmc.viewing.studio.connections import server_of
from stmc.viewing.studio.job_queue import Cancelled
from stmc.viewing.studio.request_errors import RequestError

pytestmark = [
    pytest.mark.browser,
    pytest.mark.slow,
    pytest.mark.skipif(browser.PATH is None, reason="no chromium on the PATH (Debian: apt-get install chromium)"),
]

SESSIONS: dict[int, Sessions] = {}
"""Of the server at each port; one that is started again there knows the pages of before."""
PICTURES = os.environ.get("STMC_PICTURES")
"""A folder for pictures of each step, to be looked at."""
CONTROL, SHIFT = 2, 8
KEY = "{ headers: { Authorization: 'Bearer ' + localStorage.getItem('stmc-studio-key') } }"
"""Of a request that the test has the page make."""
BARS = "[...document.querySelectorAll('.bar')].map(bar => bar.getAttribute('aria-label').split('. ').slice(0, 2))"


def find_missed(model: stmc.Model, timeline: stmc.Timeline, motion: stmc.Motion) -> list[Missed]:
    """No motion shows a somersault."""
    return [Missed(each.text, each.start, each.end, "leap") for each in timeline.prompts if "somersault" in each.text]


@contextmanager
def serving(folder: Path, port: int = 0, steps: int = 12) -> Iterator[int]:
    """The studio over a folder, at a port, until the end. It is nobody's first visit: there is a document."""
    with suppress(RequestError):
        Documents(folder / "documents").put("old", 0, {"name": "Of before"})
    with loaded("studio").listen(port) as listening:
        port = listening.getsockname()[1]
        sessions = SESSIONS.setdefault(port, Sessions())
        model = replace(knowing(), sampling=stmc.Sampling(restate_from=0.7))
        server = server_of(application(model, folder, sessions, port, steps, find_missed))
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
def opened(port: int, folder: Path, width: int = 1280, height: int = 800, plays: bool = False) -> Iterator[browser.Tab]:
    """A tab with a new, empty timeline; it plays nothing by itself."""
    with browser.tab(folder / "profile", max(width, 500), height) as tab:
        tab.call("Emulation.setDeviceMetricsOverride", width=width, height=height, deviceScaleFactor=1, mobile=False)
        if not plays:
            still = [{"name": "prefers-reduced-motion", "value": "reduce"}]
            tab.call("Emulation.setEmulatedMedia", features=still)
        tab.open(f"http://127.0.0.1:{port}/#token={SESSIONS[port].invite()}")
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


def field(tab: browser.Tab, selector: str, text: str) -> None:
    """Types into a field in place of what is there, and leaves it."""
    click(tab, selector)
    tab.ask("document.activeElement.select()")
    tab.call("Input.insertText", text=text)
    tab.ask("document.activeElement.blur()")


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


def test_a_document_of_before_keeps_the_one_setting_that_it_had(tab):
    tab.ask("import('/assets/state.js').then((state) => { window.state = state; })")
    tab.wait("window.state !== undefined")
    told = "({settings, cleanFeet}) => [settings, cleanFeet ?? null]"
    for written, settings in (
        ("{cleanFeet: false}", {"clean_feet": False}),
        ("{}", {"clean_feet": True}),
        ("{settings: {guidance: 4}}", {"clean_feet": True, "guidance": 4}),
    ):
        assert tab.ask(f"({told})(state.restored({{...state.emptyDocument(), settings: {{}}, ...{written}}}))") == [
            settings,
            None,
        ]


def test_a_control_of_a_setting_reaches_the_request_and_the_document(tab):
    watch = "window.sent = []; const post = window.fetch; window.fetch = (place, more) => {"
    tab.ask(
        f"(() => {{ {watch} if (`${{place}}` === '/api/jobs') sent.push(more.body); return post(place, more); }} }})()"
    )
    write(tab, "walk")
    first = shown(tab)
    click(tab, "#tab-samples")
    click(tab, "[data-key=feet]")
    tab.wait("sent.length === 2")
    shown(tab, first)
    bodies = [json.loads(body) for body in tab.ask("sent")]
    assert [body["clean_feet"] for body in bodies] == [True, False]
    saved(tab)


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


def test_enter_applies_a_text_in_the_panel_and_escape_leaves_a_field_at_once(tab):
    automatic(tab, False)
    write(tab, "walk")
    click(tab, "#tab-prompt")
    click(tab, "#panel-prompt textarea")
    tab.ask("document.activeElement.select()")
    tab.call("Input.insertText", text="run")
    press(tab, "Enter")
    tab.wait(f"{BARS}[0] && {BARS}[0][0] === 'run'")
    tab.wait("document.activeElement.matches('.bar')")
    click(tab, "#panel-prompt input[data-key^=end]")
    tab.ask("document.activeElement.select()")
    tab.call("Input.insertText", text="9")
    press(tab, "Escape")
    assert tab.ask("document.activeElement === document.body")
    assert tab.ask(f"{BARS}[0][1]").startswith("0 s to 3 s")
    write(tab, "wave")  # N is a key of the page again


def test_with_a_model_of_few_steps_the_motion_follows_a_text_while_it_is_typed(tmp_path):
    with serving(tmp_path / "studio", steps=4) as port, opened(port, tmp_path) as tab:
        write(tab, "walk")
        first = shown(tab)
        for text, finish, left in (("run", "Enter", "run"), ("wave", "Escape", "run")):
            press(tab, "Enter")
            tab.wait("document.activeElement.matches('.bar input')")
            before = shown(tab)
            tab.call("Input.insertText", text=text)
            typed = shown(tab, before)  # nothing but a pause came between
            assert tab.ask("document.activeElement.matches('.bar input')")
            assert tab.ask("document.activeElement.value") == text
            press(tab, finish)
            tab.wait(f"document.body.dataset.shown === {json.dumps(typed if text == left else before)}")
            tab.wait(f"{BARS}[0][0] === {json.dumps(left)}")
        press(tab, "z", CONTROL)  # the text as a whole is one step
        tab.wait(f"{BARS}[0][0] === 'walk'")
        tab.wait(f"document.body.dataset.shown === {json.dumps(first)}")


def test_with_a_model_of_few_steps_a_new_prompt_moves_while_it_is_typed(tmp_path):
    with serving(tmp_path / "studio", steps=4) as port, opened(port, tmp_path) as tab:
        write(tab, "walk")
        first = shown(tab)
        for text, more, finish in (("wa", "ve", "Enter"), ("run", "", "Escape")):
            before = shown(tab)
            bars = tab.ask(BARS)
            press(tab, "n")
            tab.wait("document.activeElement.matches('.bar input')")
            tab.call("Input.insertText", text=text)
            typed = shown(tab, before)
            tab.call("Input.insertText", text=more)
            if more:
                typed = shown(tab, typed)
            assert tab.ask("document.activeElement.value") == text + more
            assert tab.ask("document.querySelectorAll('.bar').length") == len(bars) + 1  # the prompt is not drawn twice
            press(tab, finish)
            tab.wait(f"document.body.dataset.shown === {json.dumps(typed if finish == 'Enter' else before)}")
            tab.wait(f"document.querySelectorAll('.bar').length === {len(bars) + (finish == 'Enter')}")
        assert [text for text, _ in tab.ask(BARS)] == ["walk", "wave"]
        press(tab, "z", CONTROL)  # the prompt is one step, and the one that was taken back none
        tab.wait(f"{BARS}.length === 1")
        tab.wait(f"document.body.dataset.shown === {json.dumps(first)}")


COUNT = """(() => {
  window.counted = { linkProgram: 0, createBuffer: 0, deleteBuffer: 0 };
  for (const name in counted) {
    const own = WebGL2RenderingContext.prototype[name];
    WebGL2RenderingContext.prototype[name] = function (...given) { counted[name]++; return own.apply(this, given); };
  }
})()"""


def test_another_motion_is_drawn_with_the_shaders_of_the_one_before_which_leaves_nothing(tab):
    write(tab, "walk")
    motion = shown(tab)
    tab.ask("requestAnimationFrame(() => requestAnimationFrame(() => (window.drawn = true)))")
    tab.wait("window.drawn")
    tab.ask(COUNT)
    for _ in range(2):
        press(tab, "ArrowLeft", SHIFT)
        motion = shown(tab, motion)
    tab.wait("counted.createBuffer > 0 && counted.createBuffer === counted.deleteBuffer")
    assert tab.ask("counted.linkProgram") == 0


def test_an_end_that_is_held_at_the_window_s_edge_goes_on(tab):
    automatic(tab, False)
    write(tab, "walk")
    grip = box(tab, ".bar .grip.end")
    start = (grip["left"] + grip["width"] / 2, grip["top"] + grip["height"] / 2)
    tab.call(
        "Input.dispatchMouseEvent", type="mousePressed", x=start[0], y=start[1], button="left", buttons=1, clickCount=1
    )
    for x in (start[0] + 40, 1275):
        tab.call("Input.dispatchMouseEvent", type="mouseMoved", x=x, y=start[1], button="left", buttons=1)
    tab.wait(f"parseFloat({BARS}[0][1].split(' to ')[1]) > 9")
    tab.call("Input.dispatchMouseEvent", type="mouseReleased", x=1275, y=start[1], button="left", clickCount=1)
    tab.wait("document.getElementById('lanes').offsetWidth <= document.getElementById('scroller').clientWidth")
    press(tab, "z", CONTROL)
    tab.wait(f"{BARS}[0][1].startsWith('0 s to 3 s')")


@pytest.mark.parametrize("zooms", [0, 3])
def test_no_number_of_the_ruler_is_cut_at_its_end(tab, zooms):
    for _ in range(zooms):
        press(tab, "+")
    cut = """[...document.querySelectorAll('#ruler b')].filter((mark) => {
      const text = document.createRange();
      text.selectNodeContents(mark);
      return text.getBoundingClientRect().right > document.getElementById('lanes').getBoundingClientRect().right;
    }).length"""
    assert tab.ask("document.querySelectorAll('#ruler b').length") > 3 and tab.ask(cut) == 0


def test_where_nothing_known_is_near_the_words_are_offered(tab):
    automatic(tab, False)
    write(tab, "qwxz vvv kkk")
    click(tab, "#tab-prompt")
    tab.wait("document.querySelector('#panel-prompt .advice') !== null")
    assert "It knows nothing near." in tab.ask("document.querySelector('#panel-prompt .advice').textContent")
    click(tab, "#panel-prompt [data-key=words]")
    assert tab.ask("document.getElementById('tab-words').ariaSelected") == "true"
    assert "cartwheel" in tab.ask("document.querySelector('#panel-words ul').parentElement.textContent")
    topics = tab.ask("[...document.querySelectorAll('#panel-words h3')].map((each) => each.textContent)")
    assert {"locomotion", "sport"} <= set(topics)


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
    read = motion_of(tab, motion)
    return dict(zip(stmc.motion.body.JOINTS, read.rotations.transpose(0, 1).numpy(), strict=False))


def motion_of(tab: browser.Tab, motion: str) -> stmc.Motion:
    """A motion of the server."""
    data = tab.call(
        "Runtime.evaluate",
        expression=f"fetch('/api/motions/{motion}.npz', {KEY}).then((answer) => answer.arrayBuffer())"
        ".then((bytes) => btoa(Array.from(new Uint8Array(bytes), (byte) => String.fromCharCode(byte)).join('')))",
        awaitPromise=True,
        returnByValue=True,
    )["result"]["value"]
    path = Path(os.environ.get("TMPDIR", "/tmp")) / f"{motion}.npz"
    path.write_bytes(base64.b64decode(data))
    read = stmc.read(path)
    path.unlink()
    return read


def test_a_heading_is_demanded_shown_on_the_tracks_and_met(tab):
    write(tab, "walk")
    first = shown(tab)
    click(tab, "#tab-constraints")
    click(tab, "[data-key=add-heading]")
    second = shown(tab, first)
    field(tab, "#panel-constraints [data-key^=start]", "1")  # a motion begins as it does: the body needs time to turn
    third = shown(tab, second)
    field(tab, "[data-key^=angle]", "45")
    turned = shown(tab, third)
    tab.wait("document.querySelector('.constraints .error') !== null")
    told = float(tab.ask("document.querySelector('.constraints .error').textContent").removesuffix("°"))
    headings = motion_of(tab, turned).heading[20:40].numpy()
    off = np.degrees(np.abs(headings - np.pi / 4)).max()
    assert off == pytest.approx(told, abs=0.05 + 1e-3)  # one decimal
    assert told < 20
    row, lane, width = box(tab, ".demand i"), box(tab, "#ruler"), box(tab, ".bar")["width"] / 3
    assert (row["left"] - lane["left"], row["width"]) == pytest.approx((width, width), abs=1)
    title = "Heading 45° to the left, 1\u00a0s to 2\u00a0s"
    assert tab.ask("document.querySelector('.demand .label').ariaLabel") == title
    picture(tab, "10_heading")
    click(tab, "#tab-samples")
    click(tab, ".demand .label")
    tab.wait("!document.getElementById('panel-constraints').hidden")


def test_a_kind_of_constraint_that_the_page_does_not_know_is_added_edited_and_measured(server, tmp_path, monkeypatch):
    """The one that docs/extending/constraint.md makes: the server's description is all that the page needs."""
    source = (ROOT / "docs/extending/constraint.md").read_text("utf-8").split("```python\n")[1].split("model = ")[0]
    space: dict = {"__name__": "somebodys_module"}
    exec(source, space)
    for module in ("stmc.editing.constraints.reading", "stmc.viewing.studio.model_json"):
        monkeypatch.setattr(f"{module}.KINDS", (*KINDS, space["Below"]))
    with opened(server, tmp_path) as tab:
        write(tab, "walk")
        first = shown(tab)
        click(tab, "#tab-constraints")
        click(tab, "[data-key=add-below]")
        second = shown(tab, first)
        assert tab.ask("document.querySelector('.demand .label').ariaLabel").startswith("Below of the head")
        field(tab, "[data-key^=height]", "1.25")
        third = shown(tab, second)
        tab.wait("document.querySelector('.constraints .error') !== null")
        told = float(tab.ask("document.querySelector('.constraints .error').textContent").split()[0])
        head = stmc.motion.body.JOINTS.index("head")
        above = 100 * (motion_of(tab, third).joints[:20, head, 2] - 1.25).clamp(min=0)
        assert float(above.max()) == pytest.approx(told, abs=0.05 + 1e-3)
        assert nameless(tab) == []


def test_a_path_can_be_typed_instead_of_drawn_and_what_was_measured_for_another_one_is_not_shown(tab):
    write(tab, "walk")
    first = shown(tab)
    click(tab, "#tab-constraints")
    click(tab, "[data-key=add-path]")
    click(tab, "[data-key=type-path]")
    shown(tab, first)
    tab.wait("document.querySelectorAll('.constraints .error').length === 1")
    automatic(tab, False)
    click(tab, "#tab-constraints")
    field(tab, "[data-key^=points]", "0, 0; 1, -2; 3, -2")
    tab.wait("document.querySelectorAll('.constraints .error').length === 0")


def test_a_path_that_is_drawn_begins_where_the_figure_stands_and_not_at_the_hand(tab):
    write(tab, "walk")
    shown(tab)
    automatic(tab, False)
    click(tab, "#tab-constraints")
    click(tab, "[data-key=add-path]")
    tab.wait("document.querySelector('#stage canvas.drawing') !== null")
    stage = box(tab, "#stage canvas")
    x, y = stage["left"] + stage["width"] / 2, stage["top"] + stage["height"]
    drag(tab, (x + 150, y - 60), (x - 150, y - 30))
    tab.wait("document.querySelector('[data-key^=points]') !== null")
    points = tab.ask("document.querySelector('[data-key^=points]').value").split("; ")
    begins = [float(each) for each in points[0].split(",")]
    assert len(points) > 1 and max(map(abs, begins)) < 0.05  # a motion starts at the origin


def test_every_format_is_taken_away_at_another_frame_rate_and_as_a_loop(tab, tmp_path):
    write(tab, "walk")
    shown(tab)
    tab.call("Browser.setDownloadBehavior", behavior="allow", downloadPath=str(tmp_path))
    click(tab, "#export")

    def exported(kind: str, name: str) -> Path:
        (tmp_path / name).unlink(missing_ok=True)
        click(tab, f"#export-formats input[value={kind}]")
        click(tab, "#export-motion")
        tab.wait("!document.getElementById('export-motion').disabled")
        assert tab.ask("document.getElementById('export-told').textContent") == "Saved."
        patience = time.monotonic() + browser.PATIENCE
        while not (tmp_path / name).exists():
            assert time.monotonic() < patience, f"{name} has not come"
            time.sleep(0.1)
        return tmp_path / name

    made = stmc.read(exported("npz", "Untitled.npz"))
    assert (made.frames, made.fps) == (60, 20)
    assert stmc.read(exported("bvh", "Untitled.bvh")).frames == 60
    assert np.loadtxt(exported("csv", "Untitled.csv"), delimiter=",", skiprows=1).shape == (60, 1 + 7 + 4 * 21)
    assert exported("html", "Untitled.html").read_text("utf-8").lower().startswith("<!doctype html>")
    tab.ask("document.getElementById('export-fps').value = '30'")
    assert stmc.read(exported("bvh", "Untitled.bvh")).frames == 90
    tab.ask("document.getElementById('export-fps').value = '20'")
    click(tab, "#export-loop")
    frames = stmc.read(exported("npz", "Untitled_loop.npz")).frames
    assert 16 <= frames < 60
    with Image.open(exported("webp", "Untitled_loop.webp")) as film:
        assert film.n_frames == frames
    picture(tab, "11_exported")
    tab.ask("document.getElementById('export-dialog').close()")
    click(tab, "#export")
    assert tab.ask("document.getElementById('export-told').textContent") == ""


def test_a_film_is_cancelled_when_its_page_is_closed(tab, monkeypatch):
    began, cancelled = Event(), Event()

    def render(motion, path, timeline, progress):
        try:
            for _ in progress(itertools.count(), total=motion.frames):
                began.set()
                time.sleep(0.02)
        except Cancelled:
            cancelled.set()
            raise

    monkeypatch.setattr("stmc.viewing.film.render_film", render)
    write(tab, "walk")
    shown(tab)
    click(tab, "#export")
    click(tab, "#export-formats input[value=webp]")
    click(tab, "#export-motion")
    tab.wait("!document.getElementById('film').hidden")
    assert began.wait(browser.PATIENCE) and not cancelled.is_set()
    tab.call("Page.navigate", url="about:blank")
    assert cancelled.wait(browser.PATIENCE)


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
      const headers = { Authorization: `Bearer ${localStorage.getItem("stmc-studio-key")}` };
      const { version, content } = await (await fetch(place, { headers })).json();
      const changed = { ...content, writer: "another", document: { ...content.document, name: "Theirs" } };
      const body = JSON.stringify({ base: version, content: changed });
      await fetch(place, { method: "PUT", headers, body });
    })()"""
    tab.call("Runtime.evaluate", expression=theirs, awaitPromise=True)
    tab.ask("document.querySelector('.bar').focus()")
    press(tab, "ArrowRight", SHIFT)
    tab.wait("document.getElementById('conflict-dialog').open")
    picture(tab, "7_conflict")
    click(tab, "#conflict-theirs")
    tab.wait("document.getElementById('name').value === 'Theirs'")
    assert tab.ask(f"{BARS}[0][1]").startswith("0 s to 3 s")


def test_two_tabs_keep_mine_and_keep_both_and_no_click_beside_the_question_leaves_it_open(tab, server, tmp_path):
    automatic(tab, False)
    write(tab, "walk")
    saved(tab)
    with opened(server, tmp_path / "other") as other:
        document = tab.ask("location.hash")
        other.ask(f"location.hash = {json.dumps(document)}")
        other.wait(f"{BARS}.length === 1")

        stretch(other)  # to 3.1 s
        saved(other)
        stretch(tab, 2)  # to 3.2 s
        tab.wait("document.getElementById('conflict-dialog').open")
        tab.click(5, 5)
        press(tab, "Escape")
        press(tab, "Escape")
        tab.wait("document.getElementById('conflict-dialog').open")
        click(tab, "#conflict-mine")
        saved(tab)
        assert ends(tab, document) == [3.2]

        stretch(other, 3)  # to 3.4 s, of what was 3.1 s long
        other.wait("document.getElementById('conflict-dialog').open")
        click(other, "#conflict-both")
        other.wait(f"location.hash !== {json.dumps(document)}")
        saved(other)
        assert ends(tab, document) == [3.2]
        assert ends(other, other.ask("location.hash")) == [3.4]
        assert other.ask("document.getElementById('name').value") == "Untitled (copy)"


def test_a_tab_where_nobody_has_edited_is_not_asked(tab, server, tmp_path):
    automatic(tab, False)
    write(tab, "walk")
    saved(tab)
    with opened(server, tmp_path / "other") as other:
        other.ask(f"location.hash = {json.dumps(tab.ask('location.hash'))}")
        other.wait(f"{BARS}.length === 1")
        stretch(tab)  # to 3.1 s
        saved(tab)
        other.ask("document.querySelector('[data-key=full]').click()")  # a setting: the document is as it was
        other.wait(f"{BARS}[0][1].startsWith('0 s to 3.1 s')")
        assert not other.ask("document.getElementById('conflict-dialog').open")
        for each in (tab, other):  # of one document different motions, or settings
            each.ask("document.querySelector('[data-key=full]').click()")
            saved(each)
            assert not each.ask("document.getElementById('conflict-dialog').open")


def stretch(tab: browser.Tab, times: int = 1) -> None:
    """The first prompt's end, by a tenth of a second each time."""
    tab.ask("document.querySelector('.bar').focus()")
    for _ in range(times):
        press(tab, "ArrowRight", SHIFT)


def saved(tab: browser.Tab) -> None:
    """Once the server has all of it."""
    time.sleep(1)
    tab.wait("document.getElementById('saved').textContent === 'Saved'")


def ends(tab: browser.Tab, document: str) -> list[float]:
    """Of the prompts of a document (#name), as the server has it."""
    answer = tab.call(
        "Runtime.evaluate",
        expression=f"fetch('/api/documents/{document[1:]}', {KEY}).then((answer) => answer.json())",
        awaitPromise=True,
        returnByValue=True,
    )["result"]["value"]
    return [prompt["end"] for prompt in answer["content"]["document"]["prompts"]]


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
            tab.ask(
                "for (const key of Object.keys(localStorage)) if (key.includes('/')) delete localStorage[key];"
                "delete document.body.dataset.ready; location.reload()"
            )
            ready(tab)
            tab.wait(f"{BARS}[0] && {BARS}[0][1].startsWith('0 s to 3.1 s')")


@pytest.mark.parametrize("steps", [4, 12])
def test_the_motion_of_an_edit_comes_once_a_server_that_was_away_is_back(tmp_path, steps):
    with ExitStack() as stack:
        with serving(tmp_path / "studio", steps=steps) as port:
            tab = stack.enter_context(opened(port, tmp_path))
            write(tab, "walk")
            before = shown(tab)
        press(tab, "ArrowRight", SHIFT)
        tab.wait("document.getElementById('saved').dataset.state === 'away'")
        time.sleep(3)  # the page has tried again meanwhile
        with serving(tmp_path / "studio", port, steps):
            shown(tab, before)


def test_who_comes_first_sees_an_example_that_plays_once(tmp_path):
    with serving(tmp_path / "studio") as port:
        (tmp_path / "studio" / "documents" / "old.json").unlink()
        with opened(port, tmp_path, 1440, 900, plays=True) as tab:
            tab.wait(f"{BARS}.length > 1")
            tab.wait("document.getElementById('play').dataset.playing === 'true'")
            shown(tab)
            picture(tab, "13_first")
            press(tab, " ")
            stretch(tab)
            shown(tab, tab.ask("document.body.dataset.shown"))
            assert tab.ask("document.getElementById('play').dataset.playing") == "false"


def test_a_document_without_a_name_is_found_by_its_first_prompt(tab):
    automatic(tab, False)
    write(tab, "walk in a circle")
    saved(tab)
    click(tab, "#open")
    tab.wait("document.querySelector('#open-documents [aria-current]') !== null")
    assert tab.ask("document.querySelector('#open-documents [aria-current]').textContent") == "walk in a circle"
    assert tab.ask("document.getElementById('name').value") == "Untitled"


def test_a_path_says_how_fast_it_is_walked(tab):
    tab.ask("import('/assets/constraints.js').then((module) => { window.constraints = module; })")
    tab.wait("window.constraints !== undefined")
    pace = tab.ask("constraints.paceOf({ points: [[0, 0], [0, -3], [4, -3]], start: 1, end: null }, 6)")
    assert pace.replace("\u00a0", " ") == "7.0 m in 5 s: 1.4 m/s"


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


def test_on_a_phone_time_stays_in_reach_and_what_is_touched_is_large_enough(server, tmp_path):
    with opened(server, tmp_path, 390, 844) as tab:
        click(tab, "#add")
        tab.wait("document.activeElement.matches('.bar input')")
        tab.call("Input.insertText", text="walk")
        press(tab, "Enter")
        shown(tab)
        for panel in ("samples", "constraints", "words", "prompt"):
            tab.ask(f"document.getElementById('tab-{panel}').click()")
            time.sleep(0.3)
            assert tab.ask(SMALL) == [], panel
            picture(tab, f"9_phone_{panel}")
        tab.ask("scrollTo(0, document.documentElement.scrollHeight)")
        time.sleep(0.3)
        picture(tab, "9_phone_end")
        for id in ("play", "seek", "generate"):
            place = box(tab, f"#{id}")
            middle = (place["left"] + place["width"] / 2, place["top"] + place["height"] / 2)
            assert tab.ask(f"document.elementFromPoint({middle[0]}, {middle[1]}).closest('#{id}') !== null"), id
        tab.ask("(({ seek }) => { seek.value = 1; seek.dispatchEvent(new Event('input')); })(window)")
        assert tab.ask("document.getElementById('time').textContent").startswith("1.00")


SMALL = """[...document.querySelectorAll('button, select, input, textarea, label:has(input)')].filter((control) => {
  const { width, height } = control.getBoundingClientRect();
  const labelled = control.matches('input') && control.closest('label:not(.field)');
  return width && !labelled && control.id !== 'seek' && !control.closest('.bar') && (width < 40 || height < 40);
}).map(({ id, className, offsetWidth, offsetHeight }) => `${id || className} ${offsetWidth}x${offsetHeight}`)"""


def test_three_samples_on_a_phone_leave_the_fourth_place_empty(server, tmp_path):
    with opened(server, tmp_path, 390, 844) as tab:
        click(tab, "#add")
        tab.wait("document.activeElement.matches('.bar input')")
        tab.call("Input.insertText", text="walk")
        press(tab, "Enter")
        one = shown(tab)
        for id in ("#tab-samples", "[data-key=count-2]"):
            tab.ask(f"document.querySelector('{id}').click()")
        shown(tab, one)
        tab.ask("scrollTo(0, 0)")
        stage, camera = box(tab, "#stage"), box(tab, "#camera")
        left, top = round(stage["left"] + stage["width"] / 2), round(stage["top"] + stage["height"] / 2)
        fourth = tab.picture()[top + 2 : round(camera["top"]) - 2, left + 2 : round(stage["right"]) - 2]
        picture(tab, "12_three_on_a_phone")
        assert fourth.size > 0 and len(np.unique(fourth.reshape(-1, 3), axis=0)) == 1


# ---- without eyes ---------------------------------------------------------------------------------------------------

CONTROLS = {"button", "checkbox", "combobox", "link", "listbox", "menuitem", "radio", "searchbox", "slider",
            "spinbutton", "switch", "tab", "textbox"}  # fmt: skip
NAMED = CONTROLS | {"complementary", "dialog", "group", "image", "progressbar", "radiogroup", "region", "tabpanel"}


def tree(tab: browser.Tab) -> list[tuple[str, str, str]]:
    """(role, name, description) of all that the browser tells a screen reader."""
    nodes = tab.call("Accessibility.getFullAXTree")["nodes"]

    def of(node: dict, key: str) -> str:
        return str(node.get(key, {}).get("value", ""))

    return [tuple(of(each, key) for key in ("role", "name", "description")) for each in nodes if not each["ignored"]]


def nameless(tab: browser.Tab) -> list[str]:
    """The roles of what should have a name, and has none; and what can have the focus without being a control."""
    found = [role for role, name, _ in tree(tab) if role in NAMED and not name.strip()]
    clickable = "[...document.querySelectorAll('[tabindex], button, a')].filter((each) => !each.closest('[hidden]'))"
    roles = "['button', 'tab', 'slider', 'link']"
    return found + tab.ask(
        f"{clickable}.filter((each) => !(each.matches('button, a') || {roles}.includes(each.getAttribute('role'))))"
        ".map((each) => each.outerHTML.slice(0, 80))"
    )


def test_a_screen_reader_is_told_of_every_control_in_every_panel_and_dialog(tab):
    assert nameless(tab) == []
    write(tab, "walk forwards")
    first = shown(tab)
    click(tab, "#tab-constraints")
    for kind in ("heading", "hold", "target", "keyframe"):
        click(tab, f"[data-key=add-{kind}]")
        tab.wait(f"document.querySelector('.demand .{kind}') !== null")
        assert nameless(tab) == [], kind
    click(tab, "[data-key=add-path]")
    assert nameless(tab) == []
    click(tab, "[data-key=type-path]")
    shown(tab, first)
    click(tab, "#tab-samples")
    click(tab, "[data-key=count-1]")
    tab.wait("document.querySelectorAll('.view').length === 2")
    click(tab, "[data-key^=pin-]")
    tab.wait("document.querySelectorAll('.favourites li').length === 1")
    for panel in ("prompt", "samples", "constraints", "words"):
        click(tab, f"#tab-{panel}")
        assert nameless(tab) == [], panel
        assert ("tabpanel", panel.capitalize(), "") in tree(tab)
    for name in ("open", "export", "help"):
        click(tab, f"#{name}")
        tab.wait(f"document.getElementById('{name}-dialog').open")
        assert nameless(tab) == [], name
        tab.ask(f"document.getElementById('{name}-dialog').close()")


def test_a_screen_reader_is_told_of_prompts_tracks_and_body_parts(tab):
    automatic(tab, False)
    write(tab, "walk forwards")
    press(tab, "3")  # from all parts, or the suggested ones, to what the keys say
    tab.wait("document.querySelector('.bar').getAttribute('aria-label').includes('knows it')")
    parts = tab.ask("[...document.querySelectorAll('.chip.on')].map((chip) => chip.textContent)")
    write(tab, "swim across the river")
    tab.wait("document.querySelectorAll('.bar')[1].getAttribute('aria-label').includes('hardly knows it')")
    names = [name for role, name, _ in tree(tab) if role == "button"]
    assert f"walk forwards. 0 s to 3 s, track 1, {', '.join(parts)}. the model knows it" in names
    [swim] = [name for name in names if name.startswith("swim across the river. ")]
    assert swim.startswith("swim across the river. 0 s to 3 s, track 2, ") and "hardly knows" in swim
    [legs] = [about for role, name, about in tree(tab) if (role, name) == ("button", "Lock the legs")]
    assert "0 s to 3 s" in legs
    press(tab, "Escape")
    tab.wait("document.querySelector('.doubt') !== null")
    assert ("image", "the model hardly knows it") in [each[:2] for each in tree(tab)]
    press(tab, "k")
    tab.wait("document.activeElement.matches('.bar:nth-child(2)')")
    press(tab, "l")
    tab.wait("document.activeElement.getAttribute('aria-label').includes('. locked')")


def test_the_page_says_what_the_model_reads_and_what_a_sample_does_not_show(tab):
    write(tab, "walk")
    shown(tab)
    assert tab.ask("document.querySelector('.sample .doubt') === null")
    press(tab, "Escape")
    write(tab, "leap into a somersault")
    tab.wait("document.querySelector('.sample .doubt') !== null")
    click(tab, "#tab-samples")
    assert "does not show from" in tab.ask("document.querySelector('#panel-samples .advice').textContent")
    assert ("image", "it does not show every prompt") in [each[:2] for each in tree(tab)]
    picture(tab, "missed")
    press(tab, "Escape")
    write(tab, "a boxer throws a left jab")
    click(tab, "#tab-prompt")
    tab.wait(
        "document.querySelector('#panel-prompt').textContent.includes('The model reads “punch with the left hand”.')"
    )
    picture(tab, "read_as")


def test_progress_and_errors_are_read_out_once_each_and_not_at_every_step(tab):
    tab.ask(
        "window.said = []; new MutationObserver(() => said.push(document.getElementById('told').textContent))"
        ".observe(document.getElementById('told'), { childList: true })"
    )
    write(tab, "walk")
    shown(tab)
    tab.wait("said.length === 3")
    assert tab.ask("said") == ["Sampling: Preview.", "Sampling: Full quality.", "Ready: 1 sample of 3.00 s."]
    live = "[...document.querySelectorAll('[role=status], [role=alert], [aria-live], output')].map((each) => each.id)"
    assert sorted(tab.ask(live)) == ["export-told", "joint-refusal", "message", "told"]
    field(tab, "[data-key^=end-]", "400")
    tab.wait("said.length === 4 && said[3].includes('300 at most')")
    tab.wait("document.querySelector('.bar').getAttribute('aria-label').includes('300 at most')")
    click(tab, "#generate")
    tab.wait("!document.getElementById('message').hidden")
    assert any(role == "alert" for role, _, _ in tree(tab))


# ---- live -----------------------------------------------------------------------------------------------------------

LIVE = 'JSON.parse(document.body.dataset.live || \'{"seconds": 0, "prompts": []}\')'
"""How many seconds have come of the stream that plays, and the texts of its prompts."""


def test_live_plays_what_is_typed_and_leaves_it_in_the_timeline_as_one_step(tab):
    automatic(tab, False)
    write(tab, "walk")
    click(tab, "#live")
    tab.wait(f"{LIVE}.seconds > 0 && {LIVE}.prompts.join() === 'walk'")
    assert tab.ask("document.getElementById('live').getAttribute('aria-pressed')") == "true"
    assert nameless(tab) == []
    picture(tab, "14_live")
    click(tab, "#next-text")
    tab.call("Input.insertText", text="wave with the left hand")
    press(tab, "Enter")
    tab.wait(f"{LIVE}.prompts.includes('wave with the left hand')")
    tab.wait(f"{BARS}.some(([text]) => text === 'wave with the left hand')")
    seconds = tab.ask(f"{LIVE}.seconds")
    tab.wait(f"{LIVE}.seconds > {seconds} + 1 && parseFloat(document.getElementById('time').textContent) > 0.5")
    click(tab, "#live")
    tab.wait("!document.body.dataset.live && document.getElementById('next').hidden")
    assert sorted(tab.ask(f"{BARS}.map(([text]) => text)")) == ["walk", "wave with the left hand"]
    tab.ask("document.activeElement.blur()")
    press(tab, "z", CONTROL)
    tab.wait(f"{BARS}.length === 1")


def test_a_timeline_without_a_motion_is_generated_after_live(tab):
    automatic(tab, False)
    write(tab, "walk")
    click(tab, "#live")
    tab.wait(f"{LIVE}.seconds > 0")
    automatic(tab, True)
    assert tab.ask("document.body.dataset.shown || ''") == ""
    click(tab, "#live")
    tab.wait("!document.body.dataset.live")
    assert shown(tab)


def test_live_takes_back_an_edit_of_what_has_played_and_says_why(tab):
    automatic(tab, False)
    write(tab, "walk")
    click(tab, "#live")
    tab.wait(f"{LIVE}.seconds > 1")
    tab.ask("document.querySelector('.bar').focus()")
    press(tab, "ArrowRight", CONTROL)  # by 1 s
    tab.wait("document.getElementById('message').textContent.includes('has begun at 0 s; only its end can move')")
    tab.wait(f"{BARS}[0][1].startsWith('0 s to 3 s')")
    press(tab, "Escape")
    tab.wait("!document.body.dataset.live")


def test_what_differs_from_the_stream_becomes_its_edits(tab):
    tab.ask("import('/assets/live.js').then((module) => { window.live = module; })")
    tab.wait("window.live !== undefined")
    setting = """
      const prompt = (id, text, start, end, parts = []) => ({ id, text, start, end, parts });
      const [walk, wave] = [prompt("p1", "walk", 0, 4, ["legs"]), prompt("p2", "wave", 3, 5)];
      const streamed = new Map([["p1", { number: 0, prompt: walk }], ["p2", { number: 1, prompt: wave }]]);
      const edits = (prompts) => live.editsOf(prompts, streamed, ({ start }) => start < 2).map(({ edit }) => edit);"""

    def edits(prompts: str) -> list[dict]:
        return tab.ask(f"(() => {{ {setting} return edits({prompts}); }})()")

    assert edits("[walk, wave]") == []
    assert edits("[walk]") == [{"remove": 1}]
    assert edits("[walk, {...wave, end: 6}]") == [{"move": 1, "start": 3, "end": 6}]
    clap = {"add": {"text": "clap", "start": 3, "end": 5, "body_parts": ["left arm"]}}
    assert edits("[walk, {...wave, text: 'clap', parts: ['left arm']}]") == [{"remove": 1}, clap]
    run = {"add": {"text": "run", "start": 0, "end": 4, "body_parts": ["legs"]}}
    assert edits("[{...walk, text: 'run'}, wave]") == [run], "the stream refuses what has begun, and walk stays"
