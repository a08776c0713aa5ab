"""A survey in a real browser, answered as a rater would, and the file it saves analysed: headless Chromium."""

import base64
import io
import json
import time
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from helpers import browser
from helpers.motions import walking
from PIL import Image
from test_study import pair

from stmc.evaluation.study import Aspect, Key, Kind, Question, Survey, Vote, analyse, design, read_answers, survey_page
from stmc.evaluation.study.clips import Clip
from stmc.timeline import Timeline

pytestmark = [
    pytest.mark.browser,
    pytest.mark.slow,
    pytest.mark.skipif(browser.PATH is None, reason="no chromium on the PATH (Debian: apt-get install chromium)"),
]
WIDTH, HEIGHT = 1280, 640
"""What a browser leaves of a laptop's screen."""


@pytest.fixture(scope="module")
def tab(tmp_path_factory) -> Iterator[browser.Tab]:
    with browser.tab(tmp_path_factory.mktemp("profile"), WIDTH, HEIGHT) as opened:
        opened.call("Emulation.setDeviceMetricsOverride", width=WIDTH, height=HEIGHT, deviceScaleFactor=1, mobile=False)
        yield opened


@pytest.fixture(scope="module")
def study() -> tuple[Survey, Key]:
    """Three warm-ups, two honeypots and two pairs."""
    surveys, key = design([pair(number) for number in range(8)], ("collage", "rival"), size=2)
    return surveys[0], key


def start(tab: browser.Tab, folder: Path, survey: Survey) -> None:
    """Opens a survey's page, and its first question."""
    path = folder / "survey.html"
    path.write_text(survey_page(survey), "utf-8")
    tab.open(path.as_uri())
    tab.wait("document.body.dataset.at == '-1'")
    click(tab, "#start")
    tab.wait("document.body.dataset.time > 0")


def click(tab: browser.Tab, selector: str) -> None:
    box = tab.ask(f"document.querySelector('{selector}').getBoundingClientRect().toJSON()")
    tab.click((box["left"] + box["right"]) / 2, (box["top"] + box["bottom"]) / 2)


def press(tab: browser.Tab, key: str, text: str = "") -> None:
    tab.call("Input.dispatchKeyEvent", type="keyDown", key=key, text=text or key if len(key) == 1 else text)
    tab.call("Input.dispatchKeyEvent", type="keyUp", key=key)


def seek(tab: browser.Tab, share: float) -> None:
    """Drags the slider to a share of the time."""
    tab.ask(
        f"(() => {{ const bar = document.getElementById('seek'); bar.value = {share} * bar.max;"
        " bar.dispatchEvent(new Event('input')); })()"
    )


def settle(tab: browser.Tab, share: float) -> None:
    """Until a paused page shows that time, on the stage too."""
    tab.wait(f"Math.abs(document.body.dataset.time - {share} * document.getElementById('seek').max) < 0.02")
    tab.wait("document.getElementById('stage').dataset.time === document.body.dataset.time")


def pause(tab: browser.Tab) -> None:
    if tab.ask("document.getElementById('play').getAttribute('aria-label')") == "Pause":
        press(tab, " ")
        tab.wait("document.getElementById('play').getAttribute('aria-label') === 'Play'")


def panels(tab: browser.Tab) -> list[np.ndarray]:
    """Both halves of the stage as they were last drawn, [height, width, 3] from 0 to 255."""
    code = "document.querySelector('#stage canvas').toDataURL('image/png').split(',')[1]"
    picture = np.asarray(Image.open(io.BytesIO(base64.b64decode(tab.ask(code)))).convert("RGB")).astype(int)
    half = picture.shape[1] // 2
    return [picture[:, :half], picture[:, -half:]]


def limbs(panel: np.ndarray) -> np.ndarray:
    """Where arms and legs are, [height, width]: nothing else has a colour."""
    return np.ptp(panel, axis=-1) > 40


def question(*clips: Clip, text: str = "walk # 0 # 3") -> Question:
    return Question("ab" * 8, Timeline.parse(text), ((f"{1:016x}", clips[0]), (f"{2:016x}", clips[1])))


def test_equal_motions_give_equal_pictures_also_while_they_play(tab, tmp_path):
    clip = Clip.of(walking(3.0))
    start(tab, tmp_path, Survey("equal", (question(clip, clip),)))
    seen = []
    for _ in range(4):
        left, right = panels(tab)
        assert (np.abs(left - right).max(axis=-1) > 30).mean() < 0.002  # lines are smoothed by pairs of pixels
        assert limbs(left).sum() > 1000
        seen.append(left)
        time.sleep(0.15)
    assert any((one != other).any() for one, other in pairwise(seen))


def test_both_bodies_are_wholly_to_be_seen_at_any_time_and_from_any_side(tab, tmp_path):
    runner, stretched = Clip.of(walking(3.0, speed=4.0, turn=1.5)), Clip.of(walking(3.0, speed=0.3)).stretched()
    start(tab, tmp_path, Survey("seen", (question(runner, stretched),)))
    pause(tab)
    box = tab.ask("document.getElementById('stage').getBoundingClientRect().toJSON()")
    for share, (right, down) in (
        (0.0, (0, 0)),
        (0.4, (150, 0)),
        (0.55, (60, 200)),
        (0.8, (-90, -300)),
        (1.0, (200, 30)),
    ):
        seek(tab, share)
        settle(tab, share)
        x, y = box["left"] + box["width"] / 4, box["top"] + box["height"] / 2
        for kind, dx, dy in (("mousePressed", 0, 0), ("mouseMoved", right, down), ("mouseReleased", right, down)):
            tab.call("Input.dispatchMouseEvent", type=kind, x=x + dx, y=y + dy, button="left", buttons=1, clickCount=1)
        time.sleep(1.0)
        for panel in panels(tab):
            body = limbs(panel)
            assert body.sum() > 200
            assert not (body[:2].any() or body[-2:].any() or body[:, :2].any() or body[:, -2:].any())


def test_the_timeline_is_legible_and_its_bar_moves_with_time(tab, tmp_path):
    clip = Clip.of(walking(6.0))
    text = "walk forwards # 0 # 3.5 # legs\nturn to the left # 3.5 # 6 # legs\nwave with the right hand # 1 # 3"
    start(tab, tmp_path, Survey("timeline", (question(clip, clip, text=text),)))
    pause(tab)
    for share, now in (
        (0.1, ["walk forwards"]),
        (0.4, ["walk forwards", "wave with the right hand"]),
        (0.9, ["turn to the left"]),
    ):
        seek(tab, share)
        settle(tab, share)
        assert tab.ask("[...document.querySelectorAll('#now span:not([hidden])')].map((e) => e.textContent)") == now
        assert tab.ask("[...document.querySelectorAll('.bar.now')].map((e) => e.textContent)") == now
        tracks, cursor = (
            tab.ask(f"document.getElementById('{name}').getBoundingClientRect().toJSON()")
            for name in ("tracks", "cursor")
        )
        at = ((cursor["left"] + cursor["right"]) / 2 - tracks["left"]) / tracks["width"]
        assert at == pytest.approx(share, abs=0.005)
    fits = "[...document.querySelectorAll('.bar, label, #now span')].every((e) => e.scrollWidth <= e.clientWidth + 1)"
    assert tab.ask(fits)
    assert tab.ask("document.documentElement.scrollHeight <= innerHeight")
    click(tab, ".bar:last-of-type")  # of the first track: the second prompt
    tab.wait("Math.abs(document.body.dataset.time - 4.75) < 0.1")


def answer(tab: browser.Tab, survey: Survey, key: Key, number: int) -> None:
    """Answers one question with the keyboard alone: pairs by realism for the first method, honeypots rightly."""
    asked = survey.questions[number]
    entry = key.surveys[survey.id][asked.id]
    left = entry.sides[asked.sides[0][0]]
    tab.wait(f"document.body.dataset.at == '{number}'")
    assert tab.ask("document.getElementById('next').disabled")
    press(tab, "1" if left in ("collage", "right") else "3")
    assert "watch both motions to the end" in tab.ask("document.getElementById('missing').textContent")
    seek(tab, 0.97)
    tab.wait("document.getElementById('missing').textContent.includes('the other question')")
    press(tab, "5" if entry.kind.tests is None else "4" if left == "right" else "6")
    tab.wait("!document.getElementById('next').disabled")
    press(tab, "Enter", "\r")


def test_a_survey_is_answered_with_the_keyboard_outlives_a_closed_tab_and_its_file_is_analysed(tab, tmp_path, study):
    survey, key = study
    start(tab, tmp_path, survey)
    for number in range(3):
        answer(tab, survey, key, number)
    tab.wait("document.body.dataset.at == '3'")
    time.sleep(0.5)  # the browser keeps what a page stores behind its back, and no rater is as quick as a test
    tab.call("Page.reload")
    tab.call("Page.bringToFront")  # a page that it takes for hidden is given no frames to draw
    tab.wait("document.body.dataset.time !== undefined && document.body.dataset.at == '3'")
    for number in range(3, 7):
        answer(tab, survey, key, number)
    tab.wait("document.body.dataset.at == '7'")
    tab.call("Browser.setDownloadBehavior", behavior="allow", downloadPath=str(tmp_path))
    click(tab, "#save")
    tab.wait("!document.getElementById('saved').hidden")
    path = tmp_path / tab.ask("document.getElementById('file').textContent")
    patience = time.monotonic() + browser.PATIENCE
    while not (path.exists() and path.stat().st_size):
        assert time.monotonic() < patience, f"{path} was not saved"
        time.sleep(0.1)
    [answers] = read_answers([path], key)
    assert answers.rater == tab.ask("document.getElementById('code').textContent")
    found = analyse(key, [answers])
    assert not found.discarded
    assert found.preferences[Aspect.REALISM].count(Vote.FIRST) == 2
    assert found.preferences[Aspect.TIMELINE].count(Vote.NEITHER) == 2
    assert len(json.loads(path.read_text())["answers"]) == 7
    assert {entry.kind for entry in key.surveys[survey.id].values()} == set(Kind)


def test_the_pages_asked_the_network_for_nothing_and_threw_no_error(tab):
    asked = [params["request"]["url"] for method, params in tab.events if method == "Network.requestWillBeSent"]
    assert {url.split(":")[0] for url in asked} <= {"file", "data", "blob"}
    assert [params for method, params in tab.events if method == "Runtime.exceptionThrown"] == []
