"""The page in a real browser, judged by its pixels: headless Chromium, software WebGL."""

import time
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
import pytest
from helpers import browser
from helpers.motions import walking

from stmc.editing.constraints import Target
from stmc.timeline import Timeline
from stmc.viewing import render_html

pytestmark = [
    pytest.mark.browser,
    pytest.mark.slow,
    pytest.mark.skipif(browser.PATH is None, reason="no chromium on the PATH (Debian: apt-get install chromium)"),
]


NASTY = '</script><script>document.body.dataset.hurt = 1</script><img src=x onerror="document.body.dataset.hurt = 1">'
"""A title that must not become a part of the page."""


@pytest.fixture(scope="module")
def tab(tmp_path_factory) -> Iterator[browser.Tab]:
    """The page of someone who steps in place for 3 s and raises the right arm from 1 to 2 s, opened at 0.4 s; the right
    hand should have reached a place."""
    timeline = Timeline.parse("step in place # 0 # 3 # legs\nraise the right arm # 1 # 2 # right arm")
    folder = tmp_path_factory.mktemp("page")
    path = folder / "motion.html"
    motion, reach = walking(seconds=3.0, speed=0.0, turn=0.0), Target("right_hand", (-0.9, -0.2, 1.6), start=1.0)
    content = render_html(motion, timeline, title=NASTY, overlap=0.2, constraints=[reach])
    path.write_text(content, "utf-8")
    with browser.tab(folder / "profile", 700, 760) as opened:
        opened.open(f"{path.as_uri()}#t=0.4")
        opened.wait("document.body.dataset.time == '0.400'")
        yield opened


class Shot(NamedTuple):
    """A picture of the page cut into its three rows, each [height, width, 3]."""

    texts: np.ndarray
    scene: np.ndarray
    tracks: np.ndarray


@pytest.fixture(scope="module")
def shots(tab) -> dict[float, Shot]:
    """What is to be seen at two moments; to the second the tracks are clicked."""
    first = settled(tab)
    scrub(tab, 1.5 / 3.0)
    tab.wait("Math.abs(document.body.dataset.time - 1.5) < 0.02")
    return {0.4: first, 1.5: settled(tab)}


def scrub(tab: browser.Tab, share: float) -> None:
    """Clicks the tracks at a share of the time."""
    box = tab.ask("document.getElementById('ruler').getBoundingClientRect().toJSON()")
    tab.click(box["left"] + box["width"] * share, box["top"] + 5)


def settled(tab: browser.Tab) -> Shot:
    """The page once it shows a body and stays the same for two seconds (it is paused)."""
    kept, since = cut(tab), time.monotonic()
    patience = since + browser.PATIENCE
    while time.monotonic() < patience:
        time.sleep(0.2)
        shot = cut(tab)
        if blue(shot.scene) < 100 or any((one != other).any() for one, other in zip(shot, kept, strict=True)):
            kept, since = shot, time.monotonic()
        elif time.monotonic() > since + 2.0:
            return shot
    raise TimeoutError("the page never comes to rest, or never shows a body")


def cut(tab: browser.Tab) -> Shot:
    rows = ("#heading", "#stage canvas", "#tracks")
    boxes = [tab.ask(f"document.querySelector('{row}').getBoundingClientRect().toJSON()") for row in rows]
    picture = tab.picture()
    return Shot(*(picture[int(box["top"]) + 1 : int(box["bottom"]) - 1] for box in boxes))


def blue(picture: np.ndarray) -> int:
    return int(((picture[..., 2] - picture[..., 0]) > 70).sum())


def orange(picture: np.ndarray) -> int:
    red, green, blue = np.moveaxis(picture, -1, 0)
    return int(((red - blue > 70) & (green - blue > 30)).sum())


def red(picture: np.ndarray) -> int:
    """Pixels in the colour of constraints."""
    return int((np.abs(picture - [229, 72, 77]).max(axis=-1) < 25).sum())


def silhouette(picture: np.ndarray) -> np.ndarray:
    """Whatever has a colour, [height, width]: the floor and its shadows are grey."""
    return np.ptp(picture, axis=-1) > 50


def cursor(tracks: np.ndarray) -> float:
    """Where along the tracks the dark line stands, 0 to 1."""
    tracks = tracks[:60]
    dark = (tracks.max(axis=-1) < 70).sum(axis=0)
    painted = np.flatnonzero((tracks[..., 2] - tracks[..., 0] > 70).sum(axis=0) > 10)  # the blue bars span all seconds
    return float((dark.argmax() - painted[0]) / (painted[-1] - painted[0]))


def test_the_page_shows_the_body_in_its_prompt_s_colour(shots):
    assert blue(shots[0.4].scene) > 800
    assert orange(shots[0.4].scene) == 0


def test_a_body_part_changes_its_colour_while_another_prompt_owns_it(shots):
    assert orange(shots[1.5].scene) > 80
    assert blue(shots[1.5].scene) > 800


def test_the_body_moves_with_time(shots):
    moved = silhouette(shots[0.4].scene) ^ silhouette(shots[1.5].scene)
    assert moved.sum() > 0.2 * silhouette(shots[0.4].scene).sum()


def test_the_texts_above_are_those_that_hold(shots):
    assert blue(shots[0.4].texts) > 1000 and blue(shots[1.5].texts) > 1000
    assert orange(shots[0.4].texts) == 0
    assert orange(shots[1.5].texts) > 1000


@pytest.mark.parametrize("seconds", [0.4, 1.5])
def test_the_cursor_on_the_tracks_stands_at_the_time_of_the_recording(seconds, shots):
    assert cursor(shots[seconds].tracks) == pytest.approx(seconds / 3.0, abs=0.01)


def test_the_page_asks_the_network_for_nothing_and_throws_no_error(tab, shots):
    asked = [params["request"]["url"] for method, params in tab.events if method == "Network.requestWillBeSent"]
    assert {url.split(":")[0] for url in asked} <= {"file", "data", "blob"}
    assert [params for method, params in tab.events if method == "Runtime.exceptionThrown"] == []


def test_a_title_stays_a_text(tab, shots):
    assert tab.ask("document.title") == NASTY == tab.ask("document.querySelector('h1').textContent")
    assert tab.ask("document.body.dataset.hurt === undefined && document.images.length === 0")


def test_the_browser_has_nothing_to_say_of_the_page(tab, shots):
    said = [params for method, params in tab.events if method in ("Runtime.consoleAPICalled", "Log.entryAdded")]
    assert [each for each in said if "error" in (each.get("type"), each.get("entry", {}).get("level"))] == []


def test_a_constraint_has_a_mark_on_the_stage_and_a_row(tab, shots):
    assert red(shots[0.4].scene) > 20
    assert red(shots[0.4].tracks) > 20
    assert "target right hand" in tab.ask("document.getElementById('tracks').textContent")


def test_the_space_bar_plays_it_on_and_pictures_are_drawn(tab, shots):
    before = tab.ask("+document.getElementById('stage').dataset.pictures")
    for kind in ("keyDown", "keyUp"):
        tab.call("Input.dispatchKeyEvent", type=kind, key=" ")
    tab.wait("Math.abs(document.body.dataset.time - 1.5) > 0.1")
    tab.wait(f"document.getElementById('stage').dataset.pictures > {before} + 2")
    tab.wait("document.getElementById('stage').dataset.time === document.body.dataset.time")


@pytest.fixture(scope="module")
def phone(tmp_path_factory) -> Iterator[browser.Tab]:
    """The page of someone who walks 6 m, in a window as wide as a phone, opened at 0.5 s."""
    folder = tmp_path_factory.mktemp("phone")
    path = folder / "motion.html"
    path.write_text(render_html(walking(seconds=5.0, speed=1.2, turn=0.0), Timeline.parse("walk # 0 # 5")), "utf-8")
    with browser.tab(folder / "profile", 500, 844) as opened:
        opened.call("Emulation.setDeviceMetricsOverride", width=390, height=844, deviceScaleFactor=1, mobile=False)
        opened.open(f"{path.as_uri()}#t=0.5")
        opened.wait("document.body.dataset.time == '0.500'")
        yield opened


def body_across(tab: browser.Tab) -> tuple[float, float]:
    """Where the coloured columns of the scene begin and end, from -1 (left) to 1."""
    scene = settled(tab).scene
    columns = np.flatnonzero(silhouette(scene).sum(axis=0) > 8)  # not the thin path on the floor
    return tuple(2 * columns[[0, -1]] / scene.shape[1] - 1)


def test_a_narrow_window_shows_all_of_the_page_and_the_button_decides_whether_the_camera_follows(phone):
    assert phone.ask("document.documentElement.scrollWidth") <= 390
    pressed = "document.getElementById('follow').getAttribute('aria-pressed')"
    if phone.ask(pressed) == "true":
        phone.ask("document.getElementById('follow').click()")
    stays = []
    for follows in (False, True):
        assert phone.ask(pressed) == str(follows).lower()
        places = []
        for share in (0.1, 0.9):
            scrub(phone, share)
            phone.wait(f"Math.abs(document.body.dataset.time - {5 * share}) < 0.05")
            left, right = body_across(phone)
            assert -0.98 < left < right < 0.98
            places.append((left + right) / 2)
        stays.append(abs(places[1] - places[0]))
        phone.ask("document.getElementById('follow').click()")
    assert stays[1] < 0.15
    assert stays[0] > 2 * stays[1]
