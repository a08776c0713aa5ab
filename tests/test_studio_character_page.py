"""Characters, poses and paths by hand on the studio's page, in a real browser before a server with a tiny model."""

import base64
import json
import time
from collections.abc import Iterator

import numpy as np
import pytest
from helpers import browser
from helpers import characters as figures
from scipy import ndimage
from test_studio_page import (
    CONTROL,
    KEY,
    automatic,
    box,
    click,
    motion_of,
    nameless,
    opened,
    picture,
    press,
    ready,
    serving,
    shown,
    write,
)

from stmc.motion.body import JOINTS
from stmc.motion.retargeting.rig import MAPPED

pytestmark = [
    pytest.mark.browser,
    pytest.mark.slow,
    pytest.mark.skipif(browser.PATH is None, reason="no chromium on the PATH (Debian: apt-get install chromium)"),
]

RED = np.array([0xE5, 0x48, 0x4D])
"""The colour of what a hand takes hold of on the stage."""


@pytest.fixture(scope="module")
def server(tmp_path_factory) -> Iterator[int]:
    with serving(tmp_path_factory.mktemp("studio")) as port:
        yield port


@pytest.fixture
def tab(server, tmp_path) -> Iterator[browser.Tab]:
    with opened(server, tmp_path) as tab:
        yield tab


def drop(tab: browser.Tab, name: str, content: bytes, beyond: int = 0) -> None:
    """Drop a file on the page, with so many zeros behind its content."""
    data = base64.b64encode(content).decode()
    tab.ask(f"""(() => {{
      const bytes = Uint8Array.from(atob("{data}"), (letter) => letter.charCodeAt(0));
      const dataTransfer = new DataTransfer();
      dataTransfer.items.add(new File([bytes, new Uint8Array({beyond})], {json.dumps(name)}));
      window.dispatchEvent(new DragEvent("drop", {{ dataTransfer, cancelable: true }}));
    }})()""")


def figure(tab: browser.Tab, other_than: str) -> str:
    """Who moves on the stage, once it is somebody else: a character's id, or "mannequin"."""
    tab.wait(f"(document.body.dataset.figure || '') !== {json.dumps(other_than)}")
    tab.wait("document.getElementById('stage').ariaBusy === 'false'")
    return tab.ask("document.body.dataset.figure")


def wear(tab: browser.Tab, key: str) -> None:
    click(tab, "#character")
    tab.wait("document.getElementById('character').ariaExpanded === 'true'")
    click(tab, f"[data-key=wear-{key}]")


def message(tab: browser.Tab, words: str) -> None:
    tab.wait(f"document.getElementById('message').textContent.includes({json.dumps(words)})")


def colours(tab: browser.Tab) -> np.ndarray:
    """What is to be seen of the stage above its buttons, once it is drawn."""
    tab.ask("new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)))")
    time.sleep(0.5)
    place = box(tab, "#stage")
    top, bottom = round(place["top"]), round(place["bottom"]) - 60
    return tab.picture()[top:bottom, : round(place["width"])]


def grips(tab: browser.Tab) -> list[tuple[float, float]]:
    """Where hands, feet and head can be taken hold of, in the page, from the left to the right."""
    spots, count = ndimage.label(np.abs(colours(tab) - RED).sum(axis=-1) < 60)
    places = [np.argwhere(spots == number) for number in range(1, count + 1)]
    # A body that walks can cut the thin line below a target off: it is long enough, and no ball.
    balls = [place for place in places if len(place) > 40 and np.ptp(place, axis=0).min() > 3]
    centres = [place.mean(axis=0) for place in balls]
    top = box(tab, "#stage")["top"]
    return sorted((float(x), float(y + top)) for y, x in centres)


def pull(tab: browser.Tab, start: tuple[float, float], by: tuple[float, float], steps: int = 4) -> None:
    def mouse(kind: str, share: float, buttons: int) -> None:
        x, y = (one + share * way for one, way in zip(start, by, strict=True))
        tab.call("Input.dispatchMouseEvent", type=kind, x=x, y=y, button="left", buttons=buttons, clickCount=1)

    mouse("mousePressed", 0, 1)
    for step in range(1, steps + 1):
        mouse("mouseMoved", step / steps, 1)
    mouse("mouseReleased", 1, 0)


def constraints(tab: browser.Tab) -> list[str]:
    return tab.ask("[...document.querySelectorAll('.demand .label')].map((row) => row.ariaLabel)")


def document(tab: browser.Tab) -> dict:
    """The open document as the page keeps it."""
    return tab.ask("JSON.parse(localStorage.getItem(`stmc-studio/${location.hash.slice(1)}`)).content.document")


def test_a_character_is_dropped_sampled_switched_exported_and_there_again_after_a_reload(tab, tmp_path):
    drop(tab, "My hero.glb", figures.glb(figures.stocky()))
    message(tab, "My hero moves as soon as there is a motion.")
    write(tab, "walk")
    motion = shown(tab)
    hero = figure(tab, "")
    assert hero != "mannequin" and tab.ask("document.querySelector('#character span').textContent") == "My hero"
    press(tab, "Escape")
    prompts = colours(tab)
    picture(tab, "20_character")
    click(tab, "#materials")
    own = colours(tab)
    assert np.abs(own - prompts).max() > 50, "its own materials are not the colours of prompts"
    drop(tab, "lanky.glb", figures.glb(figures.lanky(), seed=3, yaw=np.pi))
    lanky = figure(tab, hero)
    picture(tab, "21_another_character")
    wear(tab, "mannequin")
    assert figure(tab, lanky) == "mannequin" and tab.ask("document.getElementById('materials').hidden")
    wear(tab, hero)
    assert figure(tab, "mannequin") == hero
    press(tab, "z", CONTROL)
    assert figure(tab, hero) == "mannequin", "switching is undone as an edit is"
    press(tab, "z", CONTROL)
    press(tab, "z", CONTROL)
    assert figure(tab, "mannequin") == hero and shown(tab) == motion, "no motion is made for another figure"

    tab.call("Browser.setDownloadBehavior", behavior="allow", downloadPath=str(tmp_path))
    click(tab, "#export")
    formats = tab.ask("[...document.querySelectorAll('#export-formats b')].map((name) => name.textContent)")
    assert formats[:3] == [".glb", ".vrma", ".bvh"]
    told = tab.ask("document.getElementById('export-figure').textContent")
    assert told == ".glb, .vrma, .bvh show My hero; the others show the mannequin."
    picture(tab, "22_character_export")
    click(tab, "#export-motion")
    tab.wait("document.getElementById('export-told').textContent === 'Saved.'")
    patience = time.monotonic() + browser.PATIENCE
    while not (files := list(tmp_path.glob("*.glb"))):
        assert time.monotonic() < patience
        time.sleep(0.1)
    made, _ = figures.unpacked(files[0].read_bytes())
    assert made["asset"]["generator"] == "a stranger" and made["animations"][0]["name"] == "motion"
    tab.ask("document.getElementById('export-dialog').close()")

    assert document(tab)["figure"] == {"character": {"id": hero, "name": "My hero"}, "materials": "own"}
    tab.ask("location.reload()")
    time.sleep(0.5)
    ready(tab)
    assert figure(tab, "") == hero and nameless(tab) == []
    tab.ask(f"fetch('/api/characters/{hero}', {{ ...{KEY}, method: 'DELETE' }}).then(() => location.reload())")
    time.sleep(1)
    ready(tab)
    assert figure(tab, hero) == "mannequin"
    message(tab, "My hero cannot be shown: That character is no longer stored; add its file again.")
    drop(tab, "My hero.glb", figures.glb(figures.stocky()))
    assert figure(tab, "mannequin") == hero, "the same file is the same character"


def choose(tab: browser.Tab, joint: str, name: str) -> None:
    """Choose the character's joint for one of ours, in the open menu; "": not driven."""
    selector = json.dumps(f"[data-key=joint-{joint}]")
    tab.wait(f"document.querySelector({selector}) !== null")
    tab.ask(f"(() => {{ const select = document.querySelector({selector}); select.value = {json.dumps(name)};"
            " select.dispatchEvent(new Event('change')); })()")  # fmt: skip


def corrections(tab: browser.Tab, name: str) -> dict:
    """The joint map that the server has stored."""
    address = f"/api/characters/{name}/joint_map"
    tab.ask(f"window.told = null, fetch('{address}', {KEY}).then(async (answer) => {{ told = await answer.json(); }})")
    tab.wait("told !== null")
    return tab.ask("told")["corrections"]


def test_a_joint_is_corrected_in_the_menu_the_stage_follows_and_a_reload_keeps_it(tab):
    write(tab, "walk")
    shown(tab)
    drop(tab, "lanky.glb", figures.glb(figures.lanky(), seed=3))
    lanky = figure(tab, "mannequin")
    value = "document.querySelector('[data-key=joint-{}]')?.value"
    refusal = "document.getElementById('joint-refusal')"
    posed = "performance.getEntriesByType('resource').filter(({ name }) => name.includes('/poses/')).length"

    def opened_menu() -> None:
        click(tab, "#character")
        tab.wait("document.getElementById('character').ariaExpanded === 'true'")

    def stage() -> np.ndarray:
        press(tab, "Escape")
        tab.wait("document.getElementById('character').ariaExpanded === 'false'")
        tab.wait("document.getElementById('stage').ariaBusy === 'false'")
        return colours(tab)

    before = stage()
    opened_menu()
    click(tab, "#joint-map summary")
    tab.wait(f"{value.format('left_elbow')} === 'DEF-forearm.L'")
    assert tab.ask("document.querySelectorAll('#joint-list select').length") == len(MAPPED)
    assert tab.ask("document.getElementById('joint-about').textContent") == "Found by the joints' names."
    assert nameless(tab) == [] and tab.ask("document.getElementById('joint-reset').disabled")
    count = tab.ask(posed)
    choose(tab, "left_knee", "DEF-shin.R")
    tab.wait(f"!{refusal}.hidden")
    assert "'DEF-shin.R' cannot be both" in tab.ask(f"{refusal}.textContent")
    picture(tab, "25_joint_refused")
    assert corrections(tab, lanky) == {} and tab.ask(posed) == count, "what is refused moves nobody"
    for joint in ("hip", "ankle", "foot", "knee"):  # fit only together
        for side, other in (("left", "R"), ("right", "L")):
            bone = {"hip": "thigh", "knee": "shin", "ankle": "foot", "foot": "toe"}[joint]
            choose(tab, f"{side}_{joint}", f"DEF-{bone}.{other}")
    tab.wait(f"{refusal}.hidden")
    tab.wait(f"{posed} === {count + 1}")
    assert len(corrections(tab, lanky)) == 8
    picture(tab, "26_joints_corrected")
    crossed = stage()
    assert np.abs(crossed - before).max() > 50, "the figure moves by the corrected map"
    opened_menu()
    tab.wait("!document.getElementById('joint-reset').disabled")
    click(tab, "#joint-reset")
    tab.wait(f"{value.format('left_knee')} === 'DEF-shin.L'")
    assert corrections(tab, lanky) == {}
    assert np.abs(stage() - before).max() < 50
    opened_menu()
    choose(tab, "left_foot", "")
    tab.wait("!document.getElementById('joint-reset').disabled")
    tab.wait("document.getElementById('joint-about').textContent.includes('corrected')")
    tab.ask("location.reload()")
    time.sleep(0.5)
    ready(tab)
    assert figure(tab, "") == lanky and corrections(tab, lanky) == {"left_foot": None}
    opened_menu()
    click(tab, "#joint-map summary")
    tab.wait(f"{value.format('left_foot')} === ''")
    click(tab, "[data-key=wear-mannequin]")
    tab.wait("document.getElementById('joint-map').hidden")


def test_files_that_are_no_characters_are_refused_in_a_sentence_and_one_that_cannot_be_shown_falls_back(tab):
    write(tab, "walk")
    shown(tab)
    hero = figures.glb(figures.stocky())
    drop(tab, "cut.glb", hero[:-40])
    message(tab, "it is cut or damaged")
    drop(tab, "large.glb", hero, beyond=33 * 2**20 - len(hero))
    message(tab, "large.glb has 33 MiB; a character has 32 at most.")
    drop(tab, "robot.urdf", b"<robot name='r'/>")
    message(tab, "`stmc sample timeline.json outputs/ character=robot.urdf`")
    made, binary = figures.document(figures.stocky())
    made["accessors"][1]["bufferView"] = 99
    drop(tab, "odd.glb", figures.packed(made, binary))
    message(tab, "odd cannot be shown: ")
    assert tab.ask("document.body.dataset.figure") == "mannequin"
    assert document(tab)["figure"]["character"]["name"] == "odd"


@pytest.mark.parametrize("who", ["mannequin", "character"])
def test_a_hand_is_pulled_its_target_follows_and_each_pull_is_one_step_of_the_history(tab, who):
    write(tab, "walk")
    first = shown(tab)
    if who == "character":
        drop(tab, "lanky.glb", figures.glb(figures.lanky(), seed=3))
        figure(tab, "mannequin")
    automatic(tab, False)
    tab.ask("document.getElementById('seek').value = 1.5, document.getElementById('seek').oninput()")
    tab.ask("document.activeElement.blur()")
    assert grips(tab) == []
    press(tab, "p")
    found = grips(tab)
    assert 3 <= len(found) <= 5, "a foot may hide the other one"
    highest = min(found, key=lambda place: place[1])
    pull(tab, highest, (0, 0))
    assert constraints(tab) == [], "a click pulls nothing"
    pull(tab, found[0], (-20, -60))
    picture(tab, f"23_pulled_{who}")
    assert len(constraints(tab)) == 1 and constraints(tab)[0].endswith("at 1.5\u00a0s")
    [target] = document(tab)["constraints"]
    before = motion_of(tab, first).joints[30, JOINTS.index(target["joint"])].numpy()
    assert target["start"] == 1.5 and target["end"] is None and 0.1 < np.linalg.norm(target["point"] - before) < 1
    again = min(grips(tab), key=lambda place: np.hypot(place[0] - found[0][0] + 20, place[1] - found[0][1] + 60))
    pull(tab, again, (10, -10))
    assert len(constraints(tab)) == 1, "the target of this joint follows"
    [moved] = document(tab)["constraints"]
    assert moved["id"] == target["id"] and moved["point"] != target["point"]
    tab.ask("document.activeElement.blur()")
    press(tab, "z", CONTROL)
    assert document(tab)["constraints"] == [target]
    press(tab, "z", CONTROL)
    assert constraints(tab) == []
    press(tab, "y", CONTROL)
    click(tab, "#generate")
    second = shown(tab, first)
    joint = motion_of(tab, second).joints[30, JOINTS.index(target["joint"])].numpy()
    assert np.linalg.norm(joint - target["point"]) < 0.02


def test_a_chosen_keyframe_offers_the_pose_to_be_pulled_and_playing_hides_it(tab):
    write(tab, "walk")
    shown(tab)
    automatic(tab, False)
    click(tab, "#tab-constraints")
    click(tab, "[data-key=add-keyframe]")
    assert len(grips(tab)) >= 3
    pull(tab, grips(tab)[0], (-30, -30))
    assert [title.split()[0] for title in constraints(tab)] == ["Keyframe,", "Target"]
    assert len(grips(tab)) >= 3, "the next one can be pulled at once"
    click(tab, "#play")
    assert len(grips(tab)) <= 1, "the place of the target alone"


def test_a_drawn_path_begins_at_the_figure(tab):
    write(tab, "walk")
    first = shown(tab)
    automatic(tab, False)
    tab.ask("document.getElementById('seek').value = 1, document.getElementById('seek').oninput()")
    tab.ask("document.activeElement.blur()")
    for key in ("i", "End", "o"):  # an interval from a second on
        press(tab, key)
    tab.wait("document.getElementById('stage').dataset.time === '3.000'")
    click(tab, "#tab-constraints")
    click(tab, "[data-key=add-path]")
    stage = box(tab, "#stage")
    start = (stage["width"] / 4, stage["top"] + 0.8 * stage["height"])
    pull(tab, start, (300, 40), steps=12)
    picture(tab, "24_path")
    [path] = document(tab)["constraints"]
    there = motion_of(tab, first).translation[20, :2].numpy()
    assert path["start"] == 1 and np.linalg.norm(path["points"][0] - there) < 0.02
    assert np.linalg.norm(path["points"][-1] - there) > 0.3
