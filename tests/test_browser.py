"""The page in a real browser, judged by its pixels: headless Chromium, software WebGL."""

from collections.abc import Iterator

import chromium
import numpy as np
import pytest
from walker import walking

from stmc.timeline import Timeline
from stmc.viewing import page

HEADING = 44
"""Height in pixels of the row of texts above the scene."""

pytestmark = [
    pytest.mark.browser,
    pytest.mark.skipif(chromium.PATH is None, reason="no chromium on the PATH (Debian: apt-get install chromium)"),
]


@pytest.fixture(scope="module")
def tab(tmp_path_factory) -> Iterator[chromium.Tab]:
    """The page of someone who steps in place for 3 s and raises the right arm from 1 to 2 s, opened at 0.4 s."""
    timeline = Timeline.parse("step in place # 0 # 3 # legs\nraise the right arm # 1 # 2 # right arm")
    folder = tmp_path_factory.mktemp("page")
    path = folder / "motion.html"
    path.write_text(page(walking(seconds=3.0, speed=0.0, turn=0.0), timeline, title="steps", overlap=0.2), "utf-8")
    with chromium.tab(folder / "profile", 700, 560) as opened:
        opened.open(f"{path.as_uri()}#t=0.4")
        opened.wait("document.body.dataset.time == '0.400'")
        yield opened


@pytest.fixture(scope="module")
def pictures(tab) -> dict[float, np.ndarray]:
    """Pictures by the moment they show; to the second moment the tracks are clicked."""
    first = settled(tab)
    box = tab.ask("document.querySelector('.ruler').getBoundingClientRect().toJSON()")
    tab.click(box["left"] + box["width"] * 1.5 / 3.0, box["top"] + 5)
    tab.wait("Math.abs(document.body.dataset.time - 1.5) < 0.02")
    return {0.4: first, 1.5: settled(tab)}


def settled(tab: chromium.Tab) -> np.ndarray:
    """The picture once it shows a body and two in a row are the same (the recording is paused)."""
    before = tab.picture()
    for _ in range(40):
        after = tab.picture()
        if (before == after).all() and blue(scene(after)) > 0:
            return after
        before = after
    raise AssertionError("the picture never comes to rest, or never shows a body")


def blue(picture: np.ndarray) -> int:
    return int(((picture[..., 2] - picture[..., 0]) > 70).sum())


def orange(picture: np.ndarray) -> int:
    return int(((picture[..., 0] - picture[..., 2]) > 70).sum())


def scene(picture: np.ndarray) -> np.ndarray:
    """The upper half of the window below the texts: above the playback bar and the tracks."""
    return picture[HEADING + 2 : len(picture) // 2 + HEADING]


def cursor(picture: np.ndarray) -> float:
    """Where along the tracks the dark line stands, 0 to 1, found in the lowest quarter of the window."""
    tracks = picture[-len(picture) // 4 :]
    dark = (tracks.max(axis=-1) < 70).sum(axis=0)
    painted = np.flatnonzero((tracks[..., 2] - tracks[..., 0] > 70).sum(axis=0) > 10)  # the blue bars span all seconds
    return float((dark.argmax() - painted[0]) / (painted[-1] - painted[0]))


def test_the_page_shows_the_body_in_its_prompt_s_colour(pictures):
    assert blue(scene(pictures[0.4])) > 800
    assert orange(scene(pictures[0.4])) == 0


def test_a_body_part_changes_its_colour_while_another_prompt_owns_it(pictures):
    assert orange(scene(pictures[1.5])) > 80
    assert blue(scene(pictures[1.5])) > 800


def test_the_body_moves_with_time(pictures):
    changed = np.abs(scene(pictures[0.4]) - scene(pictures[1.5])).max(axis=-1) > 60
    assert changed.sum() > 500


def test_the_texts_above_are_those_that_hold(pictures):
    assert blue(pictures[0.4][:HEADING]) > 1000 and blue(pictures[1.5][:HEADING]) > 1000
    assert orange(pictures[0.4][:HEADING]) == 0
    assert orange(pictures[1.5][:HEADING]) > 1000


@pytest.mark.parametrize("seconds", [0.4, 1.5])
def test_the_cursor_on_the_tracks_stands_at_the_time_of_the_recording(seconds, pictures):
    assert cursor(pictures[seconds]) == pytest.approx(seconds / 3.0, abs=0.01)


def test_the_page_asks_the_network_for_nothing_and_throws_no_error(tab, pictures):
    asked = [params["request"]["url"] for method, params in tab.events if method == "Network.requestWillBeSent"]
    assert {url.split(":")[0] for url in asked} <= {"file", "data", "blob"}
    assert [params for method, params in tab.events if method == "Runtime.exceptionThrown"] == []


def test_the_cursor_follows_the_recording_once_the_space_bar_plays_it_on(tab, pictures):
    for kind in ("keyDown", "keyUp"):
        tab.call("Input.dispatchKeyEvent", type=kind, code="Space", key=" ")
    tab.wait("Math.abs(document.body.dataset.time - 1.5) > 0.1")
